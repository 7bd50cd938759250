"""The state of each of N motions at one moment of its own: what replanning asks for, thousands of times a second."""

from functools import cache
from math import perm

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import taylor

Array = NDArray[np.float64]

ORDERS = 3  # values, first and second derivatives


def states_at_times(motion: Motion, t: Array) -> tuple[Array, Array, Array]:
    """Evaluate each motion at one time; what ``Motion.at`` says of one phase, without its work for many.

    Args:
        motion: N motions.
        t: One time for each [s], shape (N,); clipped to the motion.

    Returns:
        Positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (N, n) each.
    """
    s = motion.phase_at(t[:, None])[:, 0]
    q, p1, p2 = _derivatives(motion.path, motion.degree, s)
    r, r1, _ = _derivatives(motion.rate[..., None], motion.degree, s)
    return q, p1 * r, (p2 * r + p1 * r1) * r


def _derivatives(control: Array, degree: int, s: Array) -> Array:
    """Return value, first and second derivative of N splines, each at its own phase, shape (3, N, n).

    Args:
        control: Control points, shape (N, C, n).
        degree: Degree D.
        s: Phases in [0, 1], shape (N,).
    """
    spans = control.shape[1] - degree
    span = np.minimum((s * spans).astype(np.intp), spans - 1)
    factor, exponent = _powers(degree)
    powers = factor * (s - span / spans)[:, None, None] ** exponent  # (N, 3, D + 1)
    table = taylor(control.shape[1], degree)[:, span].swapaxes(0, 1)  # (N, D + 1, C)
    return np.asarray((powers @ table @ control).swapaxes(0, 1))


@cache
def _powers(degree: int) -> tuple[Array, Array]:
    """Return factors and exponents of x in the derivatives of x^k, shape (3, D + 1) each."""
    orders, powers = range(ORDERS), range(degree + 1)
    factor = np.array([[perm(k, order) for k in powers] for order in orders], float)
    return factor, np.array([[max(k - order, 0) for k in powers] for order in orders])
