"""Collocation grids: phases, spline bases and quadrature nodes, which do not depend on the motion."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations

import numpy as np

from cnpgen.arrays import Array, Indices
from cnpgen.trajectory.spline import basis, basis_tables, chebyshev, graded_edges
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

NODES_PER_CELL = 4  # Gauss nodes of the time integral: relative error below 1e-9
COST_NODES = 40
# Close enough to 0; jerks there differ by some percent from those at the next grid
# point.
FIRST_JERK_PHASE = 1e-6


@dataclass(frozen=True)
class Bases:
    """Spline bases at some phases."""

    path: Array  # basis of p and its derivatives, shape (orders, K, C)
    rate: Array  # basis of r and its derivatives, shape (orders - 1, K, R)
    path_at: Array  # ``path`` phase by phase, shape (K, C, orders)
    rate_at: Array  # ``rate`` phase by phase, shape (K, orders - 1, R)
    support: int  # number of control points with nonzero basis functions at a phase

    @cached_property
    def phases_last(self) -> tuple[Array, Array]:
        """``path`` and ``rate`` with the phases last, shape (orders, C, K) and (orders - 1, R, K)."""
        return np.ascontiguousarray(self.path.swapaxes(1, 2)), np.ascontiguousarray(
            self.rate.swapaxes(1, 2)
        )

    @cached_property
    def first_support(self) -> tuple[Indices, Indices]:
        """Index of the first control point of p and of r in the support of every phase, shape (K,) each."""
        return _first(self.path, self.support), _first(self.rate, self.support)

    def states(self, path: Array, rate: Array) -> Array:
        """Evaluate a motion: w = (p, p', ..., r, r', ...), shape (orders n + orders - 1, K), from (C, n) and (R,)."""
        orders, points, _ = self.path.shape
        first = orders * path.shape[1]
        w = np.empty((first + orders - 1, points))
        w[:first] = (self.path @ path).transpose(0, 2, 1).reshape(first, points)
        w[first:] = self.rate @ rate
        return w


@dataclass(frozen=True)
class Grid:
    """Grid on (0, 1]."""

    # Phases, shape (K,); at s = 0 everything but the jerk is fixed by the boundary
    # conditions.
    s: Array
    # Bases on the grid, three orders of p and two of r, or four and three where the
    # jerk is constrained.
    bases: Bases
    time_basis: Array  # basis of r at the nodes of the time integral, shape (Q, R)
    time_weights: Array  # quadrature weights of the time integral, shape (Q,)
    # Bases at the Gauss nodes of the cost term's integral, four orders of p and three
    # of r. The nodes are few, since their residuals are expensive. The error of the
    # integral is up to a few tenths of a percent, that of the objective up to 0.1 %.
    cost_bases: Bases
    cost_weights: Array  # quadrature weights of the cost term's integral

    @cached_property
    def midpoint_weights(self) -> Array:
        """Lagrange weights of four adjacent points for the midpoint of the inner two, shape (K - 3, 4)."""
        points = np.stack([self.s[k : len(self.s) - 3 + k] for k in range(4)], axis=1)
        midpoint = (points[:, 1] + points[:, 2]) / 2
        weights = np.ones_like(points)
        for k, other in permutations(range(4), 2):
            weights[:, k] *= (midpoint - points[:, other]) / (
                points[:, k] - points[:, other]
            )
        return weights


@lru_cache(maxsize=32)
def make_grid(spec: TrajectorySpec, points: int, orders: int = 3) -> Grid:
    """Build the Chebyshev grid of ``points`` phases, with bases of so many orders of p."""
    s = np.concatenate([[FIRST_JERK_PHASE] * (orders > 3), chebyshev(points)[1:]])
    edges = graded_edges(spec.rate_control_points, spec.degree)
    nodes, weights = np.polynomial.legendre.leggauss(NODES_PER_CELL)
    width = np.diff(edges)[:, None]
    q = (edges[:-1, None] + width * (nodes + 1) / 2).ravel()
    cost_nodes, cost_weights = np.polynomial.legendre.leggauss(COST_NODES)
    return Grid(
        s,
        bases=_bases(spec, s, orders),
        time_basis=basis(q, spec.rate_control_points, spec.degree),
        time_weights=(width * weights / 2).ravel(),
        cost_bases=_bases(spec, (cost_nodes + 1) / 2, 4),
        cost_weights=cost_weights / 2,
    )


def _bases(spec: TrajectorySpec, s: Array, orders: int) -> Bases:
    path, rate = basis_tables(spec, s, orders)
    arrays = (
        np.stack(path),
        np.stack(rate),
        np.stack(path, axis=-1),
        np.stack(rate, axis=1),
    )
    return Bases(*arrays, support=spec.degree + 1)


def _first(bases: Array, support: int) -> Indices:
    """Return the first control point of the support at every phase, shape (K,).

    All of the support exists.
    """
    first: Indices = np.minimum(
        (bases != 0).any(axis=0).argmax(axis=1), bases.shape[2] - support
    )
    return first
