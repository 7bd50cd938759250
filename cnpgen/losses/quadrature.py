"""Quadrature rules over the phase with nodes that are dense at both ends.

The first and last basis functions of r are about 0.01 wide. Between uniform nodes a
plan can have an acceleration of a hundred times the limit there, and training finds
such plans. The nodes of Gauss and those of the midpoint rule in the angle of ``s = (1 -
cos theta) / 2`` are dense at the ends: 64 of them are as accurate as 1024 uniform ones.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.errors import UsageError, nearest
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.trajectory.spline import basis_tables
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

RULES = ("cosine", "gauss")


def quadrature(rule: str, nodes: int, shift: float = 0.0) -> tuple[Array, Array]:
    """Return K nodes and weights on [0, 1], shape (K,) each; the weights sum to 1.

    The rule is "cosine", the midpoint rule in theta, or "gauss", Gauss-Legendre. The
    nodes of the cosine rule are offset by a fraction of their spacing in theta, in [0,
    1). The average over shifts covers the intervals between nodes.

    Raises:
        UsageError: The rule does not exist, the number of nodes is no positive integer,
            or the shift is not in [0, 1).
    """
    check_quadrature(rule, nodes, shift)
    if rule == "gauss":
        # Gauss-Legendre on [-1, 1], moved to [0, 1].
        x, weights = np.polynomial.legendre.leggauss(nodes)
        return (1 + x) / 2, weights / 2
    # s = (1 - cos theta) / 2, ds = sin(theta) / 2 dtheta: midpoints in theta, weights
    # proportional to sin theta, normalized so that constants are integrated exactly
    theta = np.pi * (np.arange(nodes) + (0.5 + shift) % 1) / nodes
    weights = np.sin(theta)
    return (1 - np.cos(theta)) / 2, weights / weights.sum()


def check_quadrature(rule: str, nodes: int, shift: float = 0.0) -> None:
    """Raise UsageError for arguments that :func:`quadrature` does not accept."""
    if rule not in RULES:
        uniform = rule == "uniform"
        reason = (
            "; between uniform nodes the ends of r hide violations"
            if uniform
            else nearest(str(rule), RULES)
        )
        raise UsageError(
            f"quadrature rule {rule!r} does not exist: expected one of {', '.join(RULES)}{reason}",
            concerns="rule",
        )
    integer("nodes", nodes, least=1)
    if not 0 <= shift < 1 or (rule == "gauss" and shift != 0):
        expected = "0, Gauss nodes cannot be moved" if rule == "gauss" else "in [0, 1)"
        raise UsageError(
            f"the shift of the quadrature nodes must be {expected}, got {shift}",
            concerns="shift",
        )


@checked_arguments
def rotating_shift(step: int, count: int = 8) -> float:
    """Return the shift of a training step: ``count`` equally spaced shifts in rotation, none with a node on an end.

    Args:
        step: Index of the step.
        count: Number of shifts; 1 for constant nodes.
    """
    integer("count", count, least=1)
    # Half a spacing off zero, so that no node falls on s = 0 or 1, where nothing changes.
    return ((step % count + 0.5) / count + 0.5) % 1


@dataclass(frozen=True)
class BasisTable:
    """The basis functions at the nodes."""

    s: Array  # phases, shape (K,), float64
    weights: NDArray[Any]  # quadrature weights, shape (1, K)
    path: NDArray[Any]  # basis functions of p and its derivatives, shape (orders K, C)
    # Basis functions of r and its derivatives, shape ((orders - 1) K, R).
    rate: NDArray[Any]


@lru_cache(maxsize=64)
def basis_table(
    spec: TrajectorySpec,
    rule: str,
    nodes: int,
    shift: float,
    dtype: str,
    *,
    orders: int = 3,
) -> BasisTable:
    """Tabulate the basis of both splines at the nodes of ``quadrature``, with ``orders`` orders of p."""
    s, weights = quadrature(rule, nodes, shift)
    path, rate = basis_tables(spec, s, orders)
    return BasisTable(
        s,
        weights[None].astype(dtype),
        np.vstack(path).astype(dtype),
        np.vstack(rate).astype(dtype),
    )
