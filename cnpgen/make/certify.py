"""Stage: certified samples, each with a plan that Pinocchio and Coal verify as valid."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.errors import RecipeError
from cnpgen.kernels.library import problem_kernels
from cnpgen.machine.threads import one_thread
from cnpgen.make.on_plan import (
    SHA256,
    load_stage_planner,
    model_sha256,
    planner_boundary,
)
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, Stage, StageFunction
from cnpgen.plans.format import BOUNDARY
from cnpgen.problems.problem import Problem
from cnpgen.refine.refine_engine import Solver, load_solver
from cnpgen.robots.scene import sample_obstacles, scene_poses
from cnpgen.schema.keys import field
from cnpgen.store.field import Field, Fields
from cnpgen.store.scene_table import OBSTACLE_KINDS, OBSTACLE_POSES, SceneTable
from cnpgen.trajectory.spline_motion import Motion

Counts = tuple[int, ...]  # obstacles of each kind

# Numbers of places are multiples of it, so that scenes share solvers.

PLACES_PER_STEP = 2

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
        "sha256 of the model file; another file gives other plans",
        default="",
        pattern=SHA256,
        since_version=2,
    )

    def describe(self) -> str:
        origin = f"from the plan of {self.model!r}" if self.model else "from nothing"
        return (
            f"plan every sample {origin} (sequential quadratic programming, several starts) and keep those whose"
            " plan Pinocchio and Coal call valid on a time grid of 1 ms, with the plan"
        )

    def outputs(self, context: Context) -> Fields:
        spec = context.problem.trajectory
        joints = context.robot.joint_names
        points = spec.path_control_points
        rates = spec.rate_control_points
        path_names = tuple(
            f"C{point}.{joint}" for point in range(points) for joint in joints
        )
        rate_names = tuple(f"R{point}" for point in range(rates))
        text = f"control points of the path p(s) of a valid plan, reshape to ({points}, {len(joints)})"
        units = context.robot.units("rad")
        rate_text = "control points of its rate r(s) = ds/dt"
        return (
            Field(
                "path_control_points",
                units,
                text,
                points * len(joints),
                path_names,
                role="target",
            ),
            Field(
                "rate_control_points",
                "1/s",
                rate_text,
                rates,
                rate_names,
                role="target",
            ),
            Field("duration", "s", "its motion time", role="target"),
        )

    def task_inputs(self, context: Context) -> Fields:
        return ()

    def prepare(self, context: Context) -> StageFunction:
        if context.dtype != "float64":
            text = "plans meet their boundary conditions in float64 only: needs it, got"
            raise RecipeError([f"{text} {context.dtype}"])
        solver = load_solver(context.problem, context.robot, context.kernels)
        solver_of_scenes = SceneSolver(context)
        planner = (
            load_stage_planner(self.model, self.sha256, context) if self.model else None
        )

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            columns = {
                # Stages hold columns with the rows last, solvers rows first.
                name: np.ascontiguousarray(values.T)
                for name, values in candidates.columns.items()
            }
            scenes = None
            if candidates.scenes is not None:
                scenes = candidates.scenes.table[candidates.scene]
            guess = None
            if planner is not None:
                boundary = planner_boundary(columns, planner)
                poses = _poses(context, scenes)
                guess = planner.plan_batch(boundary, columns=poses).motion
            # Workers are processes already: threads of linear algebra would compete for
            # their cores.
            with one_thread():
                motion, valid = (
                    solver(columns, guess)
                    if scenes is None
                    else solver_of_scenes(columns, scenes, guess)
                )
            count, points, joints = motion.path.shape
            path = motion.path.reshape(count, points * joints).T
            candidates["path_control_points"] = np.ascontiguousarray(path)
            candidates["rate_control_points"] = np.ascontiguousarray(motion.rate.T)
            candidates["duration"] = motion.duration()[None]
            candidates.reject(valid, NO_PLAN)

        return work


def _poses(context: Context, scenes: SceneTable | None) -> dict[str, Array]:
    """Return the columns with the obstacles of scenes; none without scenes."""
    if scenes is None:
        return {}
    return {OBSTACLE_POSES: scene_poses(context.problem.obstacle, scenes)}


def certified(
    recipe: DatasetRecipe, *, model: str | Path | None = None
) -> DatasetRecipe:
    """Return the recipe of the certified dataset, with one more stage and the name ``NAME-certified``.

    The model plans the initial guesses. The recipe of a certified dataset is returned
    unchanged.
    """
    if any(isinstance(stage, CertifiedPlan) for stage in recipe.pipeline.stage):
        return recipe
    stage = (
        CertifiedPlan()
        if model is None
        else CertifiedPlan(model=str(model), sha256=model_sha256(str(model)))
    )
    pipeline = replace(recipe.pipeline, stage=(*recipe.pipeline.stage, stage))
    return replace(recipe, name=f"{recipe.name}-certified", pipeline=pipeline)


class SceneSolver:
    """Solvers of a problem for different numbers of obstacles; residuals of absent obstacles would take most time.

    The parked obstacles of the problem are the places of those of scenes.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._solvers: dict[Counts, tuple[Problem, Solver]] = {}
        capacity = {
            kind: len(places)
            for kind, places in sample_obstacles(context.problem.obstacle).items()
        }
        self._capacity = np.array([capacity[kind] for kind in OBSTACLE_KINDS])

    def __call__(
        self,
        columns: Mapping[str, Array],
        scenes: SceneTable,
        guess: Motion | None = None,
    ) -> tuple[Motion, Mask]:
        """Plan N rows with columns of shape (N, width), N scenes and N initial guesses; see ``load_solver``."""
        spec = self._context.problem.trajectory
        robot = self._context.robot
        count = len(scenes)
        path = np.empty((count, spec.path_control_points, robot.n))
        rate = np.empty((count, spec.rate_control_points))
        valid = np.zeros(count, bool)
        # Number of obstacles of each kind in each scene, shape (N, kinds).
        numbers = np.stack(
            [
                (scenes.obstacle_kind == code).sum(axis=1)
                for code in range(len(OBSTACLE_KINDS))
            ],
            axis=1,
        )
        # Rounded up to multiples, but no more places than the problem has.
        numbers = np.minimum(
            -(-numbers // PLACES_PER_STEP) * PLACES_PER_STEP, self._capacity
        )
        # Scenes with equal numbers of places share a solver.
        groups, group_of = np.unique(numbers, axis=0, return_inverse=True)
        for index, group in enumerate(groups.tolist()):
            rows = np.flatnonzero(group_of.ravel() == index)
            problem, solve = self._solver(tuple(group))
            own = {name: values[rows] for name, values in columns.items()}
            own[OBSTACLE_POSES] = scene_poses(problem.obstacle, scenes[rows])
            motion, valid[rows] = solve(own, None if guess is None else guess[rows])
            path[rows] = motion.path
            rate[rows] = motion.rate
        return Motion(path, rate, spec.degree), valid

    def _solver(self, counts: Counts) -> tuple[Problem, Solver]:
        """Return the problem with places for some numbers of obstacles, and its solver."""
        if counts not in self._solvers:
            context = self._context
            places = sample_obstacles(self._context.problem.obstacle)
            kept = zip(OBSTACLE_KINDS, counts, strict=True)
            # The first places of each kind are kept, where scene_poses puts obstacles.
            removed = {index for kind, count in kept for index in places[kind][count:]}
            obstacles = [
                each
                for index, each in enumerate(context.problem.obstacle)
                if index not in removed
            ]
            problem = context.problem.with_obstacles(obstacles)
            kernels = problem_kernels(
                problem,
                context.robot,
                context.kernels.backend,
                context.kernels.cache_folder,
            )
            self._solvers[counts] = (
                problem,
                load_solver(problem, context.robot, kernels),
            )
        return self._solvers[counts]
