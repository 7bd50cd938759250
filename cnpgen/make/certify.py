"""Stage: certified samples, each with a plan that Pinocchio and Coal call valid."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.machine.threads import one_thread
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Round, Stage, Work
from cnpgen.plans.format import BOUNDARY
from cnpgen.store.field import Field

NO_PLAN = "no plan found"


@dataclass(frozen=True, kw_only=True)
class CertifiedPlan(Stage):
    """Solves every sample from nothing, with the problem's own objective, and keeps those with a valid plan."""

    block_rows: ClassVar[int] = 64  # a sample takes some 30 ms: blocks of this stage must be small
    needs = (*BOUNDARY, "start_xyz", "goal_xyz")

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

        def work(draws: Round, _random: np.random.Generator) -> None:
            columns = {name: np.ascontiguousarray(values.T) for name, values in draws.columns.items()}
            with one_thread():
                motion, valid = solve(columns)
            draws["path_control_points"] = np.ascontiguousarray(motion.path.reshape(len(motion), -1).T)
            draws["rate_control_points"] = np.ascontiguousarray(motion.rate.T)
            draws["duration"] = motion.duration()[None]
            draws.reject(valid, NO_PLAN)

        return work


def certified(recipe: DatasetRecipe) -> DatasetRecipe:
    """Return the recipe of the certified dataset: one more stage, and a name that says so."""
    if any(isinstance(stage, CertifiedPlan) for stage in recipe.pipeline.stage):
        return recipe
    pipeline = replace(recipe.pipeline, stage=(*recipe.pipeline.stage, CertifiedPlan()))
    return replace(recipe, name=f"{recipe.name}-certified", pipeline=pipeline)
