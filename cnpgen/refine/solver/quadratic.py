"""The quadratic programme of one step: which residuals it holds, and its solution by DAQP.

DAQP is given variables in which the Hessian is 1: it would transform the programme to such ones itself, but takes twice
as long for it as BLAS.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.transcription import Linearisation, Transcription, of_last

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

INFINITE = 1e30  # what DAQP takes for no bound
SOFTNESS = 0.1  # root of the curvature of the elastic variable's cost; far smaller ones triple the working-set changes
USED = 1e-3  # its slope where nothing is violated
MULTIPLIER = 1e-9  # smaller ones belong to residuals that are not active
FEASIBLE = 1e-6  # of DAQP
CHANGES = 3000  # largest number of working-set changes
NEAR_OTHERS = 0.4  # accelerations grow with the square of the rate; what they are not in is held within this at most
LOWER, UPPER = 3, 1  # how DAQP is told what is active


@dataclass(frozen=True)
class Step:
    """Solution of a quadratic programme.

    Attributes:
        dx: The step, shape (nx,).
        left: Fraction of the violations that it leaves.
        multipliers: Of all residuals, shape (K, m); 0 for those that are not held.
        gain: By how much it promises to reduce the objective.
    """

    dx: Array
    left: float
    multipliers: Array
    gain: float


@dataclass(frozen=True)
class Near:
    """Where a quadratic programme is made, and what it must hold there.

    Attributes:
        violation: Worst violation there.
        near: Residuals are held at crests that are so near to a bound.
        leap: No logarithm of the rate changes by more: sharp residuals that may leap over a bound then are held.
        missed: Residuals that are held anyway, shape (K, m).
        multipliers: Those of the last step, shape (K, m), or None: what has one is held.
    """

    violation: float
    near: float
    leap: float
    missed: Mask
    multipliers: Array | None


class Model(Protocol):
    """The quadratic programmes near a point."""

    @property
    def held(self) -> Mask:
        """Which residuals they hold, shape (K, m)."""

    def solve(self, box: Array, *, warm: Array | None = None, relax: bool = False) -> "Step | None":
        """Return the best step within the box, or None where there is none.

        Args:
            box: Largest change of every variable, shape (nx,).
            warm: Multipliers, shape (K, m), whose residuals are taken to be active at first; None for none.
            relax: Whether residuals that are met may be broken, too, as far as the worst violation is left.
        """


class Steps(Protocol):
    """What sequential quadratic programming asks of a motion within its bounds."""

    def value(self, x: Array) -> tuple[float, Array, float]:
        """Evaluate what is minimised, residuals (K, m) and their worst violation."""

    def model(self, x: Array, g: Array, near: Near, *, proximal: float, penalty: float) -> Model:
        """Model the motion near x, where residuals are g; the last one is valid until the next."""


class PlainSteps:
    """Steps in NumPy and DAQP.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        thin: As of ``choose``.
    """

    def __init__(self, motion: Transcription, bounds: Bounds, thin: int) -> None:
        self._motion, self._bounds, self._thin = motion, bounds, thin
        self._evaluate = of_last(motion.evaluate)  # after a refused step the point is the same

    def value(self, x: Array) -> tuple[float, Array, float]:
        """Evaluate; see ``Steps``."""
        cost, g = self._motion.value(x)
        return cost, g, self._bounds.violation(g)

    def model(self, x: Array, g: Array, near: Near, *, proximal: float, penalty: float) -> "QuadraticModel":
        """Model the motion; see ``Steps``."""
        at = self._evaluate(x)
        leaps = self._motion.leaps(at, near.leap)
        held = choose(g, self._bounds, thin=self._thin, near=near.near, leaps=leaps) | near.missed
        held = held if near.multipliers is None else held | (near.multipliers != 0)
        return QuadraticModel(self._motion, at, self._bounds, held, near.violation, proximal, penalty)


@dataclass(frozen=True)
class QuadraticModel:
    """Quadratic model of the objective and linear one of the residuals near a point.

    Attributes:
        motion: The transcription.
        at: The point.
        bounds: Bounds of the residuals.
        held: Residuals that the programme holds, shape (K, m).
        violation: Worst violation there.
        proximal: Weight of the proximal term.
        penalty: Cost of the worst violation.
    """

    motion: Transcription
    at: Linearisation
    bounds: Bounds
    held: Mask
    violation: float
    proximal: float
    penalty: float

    def cost(self, dx: Array) -> float:
        """Return the change of the objective that a step promises."""
        return float(self.at.gradient @ dx + 0.5 * dx @ self.at.curvature @ dx + 0.5 * self.proximal * dx @ dx)

    def solve(self, box: Array, *, warm: Array | None = None, relax: bool = False) -> Step | None:
        """Return the best step within the box; see ``Model``."""
        import daqp

        nx, unwhiten = self.motion.nx, self._unwhiten
        if unwhiten is None:
            return None
        k, which = np.nonzero(self.held)
        rows, low, high = self._rows(k, which, unwhiten, relax=relax)
        sense = np.zeros(nx + 1 + len(k), np.int32)
        if warm is not None:
            before = warm[k, which]
            sense[nx + 1 :] = UPPER * (before > MULTIPLIER) + LOWER * (before < -MULTIPLIER)
        solution, _, flag, info = daqp.solve(
            np.eye(nx + 1),
            np.append(self.at.gradient @ unwhiten, (self.penalty * self.violation + USED) / SOFTNESS),
            rows,
            np.concatenate([box, [1.0], np.minimum(high, INFINITE)]),
            np.concatenate([-box, [0.0], np.maximum(low, -INFINITE)]),
            sense,
            primal_tol=FEASIBLE,
            iter_limit=CHANGES,
        )
        dx = unwhiten @ solution[:-1]
        if flag < 1 or not np.isfinite(dx).all():
            return None
        multipliers = np.zeros(self.at.g.shape)
        multipliers[k, which] = info["lam"][nx + 1 :]
        return Step(dx, float(solution[-1]) / SOFTNESS, multipliers, -self.cost(dx))

    @cached_property
    def _unwhiten(self) -> Array | None:
        """What turns variables in which the Hessian is 1 into steps, shape (nx, nx); None where it is not positive."""
        from scipy.linalg.lapack import dpotrf, dtrtri

        hessian = self.at.curvature.copy()
        hessian.flat[:: len(hessian) + 1] += self.proximal
        factor, failed = dpotrf(hessian, lower=True)
        return None if failed else np.asarray(dtrtri(factor, lower=True)[0].T)

    def _rows(self, k: Indices, which: Indices, unwhiten: Array, *, relax: bool) -> tuple[Array, Array, Array]:
        """Lay out what is bounded, and how far it may go.

        Returns:
            ``(rows, low, high)``: gradients of the box, the elastic variable and m held residuals, shape
            (nx + 1 + m, nx + 1), and how far the residuals may fall and rise, shape (m,) each.
        """
        g, lower, upper = self.at.g[k, which], self.bounds.lower[k, which], self.bounds.upper[k, which]
        nx = self.motion.nx
        rows = np.zeros((nx + 1 + len(k), nx + 1))
        rows[:nx, :-1] = unwhiten
        np.matmul(self.motion.rows(self.at, k, which), unwhiten, out=rows[nx + 1 :, :-1])
        rows[nx, -1] = 1 / SOFTNESS
        elastic = rows[nx + 1 :, -1]
        if relax:
            nearer = upper - g < g - lower
            elastic[:] = np.where(nearer, -self.violation, self.violation) / SOFTNESS
            return rows, np.where(nearer, -INFINITE, lower - g), np.where(nearer, upper - g, INFINITE)
        above, below = np.maximum(g - upper, 0), np.maximum(lower - g, 0)
        elastic[:] = (below - above) / SOFTNESS
        return rows, np.where(above > 0, -INFINITE, lower - g), np.where(below > 0, INFINITE, upper - g)


def choose(g: Array, bounds: Bounds, *, thin: int, near: float, leaps: Array) -> Mask:
    """Pick the residuals that matter, shape (K, m): at a crest near a bound, or sharp, so that they may leap over it.

    Args:
        g: Residuals, shape (K, m).
        bounds: Their bounds.
        thin: Every how many grid points the thinned grid has one.
        near: What is close; at most ``NEAR_OTHERS`` for residuals that no acceleration is in.
        leaps: How far sharp residuals may leap, shape (K, m).
    """
    excess = bounds.excess(g)
    within = np.where(bounds.accelerated, near, min(near, NEAR_OTHERS))
    picked: Mask = (crests(excess, thin=thin) & (excess > -within)) | (bounds.sharp & (excess > -leaps))
    return picked


def crests(excess: Array, *, thin: int) -> Mask:
    """Find local maxima along the motion, their neighbours, and the thinned grid, shape (K, m).

    Args:
        excess: How far residuals are outside, shape (K, m).
        thin: Every how many grid points the thinned grid has one.
    """
    peak = np.zeros(excess.shape, bool, order="F")
    peak[1:-1] = (excess[1:-1] >= excess[:-2]) & (excess[1:-1] >= excess[2:])
    peak[0], peak[-1] = excess[0] >= excess[1], excess[-1] >= excess[-2]
    wide = peak.copy("F")
    wide[1:] |= peak[:-1]
    wide[:-1] |= peak[1:]
    wide[::thin] = True
    return wide
