"""Stage: certified samples, each with a plan that Pinocchio and Coal verify as valid."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.machine.threads import one_thread
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.make.scene_solver import SceneSolver
from cnpgen.make.stage_planner import SHA256, load_stage_planner, model_sha256, planner_boundary
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import CandidateBatch, Stage, StageFunction
from cnpgen.plans.format import BOUNDARY, OBSTACLE_POSES
from cnpgen.robots.scene_arrays import scene_poses
from cnpgen.schema.keys import field
from cnpgen.store.field import Field

NO_PLAN = "no plan found"


@dataclass(frozen=True, kw_only=True)
class CertifiedPlan(Stage):
    """Stage: solve every sample with the problem's objective and keep those with a valid plan."""

    block_rows: ClassVar[int] = 64  # small blocks, since a sample takes about 30 ms
    inputs = (*BOUNDARY, "start_xyz", "goal_xyz")
    model: str = field(
        "planner whose plans are the initial guesses, a shipped one or a file; none: no initial guess",
        default="",
        since_version=2,
    )
    sha256: str = field(
        "sha256 of the model file; another file gives other plans", default="", pattern=SHA256, since_version=2
    )

    def describe(self) -> str:
        """Describe the stage in one sentence."""
        origin = f"from the plan of {self.model!r}" if self.model else "from nothing"
        return (
            f"plan every sample {origin} (sequential quadratic programming, several starts) and keep those whose"
            " plan Pinocchio and Coal call valid on a time grid of 1 ms, with the plan"
        )

    def outputs(self, context: Context) -> tuple[Field, ...]:
        """List the fields of the control points, flattened point by point, and of the duration."""
        spec, joints = context.problem.trajectory, context.robot.joint_names
        points, rates = spec.path_control_points, spec.rate_control_points
        path_names = tuple(f"C{point}.{joint}" for point in range(points) for joint in joints)
        shape = f"({points}, {len(joints)})"
        text = f"control points of the path p(s) of a valid plan, reshape to {shape}"
        units = context.robot.units("rad")
        return (
            Field("path_control_points", units, text, points * len(joints), path_names, role="target"),
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

    def task_inputs(self, context: Context) -> tuple[Field, ...]:
        """Return no fields: tasks have no plans."""
        del context
        return ()

    def prepare(self, context: Context) -> StageFunction:
        """Load the refiner."""
        if context.dtype != "float64":
            raise RecipeError([f"plans meet their boundary conditions in float64 only: needs it, got {context.dtype}"])
        from cnpgen.refine.refine_engine import load_solver

        solver = load_solver(context.problem, context.robot, context.kernels)
        solver_of_scenes = SceneSolver(context)
        planner = load_stage_planner(self.model, self.sha256, context) if self.model else None

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            columns = {name: np.ascontiguousarray(values.T) for name, values in candidates.columns.items()}
            scenes, poses = None, dict[str, NDArray[np.float64]]()
            if candidates.scenes is not None:
                scenes = candidates.scenes.table[candidates.scene]
                poses = {OBSTACLE_POSES: scene_poses(context.problem.obstacle, scenes)}
            guess = None
            if planner is not None:
                guess = planner.plan_batch(planner_boundary(columns, planner), columns=poses).motion
            with one_thread():
                motion, valid = solver(columns, guess) if scenes is None else solver_of_scenes(columns, scenes, guess)
            count, points, joints = motion.path.shape
            candidates["path_control_points"] = np.ascontiguousarray(motion.path.reshape(count, points * joints).T)
            candidates["rate_control_points"] = np.ascontiguousarray(motion.rate.T)
            candidates["duration"] = motion.duration()[None]
            candidates.reject(valid, NO_PLAN)

        return work


def certified(recipe: DatasetRecipe, *, model: str | Path | None = None) -> DatasetRecipe:
    """Return the recipe of the certified dataset, with one more stage and the name ``NAME-certified``.

    The model plans the initial guesses. The recipe of a certified dataset is returned unchanged.

    Raises:
        UsageError: There is no such model.
    """
    if any(isinstance(stage, CertifiedPlan) for stage in recipe.pipeline.stage):
        return recipe
    stage = CertifiedPlan() if model is None else CertifiedPlan(model=str(model), sha256=model_sha256(str(model)))
    pipeline = replace(recipe.pipeline, stage=(*recipe.pipeline.stage, stage))
    return replace(recipe, name=f"{recipe.name}-certified", pipeline=pipeline)
