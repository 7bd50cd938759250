"""Clamped uniform B-splines: knots, basis matrices, and what their control points are worth at the ends."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def clamped_knots(points: int, degree: int) -> Array:
    """Return the knot vector of the paper's Appendix A, shape (points + degree + 1,)."""
    inner = np.arange(1, points - degree) / (points - degree)
    return np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])


def basis(s: Array, points: int, degree: int, order: int = 0) -> Array:
    """Evaluate every basis function, or a derivative of it.

    Args:
        s: Phases in [0, 1], shape (K,).
        points: Number of control points C.
        degree: Degree D.
        order: Order of the derivative with respect to s.

    Returns:
        Shape (K, C): ``basis(s, C, D, order) @ control_points`` is the derivative of the spline.
    """
    from scipy.interpolate import BSpline

    spline = BSpline(clamped_knots(points, degree), np.eye(points), degree)
    values: Array = spline.derivative(order)(s) if order else spline(s)
    return np.ascontiguousarray(values)


@dataclass(frozen=True)
class EndDerivatives:
    """Derivatives of a clamped uniform B-spline at s = 0 (mirrored at s = 1).

    ``x'(0) = eta (c1 - c0)`` with ``eta = D (C - D)`` (the paper's Appendix A prints the square of C - D) and
    ``x''(0) = beta (c2 - 3 c1 + 2 c0)`` with ``beta = D (D - 1) / 2 (C - D)^2``; both need C >= D + 2.

    Attributes:
        eta: Factor of the first derivative.
        beta: Factor of the second derivative.
    """

    eta: float
    beta: float


@cache
def end_derivatives(points: int, degree: int) -> EndDerivatives:
    """Return eta and beta of a spline with C control points of degree D."""
    span = points - degree
    return EndDerivatives(float(degree * span), degree * (degree - 1) / 2 * span**2)


def chebyshev(count: int) -> Array:
    """Return ``(1 - cos(pi k / K)) / 2`` for k = 0..K: dense at both ends, where clamped basis functions are narrow."""
    return (1 - np.cos(np.pi * np.arange(count + 1) / count)) / 2


@cache
def gauss_rule(points: int, degree: int, per_span: int = 8) -> tuple[Array, Array]:
    """Composite Gauss-Legendre rule on [0, 1] that respects the knots.

    Returns:
        ``(s, weights)``, both of shape (spans * per_span,).
    """
    nodes, weights = np.polynomial.legendre.leggauss(per_span)
    edges = np.linspace(0, 1, points - degree + 1)
    width = np.diff(edges)[:, None]
    return (edges[:-1, None] + width * (nodes + 1) / 2).ravel(), (width * weights / 2).ravel()
