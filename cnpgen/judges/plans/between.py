"""The largest value of a joint's position, velocity, acceleration and jerk over a motion, between any two moments.

Between knots they are polynomials in s: q of degree D, dq = p' r of degree 2 D - 1, ddq = (p'' r + p' r') r of degree
3 D - 2 and jerk = ((p''' r + 3 p'' r') r + p' (r'' r + r'^2)) r of degree 4 D - 3. A polynomial in Bernstein form lies
between its least and its largest coefficient, and halving its interval brings those closer by a factor of four: halving
wherever the largest value could still be proves where it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import accumulate, pairwise, product
from math import comb

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import derivative

Array = NDArray[np.float64]
Peak = tuple[float, int, float]  # value, of which function, at which phase

CLOSE = 1e-6  # how far below the largest value the one that is found may be, where that decides whether it is above 1
ROUGH = 1e-2  # the same elsewhere
DIVISIONS = 40  # at most: pieces are then shorter than a picosecond


@dataclass(frozen=True)
class Pieces:
    """Joint positions and their derivatives in time as polynomials between knots, in Bernstein form.

    Attributes:
        edges: Phases between which they are polynomials, ascending from 0 to 1, shape (S + 1,).
        q: Coefficients [rad], shape (D + 1, S, n).
        dq: Coefficients [rad/s], shape (2 D, S, n).
        ddq: Coefficients [rad/s^2], shape (3 D - 1, S, n).
        jerk: Coefficients [rad/s^3], shape (4 D - 2, S, n); None where they are not wanted.
    """

    edges: Array
    q: Array
    dq: Array
    ddq: Array
    jerk: Array | None = None


def polynomials(motion: Motion, *, jerk: bool = False) -> Pieces:
    """Return the polynomials of one motion, those of its jerks if they are wanted."""
    degree, path, rate = motion.degree, motion.path[0], motion.rate[0, :, None]
    edges = _edges(len(path), len(rate), degree)
    p, p1, p2, *p3 = in_bernstein_form(path, degree, range(3 + jerk), edges)
    r, r1, *r2 = in_bernstein_form(rate, degree, range(2 + jerk), edges)
    first, r_r = _product(np.concatenate([p1, r1], axis=2), r), _product(r, r)
    dq, r1_r = first[..., :-1], first[..., -1:]
    ddq = _product(p2, r_r) + _product(p1, r1_r)
    if not jerk:
        return Pieces(edges, q=p, dq=dq, ddq=ddq)
    bends = _product(p3[0], _product(r_r, r)) + _product(p2, 3 * _product(r1_r, r))
    third = bends + _product(p1, _product(_product(r2[0], r) + _product(r1, r1), r))
    return Pieces(edges, q=p, dq=dq, ddq=ddq, jerk=third)


def largest(
    rows: Array, edges: Array, known: Peak = (-np.inf, 0, 0.0), *, least: float = -np.inf, parts: int = 2
) -> Peak:
    """Find the largest value of piecewise polynomials to within ``ROUGH``, and whether it is above 1 to ``CLOSE``.

    Args:
        rows: Bernstein coefficients of M functions, finite, shape (d + 1, S, M).
        edges: Phases between which they are polynomials, shape (S + 1,).
        known: A value that is attained, as returned.
        least: What is proven to be no larger than this, at most 1, is not looked into.
        parts: How many parts a piece is divided into at a time, a power of 2.

    Returns:
        ``(value, row, s)``: the largest value that is attained, of which function, at which phase.
    """
    best, *at = known
    starts = np.arange(parts)[:, None] / parts
    span, of_row = (rows.max(axis=0) > _worth_dividing(best, least)).nonzero()
    pieces, left, width = rows[:, span, of_row], edges[span], (edges[1:] - edges[:-1])[span]
    for _ in range(DIVISIONS):
        if not len(span):
            break
        pieces = (_dividing(len(rows), parts) @ pieces).reshape(len(rows), -1)
        left = (left + starts * width).ravel()
        width, of_row = np.concatenate([width / parts] * parts), np.concatenate([of_row] * parts)
        for values, s in ((pieces[0], left), (pieces[-1], left + width)):
            top = int(values.argmax())
            if values[top] > best:
                best, *at = float(values[top]), int(of_row[top]), float(s[top])
        (span,) = (pieces.max(axis=0) > _worth_dividing(best, least)).nonzero()
        pieces, of_row, left, width = pieces[:, span], of_row[span], left[span], width[span]
    return best, int(at[0]), at[1]


def _worth_dividing(best: float, least: float) -> float:
    """Return what the largest coefficient of a piece is above if it could hide more than is known."""
    return max(least, best + ROUGH if best > 1 else min(best + ROUGH, max(1.0, best + CLOSE)))


@cache
def knots(path_points: int, rate_points: int, degree: int) -> frozenset[float]:
    """Return the knots of both splines of a motion."""
    spans = (path_points - degree, rate_points - degree)
    return frozenset({round(k / count, 12): k / count for count in spans for k in range(count + 1)}.values())


@cache
def _edges(path_points: int, rate_points: int, degree: int) -> Array:
    """Return these in their order."""
    return np.array(sorted(knots(path_points, rate_points, degree)))


def in_bernstein_form(control: Array, degree: int, orders: Sequence[int], edges: Array) -> list[Array]:
    """Return derivatives of splines between edges, shape (D - order + 1, S, n) each; ``control`` has shape (C, n)."""
    matrix = _to_bernstein_form(len(control), degree, tuple(orders), tuple(edges.tolist()))
    pieces = (matrix @ control).reshape(-1, len(edges) - 1, control.shape[1])
    ends = accumulate((degree - order + 1 for order in orders), initial=0)
    return [pieces[first:last] for first, last in pairwise(ends)]


@cache
def _to_bernstein_form(points: int, degree: int, orders: tuple[int, ...], edges: tuple[float, ...]) -> Array:
    """Return the matrix from control points to a derivative's Bernstein coefficients, and then to the next one's.

    The coefficients between a and b are the values of the derivative's polar form, at arguments of which ever more are
    b instead of a (Ramshaw, "Blossoms are polar forms", 1989). Its shape is (all of them, C), piece after piece of the
    first coefficient, then of the second.
    """
    rows = []
    for order in orders:
        (knots, matrix), size = derivative(points, degree, order), degree - order
        for k, (low, high) in product(range(size + 1), pairwise(edges)):
            last = int(np.searchsorted(knots, (low + high) / 2)) - 1
            rows.append(_polar(knots, last, [low] * (size - k) + [high] * k) @ matrix)
    return np.array(rows)


def _polar(knots: Array, last: int, arguments: list[float]) -> Array:
    """Return what every control point contributes to a polar form, by de Boor's recursion, shape (C,).

    Args:
        knots: Knots.
        last: Index of the last control point that counts between these knots.
        arguments: Phases, as many as the degree.
    """
    degree = len(arguments)
    worth = np.eye(len(knots) - degree - 1)[last - degree : last + 1]
    for p, s in enumerate(arguments, start=1):
        k = np.arange(last - degree + p, last + 1)
        share = ((s - knots[k]) / (knots[k + degree - p + 1] - knots[k]))[:, None]
        worth = (1 - share) * worth[:-1] + share * worth[1:]
    return np.asarray(worth[0])


def _product(a: Array, b: Array) -> Array:
    """Multiply functions (i + 1, S, n) by one function (j + 1, S, 1), piece by piece."""
    i, j = len(a) - 1, len(b) - 1
    times_b = (b[..., 0].T @ _products(i, j)).reshape(-1, i + j + 1, i + 1)
    found = np.empty((i + j + 1, *a.shape[1:]))
    np.matmul(times_b, a.swapaxes(0, 1), out=found.swapaxes(0, 1))
    return found


@cache
def _products(i: int, j: int) -> Array:
    """Return what makes, of one function's coefficients, the matrix that multiplies by it, shape (j+1, (i+j+1) (i+1)).

    That matrix turns coefficients of a function of degree i into those of the product.
    """
    matrix = np.zeros((j + 1, i + j + 1, i + 1))
    for k in range(i + 1):
        for m in range(j + 1):
            matrix[m, k + m, k] = comb(i, k) * comb(j, m) / comb(i + j, k + m)
    return matrix.reshape(j + 1, -1)


@cache
def _dividing(size: int, parts: int) -> Array:
    """Return de Casteljau's matrix for parts of equal length, a power of 2, shape (parts (d + 1), d + 1).

    It turns coefficients into the first ones of all parts, then the second ones of all, and so on.
    """
    first = np.array([[comb(k, m) / 2**k for m in range(size)] for k in range(size)])
    found = [np.eye(size)]
    while len(found) < parts:
        found = [half @ each for each in found for half in (first, first[::-1, ::-1])]
    return np.stack(found, axis=1).reshape(-1, size)
