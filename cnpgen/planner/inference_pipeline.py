"""Run the steps before and after the network: prepare tasks, project paths and fit rates to the limits.

Plans that violate static conditions are planned again along alternative lines through
via points of the model.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.kernels.kernel import GridKernel, Kernel
from cnpgen.kernels.library import KernelLibrary, choose_backend, problem_kernels
from cnpgen.kernels.tape import GridSpec
from cnpgen.planner.control_point_functions import projected_path
from cnpgen.planner.control_points import lines_at_rest
from cnpgen.planner.expressions import effective_steps, static_violation
from cnpgen.planner.model import Model, ModelConfig, Outputs, outputs_of
from cnpgen.planner.task_preprocessor import TaskPreprocessor, make_task_preprocessor
from cnpgen.planner.tasks import Tasks, ends_of, lanes, rows
from cnpgen.planner.time_parametrization import (
    TimeParametrization,
    make_time_parametrization,
)
from cnpgen.planner.time_scaling import (
    TimeScaling,
    blocks_of_motions,
    make_time_scaling,
)
from cnpgen.plans.plans import Plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.robots.robot import Robot
from cnpgen.schema.unchecked import unchecked
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectory.boundary import Boundary, anchor_line
from cnpgen.trajectory.spline import basis, chebyshev
from cnpgen.trajectory.spline_motion import Motion

# In expected times, above which a motion nearer to the straight line may be faster.
SLOW_DURATION = 1.8
OFFSET_FRACTION = 0.5  # of the offsets from the line that such motions keep
STATIC_INTERVALS = 32  # between phases
COARSE_PHASES = slice(2, None, 4)  # that most violating motions fail at
MOTIONS_PER_CALL = 512  # of the kernel
MAX_LINES = 4  # that motions are planned along


@dataclass(frozen=True)
class ViaPoints:
    """Via points of one problem's model, and the check of static conditions; made by ``make_via_points``.

    Attributes:
        via_points: Configurations [rad], shape (M, n).
        static_violation: Kernel of ``expressions.static_violation`` at phases of
            motions, in single precision.
        path: Basis of p at K phases, shape (K, C), float32.
    """

    via_points: Array
    static_violation: GridKernel
    path: NDArray[np.float32]

    def violation(self, motion: Motion, obstacle_poses: Array) -> Array:
        """Return the largest violation of conditions on positions and holding torques by N motions, in tolerances.

        It is at most 1 if all conditions hold at the phases, and inf if a position is
        not finite.
        """
        return self._violation_at(self.path, motion.path, obstacle_poses)

    def lower_bound(self, motion: Motion, obstacle_poses: Array) -> Array:
        """Return lower bounds of ``violation`` that are above 1 for the same motions, in a fraction of the time.

        Motions with a violation at one of a few phases are not checked at the others.
        """
        bound = self._violation_at(
            self.path[COARSE_PHASES], motion.path, obstacle_poses
        )
        # A violation at a few phases is enough; motions without one are checked at all.
        unclear = np.flatnonzero(bound <= 1)
        bound[unclear] = self.violation(motion[unclear], obstacle_poses[unclear])
        return bound

    def _violation_at(
        self, basis_of_p: NDArray[np.float32], path: Array, obstacle_poses: Array
    ) -> Array:
        # float32 suffices to compare motions.
        values = np.empty((1, len(basis_of_p), len(path)), np.float32)
        for block in blocks_of_motions(len(path), MOTIONS_PER_CALL):
            q = np.matmul(
                basis_of_p, path[block].transpose(2, 1, 0).astype(np.float32, order="C")
            )
            poses = obstacle_poses[block].T.astype(np.float32, order="C")
            self.static_violation(q, poses, out=[values[..., block]])
        worst: Array = values[0].max(axis=0).astype(np.float64)
        # A motion that is not finite is worse than any other.
        return np.nan_to_num(worst, nan=np.inf, posinf=np.inf)

    def best_lines(self, lines: Tasks, count: int) -> NDArray[np.intp]:
        """Return the rows of the ``count`` lines of every task with the smallest violations at a few phases.

        The lines are all M lines of the first task, then of the next one.
        """
        assert lines.correction is not None
        path = lines_at_rest(lines.boundary, lines.correction)
        violation = self._violation_at(
            self.path[COARSE_PHASES], path, lines.scene.poses
        )
        # The lines of a task are adjacent rows, one for each via point.
        order = violation.reshape(-1, len(self.via_points)).argsort(
            axis=1, kind="stable"
        )[:, :count]
        return np.asarray(
            (order + len(self.via_points) * np.arange(len(order))[:, None]).ravel()
        )

    @staticmethod
    def candidates(violation: Array, count: int) -> NDArray[np.intp]:
        """Return rows of motions: for every task those without violation, or else the one with the smallest.

        Violations, shape (N count,), are those along ``count`` lines of the first task,
        then of the next one.
        """
        of_task = violation.reshape(-1, count)
        least = of_task.min(axis=1, keepdims=True)
        # Violations up to 1 are within the tolerances; all such motions compete by
        # their durations.
        return np.flatnonzero(of_task <= np.maximum(least, 1))


def make_via_points(
    problem: Problem, kernels: KernelLibrary, via_points: Array
) -> ViaPoints:
    """Load the check of via points [rad], shape (M, n), for one problem."""
    spec = problem.trajectory
    # Chebyshev phases are dense near both ends.
    path = basis(chebyshev(STATIC_INTERVALS), spec.path_control_points, spec.degree)
    kernel = kernels.load_grid(
        static_violation, GridSpec(("point", "lane"), ("point",)), dtype="float32"
    )
    return ViaPoints(via_points, kernel, path.astype(np.float32))


@dataclass(frozen=True)
class LoadedProblem:
    """A problem loaded from its record, and the kernels of ``problem.for_planning``.

    The URDF file exists only inside ``loaded_problem``.
    """

    record: ProblemRecord
    problem: Problem
    robot: Robot
    kernels: KernelLibrary


@contextmanager
def loaded_problem(
    record: ProblemRecord, backend: str | None = None
) -> Iterator[LoadedProblem]:
    """Load a problem from its record, with its URDF file until the context is left, and the fastest backend by default.

    Raises:
        CnpgenError: The record does not fit this version of cnpgen, or a dependency is
            missing.
    """
    chosen, folder = choose_backend(backend)
    with record.restored() as problem:
        robot = load_robot(problem)
        yield LoadedProblem(
            record,
            problem,
            robot,
            problem_kernels(problem.for_planning, robot, chosen, folder),
        )


@dataclass(frozen=True)
class InferencePipeline:
    """Steps that make plans from network outputs, for one problem; those that its model does not use are None.

    ``path`` is the kernel of ``control_point_functions.projected_path``.
    """

    prepare: TaskPreprocessor
    path: Kernel
    time_scaling: TimeScaling | None
    time_parametrization: TimeParametrization | None = None
    via_points: ViaPoints | None = None

    def plan(
        self,
        model: Model,
        boundary: Boundary,
        *,
        sample_id: NDArray[np.int64] | None = None,
        columns: Mapping[str, Array] | None = None,
    ) -> Plans:
        """Plan N motions; see ``Planner.plan_batch``."""
        tasks, motion = self.planned(
            model, boundary, (columns or {}).get(OBSTACLE_POSES)
        )
        columns = {
            **(columns or {}),
            "start_xyz": tasks.start_xyz,
            "goal_xyz": tasks.goal_xyz,
        }
        plans = unchecked(
            Plans,
            model.problem,
            boundary,
            motion.path,
            motion.rate,
            motion.degree,
            columns,
            np.arange(len(boundary)) if sample_id is None else sample_id,
            np.zeros(len(boundary), np.uint8),  # unknown
            "",
            "",
            False,
        )
        # All other shapes follow from the model.
        if sample_id is not None or len(columns) > 2:
            plans.__post_init__()
        return plans

    def planned(
        self, model: Model, boundary: Boundary, obstacle_poses: Array | None = None
    ) -> tuple[Tasks, Motion]:
        """Plan N motions; return the tasks with the selected lines, and the motions."""
        ends = ends_of(boundary)
        tasks = self.prepare(boundary, ends=ends, obstacle_poses=obstacle_poses)
        motion = self._projected(model, tasks, ends)
        if self.via_points is None:
            return tasks, self._fitted(motion, tasks.scene.poses)
        return self._with_via_points(self.via_points, model, tasks, motion)

    def motion(self, model: Model, tasks: Tasks) -> Motion:
        """Evaluate the network, project its paths onto the equalities, and fit the rates to the limits."""
        return self._fitted(
            self._projected(model, tasks, ends_of(tasks.boundary)), tasks.scene.poses
        )

    def _projected(self, model: Model, tasks: Tasks, ends: Array) -> Motion:
        outputs, path = self._outputs(model, tasks, ends)
        for _ in range(1, model.config.iterations):
            # Each further evaluation corrects the path of the one before.
            outputs, path = self._outputs(model, self.prepare.along(tasks, path), ends)
        return unchecked(Motion, path, outputs.rate, model.problem.trajectory.degree)

    def _outputs(
        self, model: Model, tasks: Tasks, ends: Array
    ) -> tuple[Outputs, Array]:
        """Evaluate the network; return its outputs, and the projected path, shape (N, C, n)."""
        outputs = outputs_of(model, tasks)
        (path,) = self.path(
            ends, lanes(outputs.offsets), lanes(outputs.rate), tasks.scene.lanes
        )
        return outputs, rows(path, tasks.boundary.start_q.shape[1])

    def _fitted(self, motion: Motion, obstacle_poses: Array) -> Motion:
        beyond_limits: slice | NDArray[np.bool_] = slice(None)
        if self.time_parametrization is not None:
            motion, meets_limits = self.time_parametrization.parametrize(
                motion, obstacle_poses
            )
            beyond_limits = ~meets_limits
        if self.time_scaling is None:
            return motion
        # Uniform time scaling slows those motions that are still beyond their limits.
        factor = np.ones(len(motion))
        factor[beyond_limits] = self.time_scaling.factor(
            motion[beyond_limits], obstacle_poses[beyond_limits]
        )
        # A factor of 1 leaves the rates to the bit.
        return motion if factor.max(initial=1.0) <= 1 else motion.time_scaled(factor)

    def _with_via_points(
        self, via_points: ViaPoints, model: Model, tasks: Tasks, motion: Motion
    ) -> tuple[Tasks, Motion]:
        """Fit the rates of motions.

        Replace violating and slow ones by better ones through via points or straighter.
        """
        path, rate = motion.path.copy(), motion.rate.copy()
        violation = via_points.violation(motion, tasks.scene.poses)
        fitted, kept = np.empty_like(rate), np.ones(len(path), bool)
        correction = np.zeros_like(path[:, self._interior(tasks.boundary)])
        correction += 0.0 if tasks.correction is None else tasks.correction
        violating = np.flatnonzero(violation > 1)
        # Blocks limit the memory: each violating task has several lines.
        for some in (violating[block] for block in blocks_of_motions(len(violating))):
            other, *values = self._fastest_alternatives(via_points, model, tasks, some)
            # An alternative that violates as much as the first plan does not replace
            # it.
            better = values[0] < violation[some]
            replaced = some[better]
            path[replaced], rate[replaced] = other.path[better], other.rate[better]
            for array, value in zip(
                (violation, fitted, correction), values, strict=True
            ):
                array[replaced] = value[better]
            kept[replaced] = False
        # Rates are fitted once each: of replaced motions above, of all others here.
        fitted[kept] = self._fitted(motion[kept], tasks.scene.poses[kept]).rate
        self._shorten(
            via_points, tasks, Motion(path, rate, motion.degree), fitted, violation
        )
        tasks = replace(tasks, correction=correction)
        return tasks, Motion(path, fitted, motion.degree)

    def _fastest_alternatives(
        self, via_points: ViaPoints, model: Model, tasks: Tasks, some: NDArray[np.intp]
    ) -> tuple[Motion, Array, Array, Array]:
        """Plan some tasks along lines through via points; return the fastest motion of each without violation.

        If all have one it is that with the smallest. Their violations, fitted rates and
        the offsets of their lines follow.
        """
        count = min(MAX_LINES, len(via_points.via_points))
        repeated = np.repeat(some, len(via_points.via_points))
        lines = self.prepare(
            tasks.boundary[repeated], np.tile(via_points.via_points, (len(some), 1))
        )
        # The lines themselves are ranked first, since planning along all of them costs
        # more.
        alternatives = lines.take(via_points.best_lines(lines, count))
        assert alternatives.correction is not None
        motions = self._projected(model, alternatives, ends_of(alternatives.boundary))
        poses, time = alternatives.scene.poses, np.full(len(motions), np.inf)
        violation = via_points.lower_bound(motions, poses)
        candidates = via_points.candidates(violation, count)
        fitted = self._fitted(motions[candidates], poses[candidates])
        # Motions that are no candidates keep an infinite time, and are never the
        # fastest.
        time[candidates] = fitted.duration_bound()
        fastest = time.reshape(-1, count).argmin(axis=1) + count * np.arange(len(some))
        unclear = fastest[violation[fastest] > 1]  # lower bounds
        violation[unclear] = via_points.violation(motions[unclear], poses[unclear])
        return (
            motions[fastest],
            violation[fastest],
            fitted.rate[np.searchsorted(candidates, fastest)],
            alternatives.correction[fastest],
        )

    def _shorten(
        self,
        via_points: ViaPoints,
        tasks: Tasks,
        motion: Motion,
        fitted: Array,
        violation: Array,
    ) -> None:
        """Move slow motions without violation nearer to the straight line in place, if they become faster."""
        bound = replace(motion, rate=fitted).duration_bound()
        slow = np.flatnonzero(
            (violation <= 1) & (bound > SLOW_DURATION * tasks.expected_time)
        )
        if not len(slow):
            return
        some, rate = tasks.take(slow), lanes(motion.rate[slow])
        interior = motion.path[slow, self._interior(tasks.boundary)]
        offsets = interior - anchor_line(some.boundary, motion.rate[slow], motion.spec)
        # A part of the offsets leads the path between its line and the straight one.
        part = lanes((OFFSET_FRACTION * offsets).reshape(len(slow), -1))
        (path,) = self.path(ends_of(some.boundary), part, rate, some.scene.lanes)
        path, poses = rows(path, motion.path.shape[2]), some.scene.poses
        other = Motion(path, motion.rate[slow], motion.degree)
        free = np.flatnonzero(via_points.lower_bound(other, poses) <= 1)
        other = self._fitted(other[free], poses[free])
        # Shorter motions replace the others only if they have no violation either.
        faster = other.duration_bound() < bound[slow[free]]
        replaced = slow[free[faster]]
        motion.path[replaced], fitted[replaced] = other.path[faster], other.rate[faster]

    @staticmethod
    def _interior(boundary: Boundary) -> slice:
        """Control points of the path that the boundary conditions leave free."""
        return slice(3, -boundary.fixed_at_goal)


def make_inference_pipeline(
    loaded: LoadedProblem,
    config: ModelConfig,
    *,
    scale_time: bool,
    fixed_at_goal: int = 2,
    observed: bool = True,
) -> InferencePipeline:
    """Load the inference pipeline of a problem.

    ``scale_time`` is for motions from rest to rest only.
    """
    problem, robot, kernels = loaded.problem.for_planning, loaded.robot, loaded.kernels
    prepare = make_task_preprocessor(
        problem,
        robot,
        kernels,
        config,
        fixed_at_goal=fixed_at_goal,
        placed=loaded.problem.sample_obstacles,
        observed=observed,
    )
    path = kernels.load(
        projected_path,
        steps=effective_steps(kernels, config.projection_steps),
        fixed_at_goal=fixed_at_goal,
        within_limits=config.within_limits,
    )
    # Scaling in time would change velocities at ends that are not at rest.
    time_scaling = make_time_scaling(problem, robot, kernels) if scale_time else None
    time_parametrization = (
        make_time_parametrization(problem, robot, kernels, at_rest=scale_time)
        if config.time_parametrized
        else None
    )
    via_points = None
    if config.via_points:
        via_points = make_via_points(problem, kernels, np.array(config.via_points))
    return InferencePipeline(
        prepare, path, time_scaling, time_parametrization, via_points
    )
