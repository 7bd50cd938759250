"""The judges' own evaluation of B-splines, by SciPy.

It is independent of ``cnpgen.trajectory`` on purpose: an error in the splines of
planners and solvers must not hide itself from the verdict. Of ``cnpgen.trajectory`` the
judges use the control points of motions and nothing else.
"""

from collections.abc import Sequence
from functools import cache
from math import factorial
from typing import TYPE_CHECKING

import numpy as np

from cnpgen.arrays import Array

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

MAX_UNSCALED_RATE = 1e150  # 1/s; products of larger control points would overflow


def _spline(control: Array, degree: int) -> "BSpline":
    """Return the spline with C control points, shape (C, ...), and clamped uniform knots."""
    from scipy.interpolate import BSpline

    # Clamped: the end knots are repeated, so that the spline starts and ends at the
    # first and last control point.
    spans = len(control) - degree
    return BSpline(
        np.concatenate(
            [np.zeros(degree), np.arange(spans + 1) / spans, np.ones(degree)]
        ),
        control,
        degree,
    )


@cache
def _basis_splines(points: int, degree: int) -> "BSpline":
    """Return all basis functions as one spline."""
    return _spline(np.eye(points), degree)


def derivative_matrix(points: int, degree: int, order: int) -> tuple[Array, Array]:
    """Return the knots of a derivative, and the matrix from the control points to its own, shape (C - order, C)."""
    spline = _basis_splines(points, degree).derivative(order)
    return spline.t, spline.c[: points - order]


def basis_matrix(s: Array, points: int, degree: int, order: int = 0) -> Array:
    """Evaluate a derivative of every basis function at phases s, shape (K,).

    Return shape (K, C).
    """
    return np.asarray(_basis_splines(points, degree)(s, order))


@cache
def _span_polynomials(points: int, degree: int) -> Array:
    """Return the Taylor coefficients of every basis function at the left knots, shape (D + 1, C, spans)."""
    left = np.arange(points - degree) / (points - degree)
    return np.stack(
        [
            basis_matrix(left, points, degree, order).T / factorial(order)
            for order in range(degree + 1)
        ]
    )


def spline_derivatives(
    control: Array, degree: int, s: Array, *, orders: int
) -> list[Array]:
    """Evaluate one spline and its first derivatives, ``orders`` results in all, at K phases by Horner's rule.

    Control points have shape (C, n), phases (K,), the results (n, K). The degree is at
    least 3.
    """
    spans = len(control) - degree
    # The last span is closed: s = 1 belongs to it.
    span = np.clip(s * spans, 0, spans - 1).astype(np.intp)
    offset = s - span / spans
    coefficients = (control.T @ _span_polynomials(len(control), degree)).take(
        span, axis=2
    )
    # Horner's rule for a polynomial and its derivatives: values[k] is the k-th
    # derivative over k!.
    values = [
        coefficients[-1],
        *(np.zeros_like(coefficients[-1]) for _ in range(orders - 1)),
    ]
    for coefficient in coefficients[-2::-1]:
        for order in range(orders - 1, 0, -1):
            values[order] = values[order] * offset + values[order - 1]
        values[0] = values[0] * offset + coefficient
    return [factorial(order) * value for order, value in enumerate(values)]


def states_by_chain_rule(p: Sequence[Array], r: Sequence[Array]) -> list[Array]:
    """Return positions, velocities, accelerations and, if p''' is given, jerks.

    The path has one derivative by phase more, shape (n, K) each, than the rate, shape
    (K,) or (1, K) each.
    """
    states = [p[0], p[1] * r[0], (p[2] * r[0] + p[1] * r[1]) * r[0]]
    if len(p) > 3:
        states.append(
            ((p[3] * r[0] + 3 * p[2] * r[1]) * r[0] + p[1] * (r[2] * r[0] + r[1] ** 2))
            * r[0]
        )
    return states


def is_positive(control: Array, degree: int) -> bool:
    """Return whether a spline with finite control points, shape (C,), is positive on all of [0, 1]."""
    if control.min() > 0:
        # The spline lies between its smallest and its largest control point.
        return True
    from scipy.interpolate import PPoly

    # Scaling by a power of two changes no sign and no root, and avoids an overflow.
    spline = _spline(
        control * (2.0**-600 if np.abs(control).max() > MAX_UNSCALED_RATE else 1.0),
        degree,
    )
    # The minimum is at an end or where the derivative vanishes.
    critical = PPoly.from_spline(spline.derivative()).roots(extrapolate=False)
    s = np.concatenate([[0.0, 1.0], np.clip(critical[np.isfinite(critical)], 0, 1)])
    return bool(spline(s).min() > 0)
