"""Collocation grids: phases, spline bases there, and quadrature nodes; everything that no motion changes."""

from dataclasses import dataclass
from functools import cached_property
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.spec import TrajectorySpec
from cnpgen.trajectory.spline import basis, chebyshev, graded_edges

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
NODES = 4  # Gauss nodes per cell of the time integral: wrong by less than 1e-9 of it
CRITERION_NODES = 40
BEGINNING = 1e-6  # a phase as good as 0, where jerks differ by some percent from those at the next point of a grid


@dataclass(frozen=True)
class Bases:
    """Spline bases at some phases.

    Attributes:
        path: Basis of p and its derivatives, shape (orders, K, C).
        rate: Basis of r and its derivatives, shape (orders - 1, K, R).
        path_at: ``path`` phase by phase, shape (K, C, orders).
        rate_at: ``rate`` phase by phase, shape (K, orders - 1, R).
        support: How many control points count at a phase: those whose basis functions are not 0 there.
    """

    path: Array
    rate: Array
    path_at: Array
    rate_at: Array
    support: int

    @cached_property
    def along(self) -> tuple[Array, Array]:
        """``path`` and ``rate`` with the phases last, shape (orders, C, K) and (orders - 1, R, K)."""
        return np.ascontiguousarray(self.path.swapaxes(1, 2)), np.ascontiguousarray(self.rate.swapaxes(1, 2))

    @cached_property
    def supported_from(self) -> tuple[Indices, Indices]:
        """First of the control points of p and of r that count at every phase, shape (K,) each."""
        return _first(self.path, self.support), _first(self.rate, self.support)

    def states(self, path: Array, rate: Array) -> Array:
        """Evaluate a motion: w = (p, p', ..., r, r', ...), shape (orders n + orders - 1, K).

        Args:
            path: Path control points, shape (C, n).
            rate: Rate control points, shape (R,).
        """
        orders, points, _ = self.path.shape
        first = orders * path.shape[1]
        w = np.empty((first + orders - 1, points))
        w[:first] = (self.path @ path).transpose(0, 2, 1).reshape(first, points)
        w[first:] = self.rate @ rate
        return w


@dataclass(frozen=True)
class Grid:
    """A grid on (0, 1].

    Attributes:
        s: Phases, shape (K,); s = 0 is left out, nothing but the jerk can be changed there.
        bases: Bases there, three orders of p and two of r, or four and three where the jerk is constrained.
        gauss: Basis of r at the nodes of the time integral, shape (Q, R).
        weights: Quadrature weights of the time integral, shape (Q,).
        criterion: Bases at the Gauss nodes of the criterion's integral, four orders of p and three of r: dense at both
            ends like the grid, but few, since their residuals are dear: the integral is wrong by up to a few tenths of
            a percent, the objective by up to 0.1 %.
        criterion_weights: Their quadrature weights.
    """

    s: Array
    bases: Bases
    gauss: Array
    weights: Array
    criterion: Bases
    criterion_weights: Array

    @cached_property
    def midway(self) -> Array:
        """What four points in a row say of the middle of the inner two, shape (K - 3, 4): Lagrange's weights."""
        near = np.stack([self.s[k : len(self.s) - 3 + k] for k in range(4)], axis=1)
        middle = (near[:, 1] + near[:, 2]) / 2
        weights = np.ones_like(near)
        for k, other in permutations(range(4), 2):
            weights[:, k] *= (middle - near[:, other]) / (near[:, k] - near[:, other])
        return weights


def make_grid(spec: TrajectorySpec, points: int, orders: int = 3) -> Grid:
    """Build the Chebyshev grid of ``points`` phases, with bases of so many orders of p."""
    s = np.concatenate([[BEGINNING] * (orders > 3), chebyshev(points)[1:]])
    edges = graded_edges(spec.rate_control_points, spec.degree)
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    width = np.diff(edges)[:, None]
    q = (edges[:-1, None] + width * (nodes + 1) / 2).ravel()
    few, few_weights = np.polynomial.legendre.leggauss(CRITERION_NODES)
    return Grid(
        s,
        bases=_bases(spec, s, orders),
        gauss=basis(q, spec.rate_control_points, spec.degree),
        weights=(width * weights / 2).ravel(),
        criterion=_bases(spec, (few + 1) / 2, 4),
        criterion_weights=few_weights / 2,
    )


def _bases(spec: TrajectorySpec, s: Array, orders: int) -> Bases:
    path = [basis(s, spec.path_control_points, spec.degree, order) for order in range(orders)]
    rate = [basis(s, spec.rate_control_points, spec.degree, order) for order in range(orders - 1)]
    arrays = np.stack(path), np.stack(rate), np.stack(path, axis=-1), np.stack(rate, axis=1)
    return Bases(*arrays, support=spec.degree + 1)


def _first(bases: Array, support: int) -> Indices:
    """First control point that counts at every phase, shape (K,), so that none of the next ones is missing."""
    found: Indices = np.minimum((bases != 0).any(axis=0).argmax(axis=1), bases.shape[2] - support)
    return found
