"""Prepare tasks from boundary conditions: tip positions, obstacles, expected time, projected line."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.control_point_functions import line_change, tips_at_ends
from cnpgen.planner.control_points import along_line, lines_at_rest
from cnpgen.planner.expressions import effective_steps
from cnpgen.planner.model import ModelConfig
from cnpgen.planner.network.features import SceneFeatures, make_scene_features
from cnpgen.planner.tasks import (
    MIN_EXPECTED_TIME_S,
    MIN_TRAVEL_TIME_S,
    Tasks,
    ends_of,
    expected_time,
    lanes,
    reaching_time,
    rows,
)
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import place_obstacles
from cnpgen.trajectory.boundary import Boundary


@dataclass(frozen=True)
class TaskPreprocessor:
    """Preprocessor of one problem's tasks; made by ``make_task_preprocessor``.

    Attributes:
        problem: The problem, ``Problem.for_planning``.
        velocity_limit: Planning limits [rad/s], shape (n,).
        tips: Kernel of ``control_point_functions.tips_at_ends``.
        line: Kernel of ``control_point_functions.line_change``; None if the line is not
            projected.
        reaching_time: Kernel of ``tasks.reaching_time``; None if the expected time is
            that of the distance.
        via_line: The same kernel with offsets; None if there are no via points, or no
            projection.
        least_time: Lower bound of the expected time of the distance [s].
        placed: Obstacles that samples place.
        scene_features: Features of these obstacles; None if the model has none.
        iterated: Whether the network corrects its own path.
    """

    problem: Problem
    velocity_limit: Array
    tips: Kernel
    line: Kernel | None
    reaching_time: Kernel | None = None
    via_line: Kernel | None = None
    least_time: float = MIN_EXPECTED_TIME_S
    placed: tuple[Obstacle, ...] = ()
    scene_features: SceneFeatures | None = None
    iterated: bool = False

    def __call__(
        self,
        boundary: Boundary,
        via_point: Array | None = None,
        *,
        ends: Array | None = None,
        obstacle_poses: Array | None = None,
    ) -> Tasks:
        """Prepare N tasks, in float64, with lines through via points [rad], shape (N, n), at half their length.

        ``ends`` is the result of ``ends_of``, if already computed. Poses are those of
        obstacles that samples place.

        Raises:
            UsageError: Obstacle poses are missing, have a wrong shape or are not
                finite, or the problem places them.
        """
        ends = ends_of(boundary) if ends is None else ends
        # Kernels have samples last, one lane each.
        start_xyz, goal_xyz, *velocity = (tip.T for tip in self.tips(ends))
        parameters = self._parameters(boundary)
        scene = scene_of(
            self.problem,
            start_xyz,
            goal_xyz,
            velocity[0] if velocity else None,
            parameters,
        )
        # Without the kernel of ``reaching_time`` the unit is that of the distance.
        if self.reaching_time is None:
            limit = self._velocity_limits(parameters)
            time = expected_time(boundary, limit, least=self.least_time)
        else:
            time = self.reaching_time(ends)[0][0]
        correction = self._correction(boundary, via_point, ends, time, scene)
        # Networks that observe or correct a path take offsets, zero at first.
        if correction is None and (self.iterated or self.scene_features is not None):
            n, points = boundary.start_q.shape[1], self._interior_points(boundary)
            correction = np.zeros((len(boundary), points, n))
        placed = self._placed_scene(len(boundary), obstacle_poses)
        tasks = Tasks(boundary, start_xyz, goal_xyz, time, scene, correction, placed)
        if correction is None or placed is None:
            return tasks
        return self._observed(tasks, lines_at_rest(boundary, correction))

    def _correction(
        self,
        boundary: Boundary,
        via_point: Array | None,
        ends: Array,
        time: Array,
        scene: Scene,
    ) -> Array | None:
        """Return offsets from the straight line [rad], through a via point and projected; None if there are none."""
        if via_point is None:
            correction, kernel, offsets = None, self.line, []
        else:
            correction = self._via_offsets(boundary, via_point)
            kernel, offsets = self.via_line, [lanes(correction)]
        if kernel is None:
            return correction
        # A constant rate of 1 / T traverses the phase in the expected time.
        (change,) = kernel(ends, *offsets, 1 / time[None], scene.lanes)
        return rows(change, boundary.start_q.shape[1])

    def along(self, tasks: Tasks, path: Array) -> Tasks:
        """Return tasks whose lines are the paths of other plans for them: control points [rad], shape (N, C, n)."""
        # Offsets from the straight line between the control points that the ends
        # determine.
        fixed = tasks.boundary.fixed_at_goal
        first, last, interior = path[:, 2:3], path[:, -fixed, None], path[:, 3:-fixed]
        along = along_line(interior.shape[1], path.dtype.name)
        return self._observed(
            replace(tasks, correction=interior - first - (last - first) * along), path
        )

    def _interior_points(self, boundary: Boundary) -> int:
        return self.problem.trajectory.path_control_points - 3 - boundary.fixed_at_goal

    def _observed(self, tasks: Tasks, path: Array) -> Tasks:
        """Return tasks with features of the placed obstacles along paths, if the model has such features."""
        if tasks.placed is None or self.scene_features is None:
            return tasks
        return replace(
            tasks,
            observation=self.scene_features(
                path.astype(float), tasks.placed.astype("float64")
            ),
        )

    def _placed_scene(self, count: int, obstacle_poses: Array | None) -> Scene | None:
        if not self.placed:
            if obstacle_poses is not None:
                text = f"the model's problem {self.problem.name!r} has no obstacles that plans place"
                raise UsageError(text, concerns="obstacle_poses")
            return None
        if obstacle_poses is None:
            text = "is missing: the samples of this problem place its obstacles (cnpgen.scenes, Dataset.scenes)"
            raise UsageError(text, argument="obstacle_poses")
        scene = Scene(self.placed, np.tile(place_obstacles(self.placed), (count, 1)))
        return scene.with_poses(np.asarray(obstacle_poses, np.float64))

    def _parameters(self, boundary: Boundary) -> Array | None:
        """Return the parameters of the tasks, shape (N, width), or None without any.

        Check their shape and ranges.
        """
        ranges, values = self.problem.parameters, boundary.parameters
        if values is None:
            if ranges:
                raise UsageError(
                    f"is missing: tasks have {', '.join(ranges.names)}",
                    argument="parameters",
                )
            return None
        if not ranges:
            raise UsageError(
                f"must be None: {self.problem.name!r} has no parameters",
                argument="parameters",
            )
        return ranges.checked(np.asarray(values, np.float64))

    def _velocity_limits(self, parameters: Array | None) -> Array:
        """Return the velocity limits of all tasks [rad/s], shape (n,), or of every task, shape (N, n)."""
        names = () if parameters is None else self.problem.parameters.names
        if parameters is None or "velocity_factor" not in names:
            return self.velocity_limit
        factor = parameters[:, names.index("velocity_factor"), None]
        return self.velocity_limit * factor

    def _via_offsets(self, boundary: Boundary, via_point: Array) -> Array:
        """Return offsets of lines through via points from straight ones at interior points [rad], shape (N, m, n)."""
        # A triangle over the line: zero at its ends, 1 at half its length.
        along = along_line(self._interior_points(boundary))
        offset = via_point - (boundary.start_q + boundary.goal_q) / 2
        return np.asarray((1 - np.abs(2 * along - 1)) * offset[:, None])


def make_task_preprocessor(
    problem: Problem,
    robot: Robot,
    kernels: KernelLibrary,
    config: ModelConfig,
    *,
    fixed_at_goal: int,
    placed: tuple[Obstacle, ...],
    observed: bool = False,
) -> TaskPreprocessor:
    """Load the preprocessor of a problem's tasks.

    ``observed`` is whether it computes features of placed obstacles.
    """
    # No steps if the problem has no equalities.
    steps = effective_steps(kernels, config.line_projection_steps)
    load = partial(
        kernels.load,
        steps=steps,
        fixed_at_goal=fixed_at_goal,
        within_limits=config.within_limits,
    )
    via, reach = steps and config.via_points, config.expected_time == "reach"
    shortest = config.expected_time == "travel"
    return TaskPreprocessor(
        problem,
        robot.velocity_limit,
        tips=kernels.load(tips_at_ends, fixed_at_goal=fixed_at_goal),
        line=load(line_change, with_offsets=False) if steps else None,
        reaching_time=kernels.load(reaching_time, fixed_at_goal=fixed_at_goal)
        if reach
        else None,
        via_line=load(line_change, with_offsets=True) if via else None,
        least_time=MIN_TRAVEL_TIME_S if shortest else MIN_EXPECTED_TIME_S,
        placed=placed,
        scene_features=make_scene_features(robot, problem.trajectory, kernels)
        if placed and observed
        else None,
        iterated=config.iterations > 1,
    )
