"""Proven maxima of a joint's position, velocity, acceleration and jerk over a motion, from Bernstein coefficients.

Between knots they are polynomials in s: q of degree D, dq = p' r of degree 2 D - 1, ddq
= (p'' r + p' r') r of degree 3 D - 2 and jerk = ((p''' r + 3 p'' r') r + p' (r'' r +
r'^2)) r of degree 4 D - 3. A polynomial in Bernstein form lies between its smallest and
its largest coefficient, and halving its interval reduces their distance by a factor of
four. Subdividing wherever the maximum could still be proves where it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import accumulate, pairwise, product
from math import comb

import numpy as np

from cnpgen.arrays import Array
from cnpgen.judges.plans.scipy_splines import derivative_matrix
from cnpgen.trajectory.spline_motion import Motion

Maximum = tuple[float, int, float]  # value, index of the function, phase

LIMIT_DECISION_TOLERANCE = 1e-6  # error of a maximum that decides whether it is above 1
LIMIT_VALUE_TOLERANCE = 1e-2  # error of any other maximum
MAX_SUBDIVISIONS = 40  # intervals are then shorter than a picosecond


@dataclass(frozen=True)
class PiecewisePolynomials:
    """Joint positions and their time derivatives as polynomials between knots, in Bernstein form."""

    # Phases between which they are polynomials, ascending from 0 to 1, shape (S + 1,).
    edges: Array
    q: Array  # coefficients [rad], shape (D + 1, S, n)
    dq: Array  # coefficients [rad/s], shape (2 D, S, n)
    ddq: Array  # coefficients [rad/s^2], shape (3 D - 1, S, n)
    # Coefficients [rad/s^3], shape (4 D - 2, S, n), or None if no constraint needs
    # them.
    jerk: Array | None = None


def polynomials(motion: Motion, *, jerk: bool = False) -> PiecewisePolynomials:
    """Return the polynomials of one motion, optionally with those of its jerks."""
    degree = motion.degree
    path = motion.path[0]
    rate = motion.rate[0, :, None]
    edges = knots(len(path), len(rate), degree)
    p, p1, p2, *p3 = bernstein_coefficients(path, degree, range(3 + jerk), edges)
    r, r1, *r2 = bernstein_coefficients(rate, degree, range(2 + jerk), edges)
    # dq = p' r and r' r share one product
    first = _product(np.concatenate([p1, r1], axis=2), r)
    r_r = _product(r, r)
    dq = first[..., :-1]
    r1_r = first[..., -1:]
    # p'' r^2 + p' r' r
    ddq = _product(p2, r_r) + _product(p1, r1_r)
    if not jerk:
        return PiecewisePolynomials(edges, q=p, dq=dq, ddq=ddq)
    # jerk = p''' r^3 + 3 p'' r' r^2 + p' (r'' r + r'^2) r
    higher = _product(p3[0], _product(r_r, r)) + _product(p2, 3 * _product(r1_r, r))
    third = higher + _product(p1, _product(_product(r2[0], r) + _product(r1, r1), r))
    return PiecewisePolynomials(edges, q=p, dq=dq, ddq=ddq, jerk=third)


def find_maximum(
    rows: Array,
    edges: Array,
    known: Maximum = (-np.inf, 0, 0.0),
    *,
    threshold: float = -np.inf,
    parts: int = 2,
) -> Maximum:
    """Find the maximum of piecewise polynomials to ``LIMIT_VALUE_TOLERANCE``, and if it is above 1 more precisely.

    Args:
        rows: Bernstein coefficients of M functions, finite, shape (d + 1, S, M).
        edges: Phases between which they are polynomials, shape (S + 1,).
        known: A value that is attained, in the form of the result.
        threshold: Value, at most 1, below which spans are not searched.
        parts: Number of parts of a span per subdivision, a power of 2.
    """
    best, *at = known
    # Only spans whose largest coefficient, an upper bound, exceeds what is known matter.
    starts = np.arange(parts)[:, None] / parts
    span, of_row = (rows.max(axis=0) > _search_threshold(best, threshold)).nonzero()
    # A width of an interval for each coefficient vector; ``of_row`` is its function.
    coefficients = rows[:, span, of_row]
    left = edges[span]
    width = (edges[1:] - edges[:-1])[span]
    for _ in range(MAX_SUBDIVISIONS):
        if not len(span):
            break
        # The coefficients of each part by de Casteljau; the first and the last of them are
        # values at its ends, which raise the known maximum.
        halved = _subdivision(len(rows), parts) @ coefficients
        coefficients = halved.reshape(len(rows), -1)
        left = (left + starts * width).ravel()
        width = np.tile(width / parts, parts)
        of_row = np.tile(of_row, parts)
        for values, s in ((coefficients[0], left), (coefficients[-1], left + width)):
            top = int(values.argmax())
            if values[top] > best:
                best, *at = float(values[top]), int(of_row[top]), float(s[top])
        # Parts whose upper bound exceeds the new maximum are subdivided again.
        upper_bounds = coefficients.max(axis=0)
        (span,) = (upper_bounds > _search_threshold(best, threshold)).nonzero()
        coefficients = coefficients[:, span]
        of_row = of_row[span]
        left = left[span]
        width = width[span]
    return best, int(at[0]), at[1]


def _search_threshold(best: float, threshold: float) -> float:
    """Return the largest coefficient above which an interval may contain a relevant larger value."""
    # A maximum near 1 decides about the verdict and is found precisely; far above or
    # below 1 a coarse value is enough.
    precise = min(
        best + LIMIT_VALUE_TOLERANCE, max(1.0, best + LIMIT_DECISION_TOLERANCE)
    )
    return max(threshold, best + LIMIT_VALUE_TOLERANCE if best > 1 else precise)


@cache
def knots(path_points: int, rate_points: int, degree: int) -> Array:
    """Return the knots of both splines of a motion in ascending order."""
    spans = (path_points - degree, rate_points - degree)
    return np.array(
        # Knots of both splines that agree up to rounding are one knot.
        sorted(
            {
                round(k / count, 12): k / count
                for count in spans
                for k in range(count + 1)
            }.values()
        )
    )


def bernstein_coefficients(
    control: Array, degree: int, orders: Sequence[int], edges: Array
) -> list[Array]:
    """Return derivatives of splines between edges in Bernstein form, shape (D - order + 1, S, n) each.

    ``control`` has shape (C, n).
    """
    matrix = _to_bernstein_form(
        len(control), degree, tuple(orders), tuple(edges.tolist())
    )
    coefficients = (matrix @ control).reshape(-1, len(edges) - 1, control.shape[1])
    ends = accumulate((degree - order + 1 for order in orders), initial=0)
    return [coefficients[first:last] for first, last in pairwise(ends)]


@cache
def _to_bernstein_form(
    points: int, degree: int, orders: tuple[int, ...], edges: tuple[float, ...]
) -> Array:
    """Return the matrix from control points to the Bernstein coefficients of derivatives, one order after the other.

    The coefficients between a and b are the values of the derivative's polar form, with
    an increasing number of arguments b instead of a (Ramshaw, "Blossoms are polar
    forms", 1989). The matrix has one row per coefficient: all spans of the first
    coefficient, then all spans of the second.
    """
    rows = []
    for order in orders:
        knots, matrix = derivative_matrix(points, degree, order)
        size = degree - order
        for k, (low, high) in product(range(size + 1), pairwise(edges)):
            # The last knot before the middle of the interval: the polar form of its
            # span.
            last = int(np.searchsorted(knots, (low + high) / 2)) - 1
            rows.append(_polar(knots, last, [low] * (size - k) + [high] * k) @ matrix)
    return np.array(rows)


def _polar(knots: Array, last: int, arguments: list[float]) -> Array:
    """Return the weights of control points in a polar form, by de Boor's recursion, shape (C,); none after ``last``."""
    degree = len(arguments)
    weights = np.eye(len(knots) - degree - 1)[last - degree : last + 1]
    for p, s in enumerate(arguments, start=1):
        k = np.arange(last - degree + p, last + 1)
        # de Boor: each step blends neighboring control points by the argument's place
        # between their knots.
        fraction = ((s - knots[k]) / (knots[k + degree - p + 1] - knots[k]))[:, None]
        weights = (1 - fraction) * weights[:-1] + fraction * weights[1:]
    return np.asarray(weights[0])


def _product(a: Array, b: Array) -> Array:
    """Multiply functions (i + 1, S, n) by one function (j + 1, S, 1), span by span."""
    # Order of the axes: one matrix per span, built from b, multiplies all functions of
    # the span.
    i = len(a) - 1
    j = len(b) - 1
    times_b = (b[..., 0].T @ _products(i, j)).reshape(-1, i + j + 1, i + 1)
    result = np.empty((i + j + 1, *a.shape[1:]))
    np.matmul(times_b, a.swapaxes(0, 1), out=result.swapaxes(0, 1))
    return result


@cache
def _products(i: int, j: int) -> Array:
    """Return the matrix that maps coefficients of a factor to the matrix that multiplies by it.

    Its shape is (j + 1, (i + j + 1) (i + 1)).
    """
    matrix = np.zeros((j + 1, i + j + 1, i + 1))
    for k in range(i + 1):
        for m in range(j + 1):
            # B_k^i B_m^j = C(i, k) C(j, m) / C(i + j, k + m) B_(k+m)^(i+j)
            matrix[m, k + m, k] = comb(i, k) * comb(j, m) / comb(i + j, k + m)
    return matrix.reshape(j + 1, -1)


@cache
def _subdivision(size: int, parts: int) -> Array:
    """Return de Casteljau's matrix for equal parts, all first coefficients first, shape (parts (d + 1), d + 1)."""
    # Coefficient k of the first half is the mean of the first k + 1 ones by binomial
    # weights; the second half is its mirror image.
    first = np.array([[comb(k, m) / 2**k for m in range(size)] for k in range(size)])
    matrices = [np.eye(size)]
    while len(matrices) < parts:
        matrices = [
            half @ matrix for matrix in matrices for half in (first, first[::-1, ::-1])
        ]
    return np.stack(matrices, axis=1).reshape(-1, size)
