"""Residuals on a grid finer than the solver's, and uniform time scaling of motions that violate their limits."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.collision.tree_search import RestConditions
from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.bounds import NO_TIGHTENING, bounds_template
from cnpgen.refine.solver.grid import make_grid
from cnpgen.refine.solver.transcription import (
    ResidualKernels,
    Transcription,
    cache_last,
)
from cnpgen.refine.task import RefinementTask
from cnpgen.world.world import World

FINE_POINTS = 600
PENETRATION_SCALE_M = 1e-4  # of violated distances without a tolerance of their own
# Of one motion, each by the factor that its largest violation requires.
MAX_SCALINGS = 6
MIN_RESIDUAL_TOLERANCE = 1e-12  # of scaled residuals: below rounding errors
# A motion that must be slower by more is left to the solver, which finds a better one.
MAX_SCALING = 1.25


@dataclass(frozen=True)
class GridViolation:
    """Largest violation of the bounds on the fine grid."""

    # Largest violation as a multiple of its tolerance; inf where a residual is not
    # finite.
    worst: float
    position: bool  # whether a condition on q alone violates its tolerance
    # Factor of the duration, at least 1, that removes the worst violations of velocity,
    # acceleration, torque and jerk. These scale with the rate, its square and its cube.
    time_scale: float


class FineCheck:
    """Evaluation of motions of one problem on the fine grid.

    ``poses`` returns the scene values of a task that the kernels take. ``penetration``
    returns by how much distances that the kernels do not compute are violated above
    their tolerance at states (n, K) [m].
    """

    def __init__(
        self,
        problem: Problem,
        world: World,
        kernels: ResidualKernels,
        *,
        poses: Callable[[RefinementTask], Array],
        penetration: Callable[[RefinementTask, Array], float] | None = None,
    ) -> None:
        self._penetration = penetration
        self._kernels = kernels
        self._poses = poses
        self._grid = make_grid(kernels.spec, FINE_POINTS, problem.path_orders)
        self.transcription = cache_last(
            lambda task: Transcription(
                kernels, self._grid, boundary=task.boundary, obstacle_poses=poses(task)
            )
        )
        self._bounds = bounds_template(problem, world, self._grid.s, NO_TIGHTENING)
        conditions = self._bounds.conditions
        self.equalities = {
            condition.name for condition in conditions if condition.is_equality
        }
        # Whether trees of paths project their states.
        self.projects = bool(self.equalities) or any(
            condition.projected for condition in conditions
        )
        self.projection_accuracy = self._bounds.projection_accuracy
        limits = np.repeat(
            [condition.tolerance_kind == "limit" for condition in conditions],
            [len(condition.g) for condition in conditions],
        )
        # Bounded speeds other than those of joints.
        self._speeds = np.flatnonzero((self._bounds.orders == 1) & ~limits)
        self._powers = (
            _powers_of_rate(problem, world, kernels)[self._speeds]
            if len(self._speeds)
            else np.empty(0)
        )

    def measure(self, task: RefinementTask, x: Array) -> tuple[float, GridViolation]:
        """Return the objective [s] and the largest violation of a motion with variables x, shape (nx,)."""
        motion = self.transcription(task)
        cost, g = motion.measured(x)
        bounds = self._bounds.bounds_for(task.start_xyz)
        with np.errstate(invalid="ignore"):
            ratio = bounds.violations(g) / np.maximum(
                self._bounds.tolerances, MIN_RESIDUAL_TOLERANCE
            )
        worst = float(ratio.max())
        if not np.isfinite(worst):
            return cost, GridViolation(np.inf, True, np.inf)
        excess = (
            -1.0
            if self._penetration is None
            else self._penetration(task, motion.positions(x))
        )
        # The excess is above the tolerance: even the smallest counts as above 1.
        collision = 1.0 + excess / PENETRATION_SCALE_M if excess > 0 else 0.0
        if max(worst, collision) <= 1:
            return cost, GridViolation(worst, False, 1.0)
        violated = ratio > 1
        with np.errstate(divide="ignore", invalid="ignore"):
            # Ratio of a residual to the bound that it violates.
            size = np.where(
                violated,
                g / np.where(g > bounds.upper, bounds.upper, bounds.lower),
                0.0,
            ).max(axis=0)
            # A residual that grows with the power p of the rate needs the p-th root of
            # its ratio.
            size[self._speeds] **= 1 / self._powers
        speed, strength, jerk = (
            size[self._bounds.orders == order].max(initial=1.0) for order in (1, 2, 3)
        )
        # Scaling time by k divides velocities by k, accelerations and torques by k^2,
        # jerks by k^3.
        time_scale = max(speed, float(np.sqrt(strength)), float(np.cbrt(jerk)))
        position = collision > 1 or bool(violated[:, self._bounds.orders == 0].any())
        return cost, GridViolation(max(worst, collision), position, time_scale)

    def at_rest(self, task: RefinementTask, *, with_capsules: bool) -> RestConditions:
        """Return the conditions of a robot at rest halfway along the motion, relaxed by tolerances except for clearances.

        Without capsules the clearances of the links do not hold.
        """
        bounds = self._bounds.bounds_for(task.start_xyz)
        half = FINE_POINTS // 2
        capsules = self._bounds.capsules
        tolerances = np.where(
            capsules | self._bounds.held_clearances, 0.0, self._bounds.tolerances
        )
        if not with_capsules:
            tolerances = np.where(capsules, np.inf, tolerances)
        values = self._kernels.values
        width, n = values.tape.inputs[0], task.boundary.start_q.shape[1]
        w = np.zeros(width)
        # The rate follows the orders of the path, w = (p, p', ..., r, r', ...).
        w[(width + 1) // (n + 1) * n] = 1.0
        return RestConditions(
            values,
            w,
            self._poses(task),
            bounds.lower[half] - tolerances,
            bounds.upper[half] + tolerances,
        )

    def speed_ratio(self, task: RefinementTask, x: Array) -> float:
        """Return the factor by which a motion exceeds bounds of speeds other than those of joints, at least 1.

        Initial guesses respect the velocity limits of the joints only, not those of the
        tip or of a plug-in.
        """
        if not len(self._speeds):
            return 1.0
        g = self.transcription(task).measured(x)[1]
        upper = self._bounds.bounds_for(task.start_xyz).upper
        with np.errstate(divide="ignore", invalid="ignore"):
            over = np.nanmax(g[:, self._speeds] / upper[:, self._speeds], axis=0)
        return max(float(np.max(np.maximum(over, 0.0) ** (1 / self._powers))), 1.0)

    def end_equality_error(self, task: RefinementTask) -> float:
        """Return the largest error of the boundary conditions in an equality, as a multiple of its tolerance."""
        return float(
            np.fmax.reduce(
                self._end_violations(task)[:, self._bounds.equal],
                axis=None,
                initial=0.0,
            )
        )

    def _end_violations(self, task: RefinementTask) -> Array:
        bounds = self._bounds.bounds_for(task.start_xyz)
        motion = self.transcription(task)
        violations = bounds.end_violations(motion.end_residuals())
        return np.asarray(
            violations / np.maximum(self._bounds.tolerances, MIN_RESIDUAL_TOLERANCE)
        )

    def scale_time(
        self, task: RefinementTask, x: Array, *, unlimited: bool = False
    ) -> tuple[Array, float, GridViolation]:
        """Scale a motion from rest to rest uniformly in time until it meets its limits.

        The path is unchanged; the rate is divided by one factor. This does not reduce
        violations of positions or of torques that gravity causes. Motions with such
        violations are scaled only if ``unlimited``. The result is ``(variables,
        objective, violation)`` of the scaled motion, or of the last one tried.
        """
        total = 1.0
        split = self.transcription(task).split
        cost, violation = self.measure(task, x)
        for _ in range(MAX_SCALINGS):
            if (
                violation.worst <= 1
                or violation.time_scale <= 1
                or not np.isfinite(violation.time_scale)
            ):
                break
            if not unlimited and (
                violation.position or total * violation.time_scale > MAX_SCALING
            ):
                break
            total *= violation.time_scale * (1 + 1e-9)
            x = x.copy()
            # The variables are log r: dividing the rate is a subtraction.
            x[split:] -= np.log(violation.time_scale * (1 + 1e-9))
            cost, violation = self.measure(task, x)
        return x, cost, violation


def _powers_of_rate(problem: Problem, world: World, kernels: ResidualKernels) -> Array:
    """Return the power of the rate with which every residual of velocities grows, at least 1, shape (m,)."""
    n = world.robot.n
    orders = problem.path_orders
    random = np.random.default_rng(0)
    w = np.zeros((orders * n + orders - 1, 2))
    # Random p and p' at the rates 1 and 2: the ratio of the residuals is 2^power.
    w[: 2 * n] = random.uniform(0.1, 1.0, (2 * n, 1))
    w[orders * n] = 1.0, 2.0
    scene = np.zeros((problem.scene_width, 2))
    scene[problem.scene_columns.parameters] = world.robot.nominal_parameters[:, None]
    (g,) = kernels.values(w, scene)
    with np.errstate(divide="ignore", invalid="ignore"):
        powers = np.log2(g[:, 1] / g[:, 0]).round()
    return np.asarray(np.maximum(np.nan_to_num(powers, nan=1.0, posinf=1.0), 1.0))
