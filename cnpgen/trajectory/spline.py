"""Clamped uniform B-splines: knots, basis functions, derivatives, extrema, and quadrature cells.

All production code evaluates splines by this module: by a matrix of basis functions at
common phases (``basis``), which kernels and compiled code multiply with control points,
by Horner's rule at the phases of each spline (``horner``), or at one phase of each of N
splines (``derivatives_of_each``). The judges have their own splines.
"""

from dataclasses import dataclass
from functools import cache
from math import factorial, perm, prod

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

# Larger control points are scaled, because products of them would overflow.

MAX_UNSCALED = 1e150
ORDERS = 3  # of ``derivatives_of_each``: value, first and second derivative


def clamped_knots(points: int, degree: int) -> Array:
    """Return the knot vector of the paper's Appendix A, shape (points + degree + 1,)."""
    inner = np.arange(1, points - degree) / (points - degree)
    return np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])


def basis(s: Array, points: int, degree: int, order: int = 0) -> Array:
    """Evaluate every basis function at phases s, or a derivative of some order, by the Cox-de Boor recursion.

    Phases in [0, 1] have shape (K,), the result (K, C): ``basis(s, C, D, order) @
    control_points`` is the derivative of the spline.
    """
    # A derivative is a spline of lower degree, whose control points are differences.
    knots, matrix = derivative(points, degree, order)
    degree -= order
    # Index of the first basis function that is not zero at s; s = 1 is in the last
    # span.
    first = (
        np.clip(np.searchsorted(knots, s, side="right") - 1, degree, len(matrix) - 1)
        - degree
    )
    values = np.zeros((len(s), points))
    for k, weight in enumerate(_cox_de_boor(s, knots, degree, first)):
        values += weight[:, None] * matrix[first + k]
    return values


def basis_tables(
    spec: TrajectorySpec, s: Array, orders: int
) -> tuple[list[Array], list[Array]]:
    """Evaluate the bases of p, shape (K, C), at K phases for each of some orders, and those of r, (K, R), one order less."""
    path = spec.path_control_points
    rate = spec.rate_control_points
    return (
        [basis(s, path, spec.degree, order) for order in range(orders)],
        [basis(s, rate, spec.degree, order) for order in range(orders - 1)],
    )


def derivative(points: int, degree: int, order: int) -> tuple[Array, Array]:
    """Return the knots of a derivative of a spline, and the matrix from its control points to those of the derivative.

    The shapes are (C + D + 1 - 2 order,) and (C - order, C); the derivative's degree is
    D - order.
    """
    knots = clamped_knots(points, degree)
    matrix = np.eye(points)
    for p in range(degree, degree - order, -1):
        # c'_i = p (c_{i+1} - c_i) / (t_{i+p+1} - t_{i+1}), as rows of a matrix.
        matrix = (
            np.diff(matrix, axis=0)
            * p
            / (knots[p + 1 : -1] - knots[1 : -p - 1])[:, None]
        )
        knots = knots[1:-1]
    return knots, matrix


def _cox_de_boor(s: Array, knots: Array, degree: int, first: NDArray[np.intp]) -> Array:
    """Evaluate the D + 1 basis functions that are not 0 at phases s, the first one given, shape (D + 1, K).

    The recursion is that of SciPy.
    """
    weights = np.ones((1, len(s)))
    right = first + degree + 1 + np.arange(degree)[:, None]
    for p in range(1, degree + 1):
        high = knots[right[:p]]
        low = knots[right[:p] - p]
        # Each weight is shared between two functions of the next degree, in proportion
        # to the distances from their knots.
        share = weights / (high - low)
        weights = np.zeros((p + 1, len(s)))
        weights[1:] = share * (s - low)
        weights[:-1] += share * (high - s)
    return weights


def power_coefficients(control: Array, degree: int) -> Array:
    """Convert N splines to the power basis of each span, for ``select_spans`` and ``horner``.

    Control points have shape (N, C) or (N, C, n), the coefficients of the powers of (s
    - left knot), highest first, shape (D + 1, spans, N, ...).
    """
    matrices = taylor_coefficients(control.shape[1], degree)[::-1]
    columns = control.reshape(*control.shape[:2], prod(control.shape[2:]))
    # Motion by motion.
    powers = np.ascontiguousarray((matrices[:, None] @ columns).swapaxes(1, 2))
    return powers.reshape(*matrices.shape[:2], len(control), *control.shape[2:])


@cache
def taylor_coefficients(points: int, degree: int) -> Array:
    """Return the Taylor coefficients of every basis function at every left knot, shape (D + 1, spans, C).

    Entry k times the control points gives the coefficients of (s - left knot)^k.
    """
    left = np.arange(points - degree) / (points - degree)
    return np.stack(
        [
            basis(left, points, degree, order) / factorial(order)
            for order in range(degree + 1)
        ]
    )


def select_spans(coefficients: Array, s: Array) -> tuple[Array, Array]:
    """Select, for every spline, the coefficients of the spans that contain its phases in [0, 1], shape (N, K).

    The result are the coefficients, shape (D + 1, N, K, ...), and s - left knot, shape
    (N, K).
    """
    spans = coefficients.shape[1]
    span = np.clip(np.nan_to_num(s) * spans, 0, spans - 1).astype(np.intp)
    return coefficients[:, span, np.arange(len(s))[:, None]], s - span / spans


def horner(selected: Array, offset: Array, order: int = 0) -> Array:
    """Evaluate the polynomials of ``select_spans``, or a derivative of some order, by Horner's rule.

    Phases minus left knots have shape (N, K), or (M, N, K) for M phases of each
    polynomial; values the same with (...).
    """
    degree = len(selected) - 1
    offset = offset.reshape(*offset.shape, *(1,) * (selected.ndim - 3))
    value = np.zeros(selected.shape[1:])
    powers = range(degree, order - 1, -1)
    for coefficients in (
        # d^k x^p = p (p - 1) ... (p - k + 1) x^(p - k): the factors are ``perm``.
        [perm(power, order) * selected[degree - power] for power in powers]
        if order
        else selected
    ):
        value = value * offset + coefficients
    return value


def derivatives_of_each(control: Array, degree: int, s: Array) -> Array:
    """Evaluate N splines and their first two derivatives, each at its own phase in [0, 1], shape (3, N, n).

    Control points have shape (N, C, n).
    """
    spans = control.shape[1] - degree
    span = np.minimum((s * spans).astype(np.intp), spans - 1)
    factor, exponent = _powers(degree)
    # (N, 3, D + 1)
    powers = factor * (s - span / spans)[:, None, None] ** exponent
    # (N, D + 1, C)
    table = taylor_coefficients(control.shape[1], degree)[:, span].swapaxes(0, 1)
    return np.asarray((powers @ table @ control).swapaxes(0, 1))


@cache
def _powers(degree: int) -> tuple[Array, Array]:
    """Return factors and exponents of x in the derivatives of x^k, shape (3, D + 1) each."""
    orders = range(ORDERS)
    powers = range(degree + 1)
    factor = np.array([[perm(k, order) for k in powers] for order in orders], float)
    return factor, np.array([[max(k - order, 0) for k in powers] for order in orders])


def extrema(control: Array, degree: int) -> tuple[Array, Array]:
    """Return the ends and the critical points of one spline on [0, 1], shape (C,) and finite, and its values there."""
    from scipy.interpolate import BSpline, PPoly

    # A power of two, exact in floating point.
    scale = 2.0**-600 if np.abs(control).max() > MAX_UNSCALED else 1.0
    spline = BSpline(clamped_knots(len(control), degree), control * scale, degree)
    roots = PPoly.from_spline(spline.derivative()).roots(extrapolate=False)
    s = np.clip(np.concatenate([[0.0, 1.0], roots[np.isfinite(roots)]]), 0, 1)
    return s, np.asarray(spline(s)) / scale


@dataclass(frozen=True)
class EndDerivatives:
    """Factors of the derivatives of a clamped uniform B-spline at s = 0 (mirrored at s = 1).

    ``x'(0) = eta (c1 - c0)`` with ``eta = D (C - D)`` (the paper's Appendix A prints
    the square of C - D) and ``x''(0) = beta (c2 - 3 c1 + 2 c0)`` with ``beta = D (D -
    1) / 2 (C - D)^2``; both need C >= D + 2.
    """

    eta: float  # factor of the first derivative
    beta: float  # factor of the second derivative


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
    """Return the edges of quadrature cells on [0, 1] in which 1 / r is smooth enough for eight Gauss nodes.

    There are four cells per span, and cells that halve towards s = 0 and s = 1. There
    the first basis function is 0.01 wide, and 1 / r is nearly singular if the first
    control point is much smaller than the second. With cells of equal size the duration
    of such motions is wrong in the third digit. The edges ascend from 0 to 1 and
    include the knots.
    """
    spans = points - degree
    end = 0.5 ** np.arange(24, 2, -1)
    return (
        np.unique(
            np.concatenate([np.linspace(0, spans, 4 * spans + 1), end, spans - end])
        )
        / spans
    )


def edges_around(s: Array, points: int, degree: int) -> Array:
    """Return the edges of ``graded_edges`` and of cells that halve towards phases s, shape (K,).

    They are for an r with a minimum close to 0 between its ends.
    """
    offsets = np.concatenate([[0.0], 0.5 ** np.arange(26, 2, -1)]) / (points - degree)
    close = np.concatenate([s[:, None] - offsets, s[:, None] + offsets], axis=None)
    return np.union1d(graded_edges(points, degree), close[(close > 0) & (close < 1)])
