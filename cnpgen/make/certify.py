"""Stage: certified samples, each with a plan that Pinocchio and Coal call valid."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.machine.threads import one_thread
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Round, Stage, Work
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.store.field import Field
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spec import TrajectorySpec

if TYPE_CHECKING:
    from cnpgen.refine.task import Refined
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

NO_PLAN = "no plan found"
_ENDS = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")


@dataclass(frozen=True, kw_only=True)
class CertifiedPlan(Stage):
    """Solves every sample from nothing, with the problem's own objective, and keeps those with a valid plan."""

    block_rows: ClassVar[int] = 64  # a sample takes some 30 ms: blocks of this stage must be small
    needs = (*_ENDS, "start_xyz", "goal_xyz")

    def describe(self) -> str:
        """Say what is kept."""
        return (
            "plan every sample from nothing (sequential quadratic programming, several starts) and keep those whose"
            " plan Pinocchio and Coal call valid on a time grid of 1 ms, with the plan"
        )

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The control points, flattened point by point, and the duration."""
        spec, joints = context.problem.trajectory, context.robot.joint_names
        points, rates = spec.path_control_points, spec.rate_control_points
        path_names = tuple(f"C{point}.{joint}" for point in range(points) for joint in joints)
        shape = f"({points}, {len(joints)})"
        text = f"control points of the path p(s) of a valid plan, reshape to {shape}"
        return (
            Field("path_control_points", "rad", text, points * len(joints), path_names, role="target"),
            Field(
                "rate_control_points",
                "1/s",
                "control points of its rate r(s) = ds/dt",
                rates,
                tuple(f"R{point}" for point in range(rates)),
                role="target",
            ),
            Field("duration", "s", "its motion time", role="target"),
        )

    def prepare(self, context: Context) -> Work:
        """Load the refiner."""
        if context.dtype != "float64":
            raise RecipeError([f"plans meet their boundary conditions in float64 only: needs it, got {context.dtype}"])
        from cnpgen.refine.jury import Jury
        from cnpgen.refine.polish import refine_task
        from cnpgen.refine.refiner import Refiner
        from cnpgen.refine.solver.criterion import choose_criterion
        from cnpgen.refine.task import Task
        from cnpgen.world.state import World

        problem, robot = context.problem, context.robot
        refiner = Refiner(
            problem,
            robot,
            kernels=context.kernels,
            world=World(robot, problem.obstacle, problem.object_size),
            criterion=choose_criterion(problem),
        )

        jury = Jury(problem, robot, degree=refiner.spec.degree)

        def run(batch: Round, _random: np.random.Generator) -> None:
            ends = (*_ENDS, "goal_ddq") if "goal_ddq" in batch.columns else _ENDS
            boundary = Boundary(*(np.ascontiguousarray(batch[name].T) for name in ends))
            starts, goals = (np.ascontiguousarray(batch[name].T) for name in ("start_xyz", "goal_xyz"))
            tops = obstacle_tops(problem, starts, goals)
            with one_thread():
                found = [
                    refine_task(refiner, jury, Task(boundary[i : i + 1], tops[i], starts[i], goals[i]))
                    for i in range(len(boundary))
                ]
            _write(batch, found, refiner.spec, robot.n)

        return run


def _write(batch: Round, found: "list[Refined]", spec: TrajectorySpec, n: int) -> None:
    """Write the plans' columns and reject the samples without a valid one."""
    motion = Motion(
        np.array([each.path for each in found]).reshape(len(found), spec.path_control_points, n),
        np.array([each.rate for each in found]).reshape(len(found), spec.rate_control_points),
        spec.degree,
    )
    batch["path_control_points"] = np.ascontiguousarray(motion.path.reshape(len(found), -1).T)
    batch["rate_control_points"] = np.ascontiguousarray(motion.rate.T)
    batch["duration"] = motion.duration()[None]
    batch.reject(np.array([each.valid for each in found], bool), NO_PLAN)


@dataclass(frozen=True)
class PlanCheck:
    """What the verdict says of the plans in rows of a certified dataset.

    Attributes:
        judged: How many plans there are.
        valid: How many of them are valid.
        problems: What is wrong, a line each.
    """

    judged: int = 0
    valid: int = 0
    problems: tuple[str, ...] = ()


def check_plans(problem: Problem, robot: "Robot", columns: Mapping[str, NDArray[Any]]) -> PlanCheck:
    """Judge the plans that rows of a certified dataset hold; rows of others hold none.

    Args:
        problem: The problem.
        robot: Its robot.
        columns: Field -> values, shape (rows, width) or (rows,).
    """
    from cnpgen.judges.plans.judge import judge

    if "path_control_points" not in columns:
        return PlanCheck()
    rows, spec = len(columns["start_q"]), problem.trajectory
    motion = Motion(
        columns["path_control_points"].reshape(rows, -1, robot.n), columns["rate_control_points"], spec.degree
    )
    boundary = Boundary(*(columns[name] for name in (*_ENDS, "goal_ddq") if name in columns))
    verdicts = judge(problem, robot, motion, boundary, columns["start_xyz"], columns["goal_xyz"])
    wrong = [(row, verdict.reason) for row, verdict in enumerate(verdicts) if not verdict.valid]
    problems = []
    if wrong:
        row, reason = wrong[0]
        problems.append(f"{len(wrong)} of {rows} plans are not valid, the first one is that of row {row}: {reason}")
    if not np.allclose(columns["duration"], motion.duration(), rtol=1e-9, atol=0):
        problems.append("durations are not those of the plans")
    return PlanCheck(rows, rows - len(wrong), tuple(problems))


def certified(recipe: DatasetRecipe) -> DatasetRecipe:
    """Return the recipe of the certified dataset: one more stage, and a name that says so."""
    if any(isinstance(stage, CertifiedPlan) for stage in recipe.pipeline.stage):
        return recipe
    pipeline = replace(recipe.pipeline, stage=(*recipe.pipeline.stage, CertifiedPlan()))
    return replace(recipe, name=f"{recipe.name}-certified", pipeline=pipeline)
