"""Bounds of the residuals on a grid: the problem's, tightened between the points where nothing else looks."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.needs import measured_needs
from cnpgen.problems.constraints.self_clearance import SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.residuals import DISTANCE, residual_scale

if TYPE_CHECKING:
    from cnpgen.world.state import World

Array = NDArray[np.float64]
ENDS = (0, 1, 2, 4, 7, 11)  # grid points from either end where accelerations leap with the last rate control points
EASE = (0.1, 0.3)  # phases between which a motion must leave what its ends exceed within the tolerances
NEGLIGIBLE = 1e-5  # of scaled residuals: iterations end with larger violations than that
UNTOLD = 1e9  # so many scaled units are allowed where only the verdict can tell
SOONER = 1.03  # funnels close that much sooner: motions overshoot where they turn level
PRECISE = 0.1  # of an equality's tolerance is what plans should miss it by at most
FULL = 0.9  # of what residuals may be beyond their bounds between grid points, by what four of these say


@dataclass(frozen=True)
class Tightening:
    """How much smaller than the problem's the bounds are, because residuals overshoot between grid points.

    Attributes:
        limit: Fraction of acceleration, torque and jerk limits.
        gentle: Fraction of position and velocity limits (boundary velocities sit on the limit).
        clearance: Distance added to clearances [m].
        band: Half width of equalities, as a fraction of their tolerance.
        edge: Phase over which it fades in from either end: boundary states may sit on a limit.
    """

    limit: float
    gentle: float
    clearance: float
    band: float
    edge: float


NONE = Tightening(limit=0.0, gentle=0.0, clearance=0.0, band=0.0, edge=1.0)


@dataclass(frozen=True)
class Bounds:
    """Bounds of the residuals on the grid, in scaled units.

    Attributes:
        lower: Shape (K, m), -inf where there is none.
        upper: Shape (K, m).
        sharp: Which residuals leap with the last rate control points, shape (K, m): those of accelerations and jerks at
            the ends.
        spare: How far beyond them residuals may be between grid points, shape (K, m): as far as the verdict allows, or,
            where they are equalities, as is precise beside what their ends miss; inf where nothing is known.
    """

    lower: Array
    upper: Array
    sharp: NDArray[np.bool_]
    spare: Array

    @property
    def accelerated(self) -> NDArray[np.bool_]:
        """Which residuals accelerations or jerks are in, shape (m,)."""
        return np.asarray(self.sharp.any(axis=0))

    def excess(self, g: Array) -> Array:
        """How far residuals g are outside, shape (K, m); negative inside."""
        return np.maximum(g - self.upper, self.lower - g)

    def beyond(self, ends: Array) -> Array:
        """By how much boundary states with residuals ``ends`` are outside, shape (2, m); nan where they are nan."""
        return np.maximum(ends - self.upper[[0, -2]], self.lower[[0, -2]] - ends)

    def violation(self, g: Array) -> float:
        """Worst violation of residuals g, shape (K, m); inf where g is not finite."""
        worst = float(self.excess(g).max())
        return max(worst, 0.0) if np.isfinite(worst) else np.inf

    def tightened(self, g: Array, midway: Array) -> "Bounds | None":
        """Return bounds that are tighter where residuals g, shape (K, m), hide too much between grid points, or None.

        Args:
            g: Residuals.
            midway: As ``Grid.midway``.
        """
        middle = sum(weights[:, None] * g[k : k + len(midway)] for k, weights in enumerate(midway.T))
        left, right = slice(1, -2), slice(2, -1)  # of the intervals between the second and the last but one
        spare = FULL * np.minimum(self.spare[left], self.spare[right])
        above = middle - np.maximum(self.upper[left], self.upper[right]) - spare
        below = np.minimum(self.lower[left], self.lower[right]) - middle - spare
        if not (above.max() > 0 or below.max() > 0):
            return None
        lower, upper = self.lower.copy("F"), self.upper.copy("F")
        for side in (left, right):
            upper[side] -= np.maximum(above, 0.0)
            lower[side] += np.maximum(below, 0.0)
        return Bounds(lower, upper, self.sharp, self.spare)


class BoundsTemplate:
    """The bounds of every motion of a problem on one grid.

    Args:
        problem: The problem.
        world: Any world of it: the bounds are read off its conditions; it is moved.
        s: Phases of the grid, shape (K,).
        tightening: How much to tighten.

    Attributes:
        conditions: The conditions whose values the residuals are.
        allowed: What the verdict allows residuals to exceed, in scaled units, shape (m,); ``UNTOLD`` of conditions that
            ask for more than is meant, of which the verdict knows nothing.
        needs: The highest derivative of q that each residual depends on, shape (m,).
        equal: Which residuals are of equalities, shape (m,).
        capsules: Which residuals are clearances of the links' capsules, or of the paper's, shape (m,).
    """

    def __init__(self, problem: Problem, world: "World", s: Array, tightening: Tightening) -> None:
        forms = [constraint.solved for constraint in problem.constraint]
        needs = measured_needs(forms, world, jerk=problem.uses_jerk)  # the world is left as the bounds are read off
        pairs = [(constraint, condition) for constraint in problem.constraint for condition in constraint.solved(world)]
        tables, loose = (
            [_bounds(*pair, s, tight, need) for pair, need in zip(pairs, needs, strict=True)]
            for tight in (tightening, NONE)
        )
        self._tightening = tightening
        self._s, self._funnelled = s, s * (SOONER if tightening.band else 1.0)
        self._lower = np.asfortranarray(np.concatenate([low for low, _ in tables], axis=1))  # as residuals lie
        self._upper = np.asfortranarray(np.concatenate([high for _, high in tables], axis=1))
        self._funnels = list(_funnels(pairs))
        self.conditions = [condition for _, condition in pairs]
        self.allowed = np.concatenate([_allowed(*pair) for pair in pairs])
        widths = [len(each.g) for each in self.conditions]
        self.needs = np.repeat(needs, widths)
        self.capsules = np.repeat([isinstance(each, RobotClearance | SelfClearance) for each, _ in pairs], widths)
        self.equal = np.repeat([each.is_equality for each in self.conditions], widths)
        with np.errstate(invalid="ignore"):
            spare = np.where(self.equal, PRECISE, 1.0) * self.allowed + np.fmax(
                np.concatenate([high for _, high in loose], axis=1) - self._upper,
                self._lower - np.concatenate([low for low, _ in loose], axis=1),
            )
        self._spare = np.asfortranarray(np.where(np.isnan(spare), np.inf, spare))
        self._sharp = np.zeros(self._lower.shape, bool, order="F")
        self._sharp[[*ENDS, *(-1 - each for each in ENDS)]] = self.needs >= 2

    def of(self, start_tip: Array, *, ends: Array | None = None) -> Bounds:
        """Return the bounds of one motion.

        Args:
            start_tip: Where the tip is at the start [m], shape (3,).
            ends: Residuals of the boundary states, shape (2, m), nan where they are free. Bounds near an end that is
                off by more than is negligible and no more than the verdict allows are as wide as that: no motion could
                meet narrower ones.
        """
        bounds = self._of(start_tip)
        return bounds if ends is None else self._eased(bounds, ends)

    def on_hulls(self, bounds: Bounds, least: Array) -> Bounds:
        """Return bounds without those of capsules, and with further columns for distances of the links' hulls.

        Args:
            bounds: What ``of`` returned.
            least: What the distances must be at least [m], shape (columns,).
        """
        lower = (least + _inside(self._s, self._tightening)[:, None]) / DISTANCE
        lower[self._s == 1] = -np.inf
        free = np.where(self.capsules, np.inf, 0.0)
        return Bounds(
            np.asfortranarray(np.hstack([bounds.lower - free, lower])),
            np.asfortranarray(np.hstack([bounds.upper + free, np.full_like(lower, np.inf)])),
            np.asfortranarray(np.hstack([bounds.sharp, np.zeros(lower.shape, bool)])),
            np.asfortranarray(np.hstack([bounds.spare, np.full_like(lower, np.inf)])),
        )

    def _eased(self, bounds: Bounds, ends: Array) -> Bounds:
        lower, upper = bounds.lower, bounds.upper
        if not np.fmax.reduce(bounds.beyond(ends), axis=None) > NEGLIGIBLE:
            return bounds
        for g, row, s in ((ends[0], 0, self._s), (ends[1], -2, 1 - self._s)):  # the last row has bounds of few only
            open_ = np.clip((EASE[1] - s) / (EASE[1] - EASE[0]), 0.0, 1.0)[:, None]
            above, below = np.fmax(g - upper[row], 0.0), np.fmax(lower[row] - g, 0.0)
            if np.any(above > 0):
                upper = np.asfortranarray(upper + np.minimum(above, self.allowed) * open_)
            if np.any(below > 0):
                lower = np.asfortranarray(lower - np.minimum(below, self.allowed) * open_)
        with np.errstate(invalid="ignore"):
            wider = np.nan_to_num(np.fmax(upper - bounds.upper, bounds.lower - lower))
        return Bounds(lower, upper, bounds.sharp, bounds.spare - np.where(self.equal, 0.0, wider))

    def _of(self, start_tip: Array) -> Bounds:
        lower, upper = self._lower, self._upper
        for constraint, condition, columns in self._funnels:
            wider = constraint.funnel(condition, self._funnelled, start_tip)
            if np.any(wider > 0):
                scale = _scale(constraint, condition)
                lower, upper = lower.copy("F"), upper.copy("F")
                lower[:, columns] -= wider[:, None] / scale
                upper[:, columns] += wider[:, None] / scale
        return Bounds(lower, upper, self._sharp, self._spare)


def _funnels(pairs: list[tuple[Constraint, Condition]]) -> Iterator[tuple[Constraint, Condition, slice]]:
    """Yield the conditions of constraints that motions may begin outside of, with their columns."""
    column = 0
    for constraint, condition in pairs:
        width = len(condition.g)
        if type(constraint).funnel is not Constraint.funnel:
            yield constraint, condition, slice(column, column + width)
        column += width


def _scale(constraint: Constraint, condition: Condition) -> Array:
    return residual_scale(condition.lower, condition.upper, constraint.tolerance, condition.exactness)


def _allowed(constraint: Constraint, condition: Condition) -> Array:
    if condition.sufficient:
        return np.full(len(condition.g), UNTOLD)
    return constraint.allowed(condition) / _scale(constraint, condition)


def _bounds(
    constraint: Constraint, condition: Condition, s: Array, tightening: Tightening, needs: int
) -> tuple[Array, Array]:
    """Scaled bounds (K, m) of one condition."""
    scale = _scale(constraint, condition)
    lower = np.repeat((condition.lower / scale)[None], len(s), axis=0)
    upper = np.repeat((condition.upper / scale)[None], len(s), axis=0)
    if condition.exactness == "limit":
        fraction = tightening.limit if needs >= 2 else tightening.gentle
        shrink = 1 - fraction * np.clip(np.minimum(s, 1 - s) / tightening.edge, 0, 1)[:, None]
        middle, half = (lower + upper) / 2, (upper - lower) / 2
        lower, upper = middle - shrink * half, middle + shrink * half
    elif condition.is_equality:
        band = tightening.band * constraint.tolerance / scale
        lower, upper = lower - band, upper + band
    else:
        inside = _inside(s, tightening)[:, None] / scale
        lower, upper = lower + inside, upper - inside
    if needs < 2:  # fixed by the boundary conditions
        lower[s == 1], upper[s == 1] = -np.inf, np.inf
    return lower, upper


def _inside(s: Array, tightening: Tightening) -> Array:
    """By how much clearances are tightened [m], shape (K,)."""
    return np.asarray(tightening.clearance * np.clip(np.minimum(s, 1 - s) / tightening.edge, 0, 1))
