"""Clamped uniform B-splines: knots, basis matrices, pieces, and what their control points are worth at the ends."""

from dataclasses import dataclass
from functools import cache
from math import factorial, perm, prod

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HUGE = 1e150  # control points beyond it are scaled before their products, which would be infinite, are taken


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
    knots, worth = derivative(points, degree, order)
    degree -= order
    first = np.clip(np.searchsorted(knots, s, side="right") - 1, degree, len(worth) - 1) - degree
    values = np.zeros((len(s), points))
    for k, weight in enumerate(_cox_de_boor(s, knots, degree, first)):
        values += weight[:, None] * worth[first + k]
    return values


def derivative(points: int, degree: int, order: int) -> tuple[Array, Array]:
    """Return the knots of a derivative of a spline, and the matrix that turns its control points into the derivative's.

    Args:
        points: Number of control points C.
        degree: Degree D.
        order: Order of the derivative with respect to s, at most D.

    Returns:
        ``(knots, matrix)``: shapes (C + D + 1 - 2 order,) and (C - order, C); the derivative's degree is D - order.
    """
    knots, matrix = clamped_knots(points, degree), np.eye(points)
    for p in range(degree, degree - order, -1):
        matrix = np.diff(matrix, axis=0) * p / (knots[p + 1 : -1] - knots[1 : -p - 1])[:, None]
        knots = knots[1:-1]
    return knots, matrix


def _cox_de_boor(s: Array, knots: Array, degree: int, first: NDArray[np.intp]) -> Array:
    """Evaluate the D + 1 basis functions that are not 0 at phases s, by the recursion that SciPy uses, too.

    Args:
        s: Phases, shape (K,).
        knots: Knots.
        degree: Degree D.
        first: Index of the first of these basis functions at every phase, shape (K,).

    Returns:
        Shape (D + 1, K).
    """
    weights = np.ones((1, len(s)))
    right = first + degree + 1 + np.arange(degree)[:, None]
    for p in range(1, degree + 1):
        high, low = knots[right[:p]], knots[right[:p] - p]
        share = weights / (high - low)
        weights = np.zeros((p + 1, len(s)))
        weights[1:] = share * (s - low)
        weights[:-1] += share * (high - s)
    return weights


def pieces(control: Array, degree: int) -> Array:
    """Turn N splines into polynomials between their knots, for ``pick`` and ``horner``.

    Args:
        control: Control points, shape (N, C) or (N, C, n).
        degree: Degree D.

    Returns:
        Coefficients of the powers of (s - left knot), highest first, shape (D + 1, spans, N, ...).
    """
    matrices = taylor(control.shape[1], degree)[::-1]
    columns = control.reshape(*control.shape[:2], prod(control.shape[2:]))
    powers = np.ascontiguousarray((matrices[:, None] @ columns).swapaxes(1, 2))  # motion by motion
    return powers.reshape(*matrices.shape[:2], len(control), *control.shape[2:])


@cache
def taylor(points: int, degree: int) -> Array:
    """Return the Taylor coefficients of every basis function at every left knot, lowest power first.

    Returns:
        Shape (D + 1, spans, C): ``taylor(C, D)[k] @ control_points`` are the coefficients of (s - left knot)^k.
    """
    left = np.arange(points - degree) / (points - degree)
    return np.stack([basis(left, points, degree, order) / factorial(order) for order in range(degree + 1)])


def pick(coefficients: Array, s: Array) -> tuple[Array, Array]:
    """Pick, for every spline, the pieces in which its own phases are.

    Args:
        coefficients: What ``pieces`` returned.
        s: Phases in [0, 1], shape (N, K).

    Returns:
        ``(picked, offset)``: coefficients, shape (D + 1, N, K, ...), and s - left knot, shape (N, K).
    """
    spans = coefficients.shape[1]
    span = np.clip(np.nan_to_num(s) * spans, 0, spans - 1).astype(np.intp)
    return coefficients[:, span, np.arange(len(s))[:, None]], s - span / spans


def horner(picked: Array, offset: Array, order: int = 0) -> Array:
    """Evaluate what ``pick`` returned, or a derivative of it.

    Returns:
        Shape (N, K, ...).
    """
    degree = len(picked) - 1
    offset = offset.reshape(*offset.shape, *(1,) * (picked.ndim - 3))
    value = np.zeros(picked.shape[1:])
    for power in range(degree, order - 1, -1):
        value = value * offset + perm(power, order) * picked[degree - power]
    return value


def extremes(control: Array, degree: int) -> tuple[Array, Array]:
    """Return where on [0, 1] one spline of finite control points, shape (C,), ends or turns, and its values there."""
    from scipy.interpolate import BSpline, PPoly

    scale = 2.0**-600 if np.abs(control).max() > HUGE else 1.0  # a power of two, which changes no digit
    spline = BSpline(clamped_knots(len(control), degree), control * scale, degree)
    turning = PPoly.from_spline(spline.derivative()).roots(extrapolate=False)
    s = np.clip(np.concatenate([[0.0, 1.0], turning[np.isfinite(turning)]]), 0, 1)
    return s, np.asarray(spline(s)) / scale


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
def graded_edges(points: int, degree: int) -> Array:
    """Return edges of cells on [0, 1] in which 1 / r is smooth enough for eight Gauss nodes.

    Four cells per span, and cells that shrink by halves towards s = 0 and s = 1: there the first basis function is
    0.01 wide, and 1 / r is nearly singular where the first control point is much smaller than the second. With cells
    of equal size the duration of such motions is wrong in the third digit.

    Returns:
        Ascending, from 0 to 1; the knots are among them.
    """
    spans = points - degree
    end = 0.5 ** np.arange(24, 2, -1)
    return np.unique(np.concatenate([np.linspace(0, spans, 4 * spans + 1), end, spans - end])) / spans


def edges_around(s: Array, points: int, degree: int) -> Array:
    """Return the edges of ``graded_edges`` and, between them, those of cells that shrink towards phases s, shape (K,).

    They are for an r that turns close to 0 between its ends.
    """
    away = np.concatenate([[0.0], 0.5 ** np.arange(26, 2, -1)]) / (points - degree)
    close = np.concatenate([s[:, None] - away, s[:, None] + away], axis=None)
    return np.union1d(graded_edges(points, degree), close[(close > 0) & (close < 1)])
