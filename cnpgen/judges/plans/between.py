"""The largest value of a joint's position, velocity and acceleration over a whole motion, between any two moments.

Between knots they are polynomials in s: q of degree D, dq = p' r of degree 2 D - 1 and ddq = (p'' r + p' r') r of
degree 3 D - 2. A polynomial in Bernstein form lies between its least and its largest coefficient, and halving its
interval brings those closer by a factor of four: halving wherever the largest value could still be proves where it is.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import comb

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import basis

Array = NDArray[np.float64]

CLOSE = 1e-6  # how far below the largest value the one that is found may be
ROUGH = 1e-3  # the same where the largest value is below 1, so that nothing depends on it
HALVINGS = 40  # at most: pieces are then shorter than a picosecond


@dataclass(frozen=True)
class Pieces:
    """Joint positions and their derivatives in time as polynomials between knots, in Bernstein form.

    Attributes:
        edges: Phases between which they are polynomials, ascending from 0 to 1, shape (S + 1,).
        q: Coefficients [rad], shape (n, S, D + 1).
        dq: Coefficients [rad/s], shape (n, S, 2 D).
        ddq: Coefficients [rad/s^2], shape (n, S, 3 D - 1).
    """

    edges: Array
    q: Array
    dq: Array
    ddq: Array


def polynomials(motion: Motion) -> Pieces:
    """Return the polynomials of one motion."""
    degree = motion.degree
    edges = _edges(motion.path.shape[1], motion.rate.shape[1], degree)
    width = np.diff(edges)[:, None]
    p = _in_bernstein_form(motion.path[0], degree, edges)
    r = _in_bernstein_form(motion.rate[0, :, None], degree, edges)
    p1, r1 = _derivative(p, width), _derivative(r, width)
    p2 = _derivative(p1, width)
    return Pieces(edges, q=p, dq=_product(p1, r), ddq=_product(_product(p2, r) + _product(p1, r1), r))


def largest(rows: Array, edges: Array) -> tuple[float, int, float]:
    """Find the largest value of piecewise polynomials: to within ``CLOSE``, or ``ROUGH`` where it is below 1.

    Args:
        rows: Bernstein coefficients of M functions, finite, shape (M, S, d + 1).
        edges: Phases between which they are polynomials, shape (S + 1,).

    Returns:
        ``(value, row, s)``: the largest value that is attained, of which function, at which phase.
    """
    count, spans, size = rows.shape
    pieces = rows.reshape(-1, size)
    of_row = np.repeat(np.arange(count), spans)
    left, width = np.tile(edges[:-1], count), np.tile(np.diff(edges), count)
    best, at = -np.inf, (0, 0.0)
    for _ in range(HALVINGS):
        for k, s in ((0, left), (-1, left + width)):
            top = int(np.argmax(pieces[:, k]))
            if pieces[top, k] > best:
                best, at = float(pieces[top, k]), (int(of_row[top]), float(s[top]))
        hull = pieces.max(axis=1)
        open_ = hull > best + np.where(hull < 1, ROUGH, CLOSE)
        if not open_.any():
            break
        pieces, of_row, left, width = pieces[open_], of_row[open_], left[open_], width[open_] / 2
        first, second = _halving(size)
        pieces = np.concatenate([pieces @ first, pieces @ second])
        of_row, left, width = np.tile(of_row, 2), np.concatenate([left, left + width]), np.tile(width, 2)
    return best, *at


@cache
def _edges(path_points: int, rate_points: int, degree: int) -> Array:
    """Return the knots of both splines."""
    spans = (path_points - degree, rate_points - degree)
    knots = {round(k / count, 12): k / count for count in spans for k in range(count + 1)}
    return np.array([knots[key] for key in sorted(knots)])


def _in_bernstein_form(control: Array, degree: int, edges: Array) -> Array:
    """Return a spline's coefficients between edges, shape (n, S, D + 1); ``control`` has shape (C, n)."""
    matrix = _to_bernstein_form(len(control), degree, tuple(edges.tolist()))
    return np.ascontiguousarray((matrix @ control).reshape(len(edges) - 1, degree + 1, -1).transpose(2, 0, 1))


@cache
def _to_bernstein_form(points: int, degree: int, edges: tuple[float, ...]) -> Array:
    """Return the matrix from control points to Bernstein coefficients between edges, shape (S (D + 1), C).

    The coefficients interpolate the spline at D + 1 Chebyshev points inside each piece.
    """
    x = (1 - np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))) / 2
    powers = np.arange(degree + 1)
    values = [comb(degree, k) for k in powers] * x[:, None] ** powers * (1 - x[:, None]) ** (degree - powers)
    inverse = np.linalg.inv(values)
    pieces = [inverse @ basis(low + (high - low) * x, points, degree) for low, high in pairwise(edges)]
    return np.concatenate(pieces)


def _derivative(coefficients: Array, width: Array) -> Array:
    """Differentiate with respect to s; ``width`` of the pieces has shape (S, 1)."""
    return np.asarray((coefficients.shape[-1] - 1) * np.diff(coefficients, axis=-1) / width)


def _product(a: Array, b: Array) -> Array:
    """Multiply functions (n, S, i + 1) by one function (1, S, j + 1), piece by piece."""
    outer = (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:-1], -1)
    return np.asarray(outer @ _products(a.shape[-1] - 1, b.shape[-1] - 1))


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
