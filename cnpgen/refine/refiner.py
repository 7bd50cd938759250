"""Solver runs, fine checks and initial guesses of the refiner for one problem.

``strategy`` decides their order.
"""

from collections.abc import Iterator
from ctypes import CDLL
from dataclasses import replace
from functools import cached_property
from threading import get_ident

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.collision.collision_checker import load_collision_library
from cnpgen.kernels.collision.tree_search import EqualityKernel
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary, choose_backend, problem_kernels
from cnpgen.problems.conditions import equality_residuals
from cnpgen.problems.obstacles import table_frame_of
from cnpgen.problems.problem import Problem
from cnpgen.refine import initial_guesses
from cnpgen.refine.fine_check import FineCheck
from cnpgen.refine.grid_levels import GridLevel, GridLevels, default_grid_levels
from cnpgen.refine.options import DEFAULT_OPTIONS, RefineOptions
from cnpgen.refine.rrt_connect import TreeSearch
from cnpgen.refine.solver.bounds import (
    Bounds,
    accepted_along,
    bounds_template,
    near_ends,
)
from cnpgen.refine.solver.compiled_backend import load_step_library
from cnpgen.refine.solver.grid import make_grid
from cnpgen.refine.solver.hull_levels import (
    HullFeedback,
    HullTranscription,
    can_measure_hulls,
    without_distances,
)
from cnpgen.refine.solver.hulls import Hulls, has_clearance_constraints
from cnpgen.refine.solver.residuals import (
    CostTerm,
    choose_cost_term,
    cost_term_residuals,
    residual_counts,
    stage_jacobian,
    stage_values,
)
from cnpgen.refine.solver.sqp import Result, Settings, minimize
from cnpgen.refine.solver.transcription import (
    ResidualKernels,
    Transcription,
    cache_last,
)
from cnpgen.refine.task import MAX_JUDGED_VIOLATION, Attempt, Outcome, RefinementTask
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import pose_width
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from cnpgen.world.world import World

# Of an input plan that is used as initial guess; slower ones hardly change in a step.
MAX_INPUT_DURATION_S = 60.0
MIN_RATE_FRACTION = 1e-3  # of a plan's largest rate control point
# Of boundary states, in scaled units; DAQP may take hours for larger ones.
MAX_END_VIOLATION = 10.0
MAX_CONTINUATIONS = 4  # of a motion that was scaled in time; most need one
MAX_FEEDBACKS = 5  # of collisions between grid points to the solver
# Times slower than the bounds of speeds require: the solver changes such guesses more
# easily.
SLOWNESS = 1.6


class Refiner:
    """Solver of one problem, and the checks and initial guesses for it.

    If it ``measures_hulls``, distances of the links' hulls replace those of capsules in
    all levels, see ``cnpgen.refine.solver.hull_levels``; if it ``has_hulls``, at least
    in paths. By default kernels have the fastest backend of this machine, and control
    points are those of the problem. ``coarser`` is a refiner with these, for plans with
    several spans for each of its spans.
    """

    def __init__(
        self,
        problem: Problem,
        robot: Robot,
        *,
        kernels: KernelLibrary | None = None,
        spec: TrajectorySpec | None = None,
        options: RefineOptions = DEFAULT_OPTIONS,
        levels: GridLevels | None = None,
        coarser: "Refiner | None" = None,
    ) -> None:
        self.problem = problem
        self.robot = robot
        self.coarser = coarser
        self.spec = problem.trajectory if spec is None else spec
        self.settings = Settings(
            cost_tolerance=options.tolerance, max_iterations=options.max_iterations
        )
        if kernels is None:
            kernels = problem_kernels(problem, robot, *choose_backend(None))
        self._world = World(robot, problem.obstacle, problem.object_size)
        # The hulls of each thread.
        self._hulls = dict[int, Hulls]()
        self.measures_hulls = can_measure_hulls(problem, robot, self._world)
        self.has_hulls = self.measures_hulls or has_clearance_constraints(
            problem, robot
        )
        solved = problem
        if self.measures_hulls:
            # Distances become rows of the compiled hulls: the symbolic kernels do not
            # contain them.
            solved = without_distances(problem)
            kernels = problem_kernels(
                solved, robot, kernels.backend, kernels.cache_folder
            )
        self._kernels = kernels
        cost_term = choose_cost_term(problem, options.objective, options.weight)
        self.residual_kernels = _residual_kernels(self.spec, kernels, robot, cost_term)
        self._prepare_check(solved)
        self._prepare_levels(solved, levels)

    def _prepare_check(self, solved: Problem) -> None:
        """Prepare the check on the fine grid, by the kernels of the problem that is solved."""
        others = pose_width(self.problem.obstacle) - pose_width(solved.obstacle)
        self._kernel_poses = slice(others, None)
        self.check = FineCheck(
            solved,
            self._world,
            self.residual_kernels,
            poses=self.kernel_poses,
            penetration=self.penetration if self.measures_hulls else None,
        )
        # by how much the hulls at both ends violate their distances within the
        # tolerance [m], shape (2, m)
        self.accepted_at_ends = cache_last(
            lambda task: self.hulls.accepted_at(task.ends, task.scene.poses[0])
        )

    def _prepare_levels(self, solved: Problem, chosen: GridLevels | None) -> None:
        """Prepare the grids and the bounds of the chosen or usual levels, for the problem that is solved."""
        self.levels = chosen or default_grid_levels(self.problem, self.settings)
        levels: tuple[GridLevel, ...] = tuple(vars(self.levels).values())
        self._grids = {
            points: make_grid(self.spec, points, self.problem.path_orders)
            for points in {level.points for level in levels}
        }
        self._feedbacks = dict[int, HullFeedback]()
        self._bounds = {
            level: bounds_template(
                solved, self._world, self._grids[level.points].s, level.tightening
            )
            for level in levels
        }

    def input_variables(self, task: RefinementTask) -> Array | None:
        """Return the variables of the task's input plan, or None if it is no usable initial guess.

        Rate control points that are not positive are raised, since the variables are
        logarithms. Plans that take longer than a minute are not used.
        """
        if task.path is None or task.rate is None or not np.isfinite(task.path).all():
            return None
        if not np.isfinite(task.rate).all() or not np.any(task.rate > 0):
            return None
        motion = self.check.transcription(task)
        rate = np.maximum(task.rate, MIN_RATE_FRACTION * task.rate.max())
        return (
            motion.pack(task.path, rate)
            if motion.duration(rate) < MAX_INPUT_DURATION_S
            else None
        )

    def run_level(
        self,
        task: RefinementTask,
        level: GridLevel,
        x: Array,
        hulls: Hulls | None = None,
        extra: Array | None = None,
    ) -> Result:
        """Run the solver on one level from variables x, shape (nx,); ``hulls`` replace the capsules.

        A refiner that ``measures_hulls`` has no capsules: its hulls are rows of
        compiled code on all levels. Their required distances then grow by ``extra``
        [m], shape (K, columns), for a motion that is nearly valid.
        """
        motion = self.transcription(task, level)
        kept = extra is None or level is self.levels.path
        settings = level.settings if kept else self.levels.strict.settings
        ends = motion.end_residuals()
        bounds = self.bounds(task, level, ends)
        # No step can change the boundary states; the solver only evaluates the motion.
        if not np.nanmax(bounds.end_violations(ends)) < MAX_END_VIOLATION:
            settings = replace(settings, max_iterations=0)
        hulls = self.hulls if self.measures_hulls else hulls
        if hulls is not None:
            motion = HullTranscription(motion, hulls, task.scene.poses[0])
            more: Array | float = 0.0 if extra is None else extra
            if self.measures_hulls:
                # Near an end the hulls may be as close as the end itself, within the
                # tolerance.
                more = more - accepted_along(
                    near_ends(motion.grid.s), self.accepted_at_ends(task)
                )
            bounds = self._bounds[level].with_hull_distances(
                bounds, hulls.min_distances, more
            )
        return minimize(motion, bounds, x, settings, deadline=task.deadline)

    def transcription(self, task: RefinementTask, level: GridLevel) -> Transcription:
        """Return the transcription of a task on the grid of a level."""
        return Transcription(
            self.residual_kernels,
            self._grids[level.points],
            boundary=task.boundary,
            obstacle_poses=self.kernel_poses(task),
        )

    def kernel_poses(self, task: RefinementTask) -> Array:
        """Return the scene values that the residual kernels take, shape (width,)."""
        return task.scene.poses[0, self._kernel_poses]

    def penetration(self, task: RefinementTask, q: Array) -> float:
        """Return by how much the hulls at states q (n, K) violate their required distances above the tolerance [m]."""
        return self.hulls.violation(q, task.scene.poses[0], above_tolerance=True)

    def bounds(self, task: RefinementTask, level: GridLevel, ends: Array) -> Bounds:
        """Return the bounds of a level for a motion whose boundary states have residuals ``ends``, shape (2, m)."""
        bounds = self._bounds[level].bounds_for(task.start_xyz, ends=ends)
        reference = task.reference(self._grids[level.points].s, self.spec.degree)
        if reference is None or task.stay_within is None:
            return bounds
        return self._bounds[level].near(bounds, reference, task.stay_within)

    def solve(
        self,
        task: RefinementTask,
        level: GridLevel,
        x: Array,
        outcome: Outcome,
        hulls: Hulls | None = None,
    ) -> Attempt:
        """Run one level from variables x.

        Return the result with its violation, scaled in time where that helps.
        """
        result = self.run_level(task, level, x, hulls)
        if self.measures_hulls:
            result = self._separated(task, level, result)
        attempt = self.measured(task, result.x, outcome, result.iterations)
        # Valid at the grid points, but not between them: it passes through something
        # thin, which more points show.
        passes_through = (
            result.violation <= self.settings.violation_tolerance
            and attempt.violation > MAX_JUDGED_VIOLATION
        )
        fine = self.levels.fine
        if self.measures_hulls and passes_through and level.points < fine.points:
            finer = self.solve(task, fine, attempt.variables, outcome)
            finer = replace(finer, iterations=finer.iterations + result.iterations)
            attempt = finer if finer.is_better(attempt) else attempt
        return attempt

    def continue_scaled(self, task: RefinementTask, best: Attempt) -> Attempt:
        """Optimize a motion that was scaled in time again, while it becomes cheaper.

        Uniform time scaling makes the whole motion slower for the violation at a single
        phase.
        """
        for _ in range(MAX_CONTINUATIONS):
            if best.outcome is not Outcome.TIME_SCALED:
                break
            again = self.solve(task, self.levels.warm, best.variables, Outcome.SOLVED)
            # Uniform scaling slows the motion everywhere; another run regains the time
            # where limits have room.
            if not (again.violation <= 1 and again.cost < best.cost):
                break
            best = replace(again, iterations=best.iterations + again.iterations)
        return best

    def fed_back(
        self,
        task: RefinementTask,
        attempt: Attempt,
        phase: float,
        depth: float,
        extra: Array | None,
    ) -> tuple[Attempt, Array] | None:
        """Continue an attempt that the verdict rejected for a collision at a phase with a depth [m].

        Return the result with larger required distances there, and all additional
        distances [m], shape (K, columns), which include ``extra`` of earlier
        collisions; None without compiled hulls.
        """
        if not self.measures_hulls:
            return None
        level, path = self.levels.warm, attempt.path
        more = self._feedback(level).clearance_at(
            path, self.hulls, task.scene.poses[0], phase=phase, depth=depth
        )
        # Distances add up over the feedbacks, so that a collision that persists is
        # pushed further.
        extra = more if extra is None else extra + more
        result = self.run_level(task, level, attempt.variables, extra=extra)
        result = self._separated(task, level, result, extra)
        return self.measured(
            task, result.x, Outcome.SOLVED_FINE, result.iterations
        ), extra

    def _separated(
        self,
        task: RefinementTask,
        level: GridLevel,
        result: Result,
        extra: Array | None = None,
    ) -> Result:
        """Run a level again with larger required distances where hulls collide between its grid points."""
        feedback = self._feedback(level)
        motion = self.transcription(task, level)
        accepted = self.accepted_at_ends(task)
        for _ in range(MAX_FEEDBACKS):
            path, _ = motion.unpack(result.x)
            missing = feedback.missing_clearance(
                path, self.hulls, task.scene.poses[0], accepted=accepted
            )
            if missing is None:
                break
            extra = missing if extra is None else extra + missing
            earlier = result.iterations
            result = self.run_level(task, level, result.x, extra=extra)
            result = replace(result, iterations=earlier + result.iterations)
        return result

    def _feedback(self, level: GridLevel) -> HullFeedback:
        if level.points not in self._feedbacks:
            self._feedbacks[level.points] = HullFeedback(
                self.spec, self._grids[level.points].s
            )
        return self._feedbacks[level.points]

    def measured(
        self,
        task: RefinementTask,
        x: Array,
        outcome: Outcome,
        iterations: int = 0,
        *,
        unlimited: bool = False,
    ) -> Attempt:
        """Evaluate a motion on the fine grid.

        Scale it in time if that removes its violations.
        """
        cost, violation = self.check.measure(task, x)
        attempt = self.attempt(
            task, x, cost, outcome, iterations=iterations, violation=violation.worst
        )
        # Scaling in time keeps boundary velocities and accelerations only at rest.
        scalable = attempt.violation > 1 and task.at_rest
        return (
            self.time_scaled(task, attempt, unlimited=unlimited)
            if scalable
            else attempt
        )

    def time_scaled(
        self, task: RefinementTask, attempt: Attempt, *, unlimited: bool = False
    ) -> Attempt:
        """Scale an attempt uniformly in time; return the better of both."""
        x, cost, violation = self.check.scale_time(
            task, attempt.variables, unlimited=unlimited
        )
        scaled = self.attempt(
            task,
            x,
            cost,
            Outcome.TIME_SCALED,
            iterations=attempt.iterations,
            violation=violation.worst,
        )
        return scaled if scaled.is_better(attempt) else attempt

    def attempt(
        self,
        task: RefinementTask,
        x: Array,
        cost: float,
        outcome: Outcome,
        *,
        iterations: int,
        violation: float,
    ) -> Attempt:
        """Return the attempt with variables x."""
        path, rate = self.check.transcription(task).unpack(x)
        return Attempt(
            path=path,
            rate=rate,
            cost=cost,
            outcome=outcome,
            iterations=iterations,
            violation=violation,
            x=x,
        )

    def line_guess(self, task: RefinementTask) -> Array:
        """Return the variables of the initial guess of the coarse level: along a tip path, or a line."""
        for guess in self.tip_path_guesses(task):
            return guess
        return self.slow_guess(
            task, initial_guesses.rising_line(*self._guess_arguments(task))
        )

    def tip_path_guesses(self, task: RefinementTask) -> Iterator[Array]:
        """Yield the variables of motions along the initial tip paths of the problem's constraint."""
        constraint = self.problem.scene_constraint
        columns, poses = self.problem.scene_columns, task.scene.poses
        values = poses[0, columns.constraint]
        frame = table_frame_of(self.problem, poses[:, columns.parameters])
        start = (
            task.start_xyz if frame is None else frame.to_table(task.start_xyz[None])[0]
        )
        for polyline in (
            [] if constraint is None else constraint.initial_tip_paths(values, start)
        ):
            path = (
                polyline
                if frame is None
                else np.array([frame.to_world(point[None])[0] for point in polyline])
            )
            ends = task.boundary.start_q[0], task.boundary.goal_q[0]
            yield self.path_guess(
                task, initial_guesses.along_tip_path(self._world, *ends, path)
            )

    def even_line_guess(self, task: RefinementTask) -> Array:
        """Return the variables of the straight line at constant rate."""
        return self.slow_guess(
            task, initial_guesses.straight_line(*self._guess_arguments(task))
        )

    def other_guesses(self, task: RefinementTask) -> list[Array]:
        """Return the variables of the other initial guesses."""
        arguments = self._guess_arguments(task)
        center = (self.robot.position_lower + self.robot.position_upper) / 2
        guesses = [
            initial_guesses.straight_line(*arguments),
            initial_guesses.line_through(*arguments, configuration=self.robot.home),
            initial_guesses.quintic(*arguments),
            initial_guesses.line_through(*arguments, configuration=center),
        ]
        return [
            *self.tip_path_guesses(task),
            *(self.slow_guess(task, guess) for guess in guesses),
        ]

    def path_guess(self, task: RefinementTask, states: Array) -> Array:
        """Return the variables of a motion along a joint-space path, shape (K, n)."""
        return self.slow_guess(
            task, initial_guesses.fit_to_path(states, *self._guess_arguments(task))
        )

    def slow_guess(self, task: RefinementTask, guess: tuple[Array, Array]) -> Array:
        """Return the variables of a guess, slower where speeds other than those of joints are bounded.

        From a motion that is many times too fast the solver ends far from the feasible
        set.
        """
        interior, rate = guess
        x = np.concatenate([interior.ravel(), np.log(rate)])
        # Speeds such as that of the tip are not bounded by those of the joints, from
        # which guesses take their rates.
        factor = self.check.speed_ratio(task, x)
        return (
            x
            if factor == 1
            else np.concatenate([interior.ravel(), np.log(rate / (SLOWNESS * factor))])
        )

    def tree_search(
        self, task: RefinementTask, goals: Array | None = None
    ) -> TreeSearch:
        """Return the search for joint-space paths of a task, to any of several goals if there are, shape (G, n)."""
        hulls = self.hulls if self.has_hulls else None
        return TreeSearch(
            task,
            self.robot,
            self._library,
            self.check.at_rest(task, with_capsules=hulls is None),
            self.manifold(task),
            hulls,
            self.measures_hulls,
            goals,
        )

    def manifold(self, task: RefinementTask) -> EqualityKernel | None:
        """Return the equalities that trees keep, or None if there are none."""
        if not self.check.projects or not self.equalities.tape.outputs[0]:
            return None
        accuracy = self.check.projection_accuracy
        return EqualityKernel(self.equalities, self.kernel_poses(task), accuracy)

    @cached_property
    def equalities(self) -> Kernel:
        """The kernel of ``equality_residuals``, which only searches for paths need."""
        return self._kernels.load_by_structure(equality_residuals)

    @cached_property
    def _library(self) -> CDLL:
        return load_collision_library(self._kernels)

    @property
    def hulls(self) -> Hulls:
        """Clearances of the links' hulls, one object per thread.

        See ``has_clearance_constraints``.
        """
        thread = get_ident()
        if thread not in self._hulls:
            self._hulls[thread] = Hulls(
                self.problem, self.robot, self._library, with_object=self.measures_hulls
            )
        return self._hulls[thread]

    def _guess_arguments(
        self, task: RefinementTask
    ) -> tuple[Boundary, Array, TrajectorySpec]:
        return task.boundary, self.robot.velocity_limit, self.spec


def _residual_kernels(
    spec: TrajectorySpec,
    kernels: KernelLibrary,
    robot: Robot,
    cost_term: CostTerm | None,
) -> ResidualKernels:
    """Load the kernels of the residuals, and of the cost term if there is one."""
    residual_kernels = ResidualKernels(
        spec,
        kernels.load_by_structure(stage_values),
        kernels.load_by_structure(stage_jacobian),
        load_step_library(kernels),
    )
    if cost_term is None:
        return residual_kernels
    return replace(
        residual_kernels,
        cost_term=cost_term,
        cost_residuals=kernels.load_by_structure(
            cost_term_residuals, terms=cost_term.tables
        ),
        cost_counts=residual_counts(robot, cost_term),
    )
