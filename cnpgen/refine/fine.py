"""Residuals on a grid much finer than the optimiser's, and the uniform slow-down that some of them call for."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.bounds import NONE, BoundsTemplate
from cnpgen.refine.solver.grid import make_grid
from cnpgen.refine.solver.transcription import ResidualKernels, Transcription, of_last
from cnpgen.refine.task import Task
from cnpgen.robots.solid import count_numbers

if TYPE_CHECKING:
    from cnpgen.world.state import World

Array = NDArray[np.float64]
POINTS = 600
ATTEMPTS = 6
ROUNDING = 1e-12  # of scaled residuals; less cannot be told from what is exactly allowed
CERTAIN = 1.5  # times what is allowed: the bounds near an end are not quite those at it
LARGEST = 1.25  # a motion that must be slower than this is another motion: the optimiser finds a better one


@dataclass(frozen=True)
class Excess:
    """By how much residuals exceed their bounds.

    Attributes:
        worst: The largest excess as a multiple of what is allowed; inf where something is not finite.
        position: Whether a condition on q alone is exceeded by more than allowed.
        slower: By which factor the motion must be slowed down for the worst velocity, acceleration, torque and jerk, if
            those scaled with the rate, its square and its cube; at least 1.
    """

    worst: float
    position: bool
    slower: float


@dataclass(frozen=True)
class AtRest:
    """What the residuals of a robot at rest must be on the way of one task, shape (m,) each.

    Attributes:
        lower: Their lower bounds.
        upper: Their upper bounds.
        capsules: Which are clearances of capsules.
        equal: Which are equalities that positions alone meet.
    """

    lower: Array
    upper: Array
    capsules: NDArray[np.bool_]
    equal: NDArray[np.bool_]


class FineCheck:
    """The fine check of motions of one problem.

    Args:
        problem: The problem.
        world: Any world of it.
        stage: The kernels.

    Attributes:
        equalities: Names of the conditions that allow one value only.
    """

    def __init__(self, problem: Problem, world: "World", stage: ResidualKernels) -> None:
        self._grid = make_grid(stage.spec, POINTS, problem.path_orders)
        self._last = of_last(lambda task: Transcription(stage, self._grid, boundary=task.boundary, tops=task.tops))
        self._bounds = BoundsTemplate(problem, world, self._grid.s, NONE)
        conditions = self._bounds.conditions
        self.equalities = {each.name for each in conditions if each.is_equality}
        limits = np.repeat([each.exactness == "limit" for each in conditions], [len(each.g) for each in conditions])
        self._speeds = np.flatnonzero((self._bounds.needs == 1) & ~limits)  # what is bounded besides joint velocities
        self._powers = _powers_of_rate(problem, world, stage)[self._speeds] if len(self._speeds) else np.empty(0)

    def transcription(self, task: Task) -> Transcription:
        """Return the motion on the fine grid; for one task it is asked for many times."""
        return self._last(task)

    def measure(self, task: Task, x: Array) -> tuple[float, Excess]:
        """Return the objective [s] and the excess of a motion, whose variables are x of shape (nx,)."""
        motion = self.transcription(task)
        cost, g = motion.measured(x)
        bounds = self._bounds.of(task.start_xyz)
        with np.errstate(invalid="ignore"):
            ratio = bounds.excess(g) / np.maximum(self._bounds.allowed, ROUNDING)
        worst = float(ratio.max())
        if not np.isfinite(worst):
            return cost, Excess(np.inf, True, np.inf)
        if worst <= 1:
            return cost, Excess(worst, False, 1.0)
        high = ratio > 1
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.where(high, g / np.where(g > bounds.upper, bounds.upper, bounds.lower), 0.0).max(axis=0)
            size[self._speeds] **= 1 / self._powers
        speed, strength, jerk = (size[self._bounds.needs == needs].max(initial=1.0) for needs in (1, 2, 3))
        slower = max(speed, float(np.sqrt(strength)), float(np.cbrt(jerk)))
        return cost, Excess(worst, bool(high[:, self._bounds.needs == 0].any()), slower)

    def bounds_at_rest(self, task: Task) -> AtRest:
        """Return the bounds half way, with tolerances but for those of clearances of capsules."""
        bounds, middle, capsules = self._bounds.of(task.start_xyz), POINTS // 2, self._bounds.capsules
        allowed = np.where(capsules, 0.0, self._bounds.allowed)
        equal = self._bounds.equal & (self._bounds.needs == 0)
        return AtRest(bounds.lower[middle] - allowed, bounds.upper[middle] + allowed, capsules, equal)

    def too_fast(self, task: Task, x: Array) -> float:
        """Return by which factor a motion is too fast for bounds of speeds other than those of joints; 1 if it is not.

        Starts meet the velocity limits of joints; of the tip, or of whatever a plug-in bounds, they know nothing.
        """
        if not len(self._speeds):
            return 1.0
        g, upper = self.transcription(task).measured(x)[1], self._bounds.of(task.start_xyz).upper
        with np.errstate(divide="ignore", invalid="ignore"):
            over = np.nanmax(g[:, self._speeds] / upper[:, self._speeds], axis=0)
        return max(float(np.max(np.maximum(over, 0.0) ** (1 / self._powers))), 1.0)

    def refutes_ends(self, task: Task) -> bool:
        """Whether the boundary conditions alone exceed a bound, by more than the tolerance: no motion will do."""
        return bool(np.nanmax(self._excess_of_ends(task)) > CERTAIN)

    def imprecision_of_ends(self, task: Task) -> float:
        """By how much the boundary conditions alone miss an equality, as a multiple of what is allowed."""
        return float(np.fmax.reduce(self._excess_of_ends(task)[:, self._bounds.equal], axis=None, initial=0.0))

    def _excess_of_ends(self, task: Task) -> Array:
        bounds, motion = self._bounds.of(task.start_xyz), self.transcription(task)
        return np.asarray(bounds.beyond(motion.end_residuals()) / np.maximum(self._bounds.allowed, ROUNDING))

    def slow_down(
        self, task: Task, motion: Transcription, x: Array, *, at_any_cost: bool = False
    ) -> tuple[Array, float, Excess]:
        """Slow a motion from rest to rest down uniformly until all limits that it helps against are met.

        Its path stays, its rate is divided by one factor. That cures no position and no torque against gravity: where
        these are broken, too, nothing is done, unless it is asked for at any cost.

        Returns:
            ``(variables, objective, excess)`` of the slowed motion, or of the last one tried.
        """
        total = 1.0
        cost, excess = self.measure(task, x)
        for _ in range(ATTEMPTS):
            if excess.worst <= 1 or excess.slower <= 1 or not np.isfinite(excess.slower):
                break
            if not at_any_cost and (excess.position or total * excess.slower > LARGEST):
                break
            total *= excess.slower * (1 + 1e-9)
            x = x.copy()
            x[motion.split :] -= np.log(excess.slower * (1 + 1e-9))
            cost, excess = self.measure(task, x)
        return x, cost, excess


def _powers_of_rate(problem: Problem, world: "World", stage: ResidualKernels) -> Array:
    """Return with which power of the rate every residual grows, at least 1, where it depends on velocities: (m,)."""
    n, orders, random = world.robot.n, problem.path_orders, np.random.default_rng(0)
    w = np.zeros((orders * n + orders - 1, 2))
    w[: 2 * n] = random.uniform(0.1, 1.0, (2 * n, 1))
    w[orders * n] = 1.0, 2.0
    (g,) = stage.values(w, np.zeros((count_numbers(problem.obstacle), 2)))
    with np.errstate(divide="ignore", invalid="ignore"):
        powers = np.log2(g[:, 1] / g[:, 0]).round()
    return np.asarray(np.maximum(np.nan_to_num(powers, nan=1.0, posinf=1.0), 1.0))
