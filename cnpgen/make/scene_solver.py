"""Plans for rows with scenes: every scene is planned among the obstacles that it has, not among all places."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.library import problem_kernels
from cnpgen.pipelines.context import Context
from cnpgen.plans.format import OBSTACLE_POSES
from cnpgen.problems.problem import Problem
from cnpgen.refine.refine_engine import Solver, load_solver
from cnpgen.robots.scene_arrays import sample_obstacles, scene_poses
from cnpgen.store.scene_table import OBSTACLE_KINDS, SceneTable
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]
Counts = tuple[int, ...]  # obstacles of each kind

PLACES_PER_STEP = 2  # numbers of places are multiples of it, so that scenes share solvers


class SceneSolver:
    """Solvers of a problem for different numbers of obstacles; residuals of absent obstacles would take most time.

    Args:
        context: Loaded problem, whose parked obstacles are the places of those of scenes.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._solvers: dict[Counts, tuple[Problem, Solver]] = {}
        capacity = {kind: len(places) for kind, places in sample_obstacles(context.problem.obstacle).items()}
        self._capacity = np.array([capacity[kind] for kind in OBSTACLE_KINDS])

    def __call__(
        self, columns: Mapping[str, Array], scenes: SceneTable, guess: Motion | None = None
    ) -> tuple[Motion, NDArray[np.bool_]]:
        """Plan N rows; see ``load_solver``.

        Args:
            columns: Columns of the rows, shape (N, width) each.
            scenes: Scene of each row, N scenes.
            guess: Initial guesses.
        """
        spec, robot, count = self._context.problem.trajectory, self._context.robot, len(scenes)
        path = np.empty((count, spec.path_control_points, robot.n))
        rate, valid = np.empty((count, spec.rate_control_points)), np.zeros(count, bool)
        numbers = np.stack([(scenes.obstacle_kind == code).sum(axis=1) for code in range(len(OBSTACLE_KINDS))], axis=1)
        numbers = np.minimum(-(-numbers // PLACES_PER_STEP) * PLACES_PER_STEP, self._capacity)
        groups, group_of = np.unique(numbers, axis=0, return_inverse=True)
        for index, group in enumerate(groups.tolist()):
            rows = np.flatnonzero(group_of.ravel() == index)
            problem, solve = self._solver(tuple(group))
            own = {name: values[rows] for name, values in columns.items()}
            own[OBSTACLE_POSES] = scene_poses(problem.obstacle, scenes[rows])
            motion, valid[rows] = solve(own, None if guess is None else guess[rows])
            path[rows], rate[rows] = motion.path, motion.rate
        return Motion(path, rate, spec.degree), valid

    def _solver(self, counts: Counts) -> tuple[Problem, Solver]:
        """Return the problem with places for some numbers of obstacles, and its solver."""
        if counts not in self._solvers:
            context, places = self._context, sample_obstacles(self._context.problem.obstacle)
            kept = zip(OBSTACLE_KINDS, counts, strict=True)
            removed = {index for kind, count in kept for index in places[kind][count:]}
            obstacles = [each for index, each in enumerate(context.problem.obstacle) if index not in removed]
            problem = context.problem.with_obstacles(obstacles)
            kernels = problem_kernels(problem, context.robot, context.kernels.backend, context.kernels.cache_folder)
            self._solvers[counts] = problem, load_solver(problem, context.robot, kernels)
        return self._solvers[counts]
