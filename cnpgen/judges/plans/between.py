"""The largest value of a joint's position, velocity, acceleration and jerk over a motion, between any two moments.

Between knots they are polynomials in s: q of degree D, dq = p' r of degree 2 D - 1, ddq = (p'' r + p' r') r of degree
3 D - 2 and jerk = ((p''' r + 3 p'' r') r + p' (r'' r + r'^2)) r of degree 4 D - 3. A polynomial in Bernstein form lies
between its least and its largest coefficient, and halving its interval brings those closer by a factor of four: halving
wherever the largest value could still be proves where it is.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import comb

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import derivative

Array = NDArray[np.float64]
Peak = tuple[float, int, float]  # value, of which function, at which phase

CLOSE = 1e-6  # how far below the largest value the one that is found may be, where that decides whether it is above 1
ROUGH = 1e-2  # the same elsewhere
HALVINGS = 40  # at most: pieces are then shorter than a picosecond


@dataclass(frozen=True)
class Pieces:
    """Joint positions and their derivatives in time as polynomials between knots, in Bernstein form.

    Attributes:
        edges: Phases between which they are polynomials, ascending from 0 to 1, shape (S + 1,).
        q: Coefficients [rad], shape (n, S, D + 1).
        dq: Coefficients [rad/s], shape (n, S, 2 D).
        ddq: Coefficients [rad/s^2], shape (n, S, 3 D - 1).
        jerk: Coefficients [rad/s^3], shape (n, S, 4 D - 2); None where they are not wanted.
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
    p, p1, p2 = (in_bernstein_form(path, degree, order, edges) for order in range(3))
    r, r1 = (in_bernstein_form(rate, degree, order, edges) for order in range(2))
    ddq = _product(_product(p2, r) + _product(p1, r1), r)
    if not jerk:
        return Pieces(edges, q=p, dq=_product(p1, r), ddq=ddq)
    p3, r2 = in_bernstein_form(path, degree, 3, edges), in_bernstein_form(rate, degree, 2, edges)
    bends = _product(_product(p3, r) + 3 * _product(p2, r1), r)
    third = _product(bends + _product(p1, _product(r2, r) + _product(r1, r1)), r)
    return Pieces(edges, q=p, dq=_product(p1, r), ddq=ddq, jerk=third)


def largest(rows: Array, edges: Array, known: Peak = (-np.inf, 0, 0.0), *, least: float = -np.inf) -> Peak:
    """Find the largest value of piecewise polynomials to within ``ROUGH``, and whether it is above 1 to ``CLOSE``.

    Args:
        rows: Bernstein coefficients of M functions, finite, shape (M, S, d + 1).
        edges: Phases between which they are polynomials, shape (S + 1,).
        known: A value that is attained, as returned.
        least: What is proven to be no larger than this, at most 1, is not looked into.

    Returns:
        ``(value, row, s)``: the largest value that is attained, of which function, at which phase.
    """
    best, *at = known
    of_row, span = np.nonzero(_worth_halving(rows.max(axis=2), best, least))
    pieces, left, width = rows[of_row, span], edges[span], np.diff(edges)[span]
    for _ in range(HALVINGS):
        if not len(pieces):
            break
        width = width / 2
        left = np.concatenate([left, left + width])
        width, of_row = np.concatenate([width, width]), np.concatenate([of_row, of_row])
        pieces = np.concatenate([pieces @ half for half in _halving(rows.shape[2])])
        for k, s in ((0, left), (-1, left + width)):
            top = int(np.argmax(pieces[:, k]))
            if pieces[top, k] > best:
                best, *at = float(pieces[top, k]), int(of_row[top]), float(s[top])
        kept = _worth_halving(pieces.max(axis=1), best, least)
        pieces, of_row, left, width = pieces[kept], of_row[kept], left[kept], width[kept]
    return best, int(at[0]), at[1]


def _worth_halving(hull: Array, best: float, least: float) -> NDArray[np.bool_]:
    """Find pieces whose largest coefficients could hide more than is known."""
    return np.asarray((hull > least) & (hull > best + np.where((hull > 1) & (best <= 1), CLOSE, ROUGH)))


@cache
def knots(path_points: int, rate_points: int, degree: int) -> frozenset[float]:
    """Return the knots of both splines of a motion."""
    spans = (path_points - degree, rate_points - degree)
    return frozenset({round(k / count, 12): k / count for count in spans for k in range(count + 1)}.values())


@cache
def _edges(path_points: int, rate_points: int, degree: int) -> Array:
    """Return these in their order."""
    return np.array(sorted(knots(path_points, rate_points, degree)))


def in_bernstein_form(control: Array, degree: int, order: int, edges: Array) -> Array:
    """Return a derivative of splines between edges, shape (n, S, D - order + 1); ``control`` has shape (C, n)."""
    matrix = _to_bernstein_form(len(control), degree, order, tuple(edges.tolist()))
    pieces = (matrix @ control).reshape(len(edges) - 1, degree - order + 1, -1)
    return np.ascontiguousarray(pieces.transpose(2, 0, 1))


@cache
def _to_bernstein_form(points: int, degree: int, order: int, edges: tuple[float, ...]) -> Array:
    """Return the matrix from control points to a derivative's Bernstein coefficients, shape (S (D - order + 1), C).

    The coefficients between a and b are the values of the derivative's polar form, at arguments of which ever more are
    b instead of a (Ramshaw, "Blossoms are polar forms", 1989).
    """
    knots, matrix = derivative(points, degree, order)
    degree -= order
    rows = []
    for low, high in pairwise(edges):
        last = int(np.searchsorted(knots, (low + high) / 2)) - 1
        rows += [_polar(knots, last, [low] * (degree - k) + [high] * k) for k in range(degree + 1)]
    return np.asarray(np.array(rows) @ matrix)


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
    """Multiply functions (n, S, i + 1) by one function (1, S, j + 1), piece by piece."""
    outer = (a[..., :, None] * b[..., None, :]).reshape(-1, a.shape[-1] * b.shape[-1])
    return np.asarray((outer @ _products(a.shape[-1] - 1, b.shape[-1] - 1)).reshape(*a.shape[:-1], -1))


@cache
def _products(i: int, j: int) -> Array:
    """Return the matrix from products of coefficients to coefficients of the product, shape ((i+1) (j+1), i+j+1)."""
    matrix = np.zeros((i + 1, j + 1, i + j + 1))
    for k in range(i + 1):
        for m in range(j + 1):
            matrix[k, m, k + m] = comb(i, k) * comb(j, m) / comb(i + j, k + m)
    return matrix.reshape(-1, i + j + 1)


@cache
def _halving(size: int) -> tuple[Array, Array]:
    """Return de Casteljau's matrices at the middle: ``coefficients @ first`` are those of the first half."""
    first = np.array([[comb(k, m) / 2**k for k in range(size)] for m in range(size)])
    return first, np.ascontiguousarray(first[::-1, ::-1])
