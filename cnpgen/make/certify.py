"""Stage: certified samples, each with a plan that Pinocchio and Coal call valid."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.machine.threads import one_thread
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.make.stage_planner import SHA256, asked, load_stage_planner, model_sha256
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Round, Stage, Work
from cnpgen.plans.format import BOUNDARY
from cnpgen.schema.keys import field
from cnpgen.store.field import Field

NO_PLAN = "no plan found"


@dataclass(frozen=True, kw_only=True)
class CertifiedPlan(Stage):
    """Solves every sample, with the problem's own objective, and keeps those with a valid plan."""

    block_rows: ClassVar[int] = 64  # a sample takes some 30 ms: blocks of this stage must be small
    needs = (*BOUNDARY, "start_xyz", "goal_xyz")
    model: str = field(
        "the planner whose plans solving begins with, a shipped one or a file; none: from nothing",
        default="",
        late=True,
    )
    sha256: str = field(
        "sha256 of the model's file: from another one come other plans", default="", pattern=SHA256, late=True
    )

    def describe(self) -> str:
        """Say what is kept."""
        origin = f"from the plan of {self.model!r}" if self.model else "from nothing"
        return (
            f"plan every sample {origin} (sequential quadratic programming, several starts) and keep those whose"
            " plan Pinocchio and Coal call valid on a time grid of 1 ms, with the plan"
        )

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The control points, flattened point by point, and the duration."""
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

    def takes(self, context: Context) -> tuple[Field, ...]:
        """Nothing: tasks bring no plans."""
        del context
        return ()

    def prepare(self, context: Context) -> Work:
        """Load the refiner."""
        if context.dtype != "float64":
            raise RecipeError([f"plans meet their boundary conditions in float64 only: needs it, got {context.dtype}"])
        from cnpgen.refine.engine import load_solver

        solve = load_solver(context.problem, context.robot, context.kernels)
        planner = load_stage_planner(self.model, self.sha256, context) if self.model else None

        def work(draws: Round, _random: np.random.Generator) -> None:
            columns = {name: np.ascontiguousarray(values.T) for name, values in draws.columns.items()}
            given = None if planner is None else planner.plan_batch(asked(columns, planner)).motion
            with one_thread():
                motion, valid = solve(columns, given)
            count, points, joints = motion.path.shape
            draws["path_control_points"] = np.ascontiguousarray(motion.path.reshape(count, points * joints).T)
            draws["rate_control_points"] = np.ascontiguousarray(motion.rate.T)
            draws["duration"] = motion.duration()[None]
            draws.reject(valid, NO_PLAN)

        return work


def certified(recipe: DatasetRecipe, *, model: str | Path | None = None) -> DatasetRecipe:
    """Return the recipe of the certified dataset: one more stage, and a name that says so.

    Args:
        recipe: The recipe; one that is of a certified dataset already stays as it is.
        model: The planner whose plans solving begins with; by default it begins from nothing.

    Raises:
        UsageError: There is no such model.
    """
    if any(isinstance(stage, CertifiedPlan) for stage in recipe.pipeline.stage):
        return recipe
    stage = CertifiedPlan() if model is None else CertifiedPlan(model=str(model), sha256=model_sha256(str(model)))
    pipeline = replace(recipe.pipeline, stage=(*recipe.pipeline.stage, stage))
    return replace(recipe, name=f"{recipe.name}-certified", pipeline=pipeline)
