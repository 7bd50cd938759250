"""One motion at many phases: joint positions and their derivatives in time, joint by joint."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import factorial

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import basis, taylor

Array = NDArray[np.float64]
ORDERS = 3  # of the path, positions among them, that accelerations are made of; jerks take one more


@dataclass(frozen=True, eq=False)
class Phases:
    """Phases at which many motions are evaluated.

    Attributes:
        s: Ascending, in [0, 1], shape (K,).
    """

    s: Array


@dataclass(frozen=True)
class Course:
    """K states of one motion; every array has shape (n, K).

    Attributes:
        q: Joint positions [rad].
        dq: Joint velocities [rad/s].
        ddq: Joint accelerations [rad/s^2].
        jerk: Joint jerks [rad/s^3]; None where they are not wanted.
    """

    q: Array
    dq: Array
    ddq: Array
    jerk: Array | None = None

    def is_finite(self) -> bool:
        """Whether all of it are numbers."""
        return all(values is None or bool(np.isfinite(values).all()) for values in vars(self).values())


def course(motion: Motion, s: Array, *, jerk: bool = False) -> Course:
    """Evaluate one motion at phases s, by the chain rule that ``cnpgen.trajectory.motion.Motion.at`` states.

    Many phases of one motion take a tenth of the time that ``Motion.at`` needs for them.

    Args:
        motion: One motion.
        s: Phases in [0, 1], shape (K,).
        jerk: Whether jerks are wanted.
    """
    orders = ORDERS + jerk
    p = _derivatives(motion.path[0], motion.degree, s, orders=orders)
    return _in_time(p, _derivatives(motion.rate[0, :, None], motion.degree, s, orders=orders - 1))


def course_at(motion: Motion, phases: Phases, *, jerk: bool = False) -> Course:
    """Evaluate one motion as ``course`` does, but for rounding; the bases of splines at these phases are kept."""
    orders = ORDERS + jerk
    points, rates = motion.path.shape[1], motion.rate.shape[1]
    p = motion.path[0].T @ _bases(points, motion.degree, orders, phases)
    r = motion.rate[0] @ _bases(rates, motion.degree, orders - 1, phases)
    count = len(phases.s)
    return _in_time(
        [p[:, k * count : (k + 1) * count] for k in range(orders)],
        [r[k * count : (k + 1) * count] for k in range(orders - 1)],
    )


@lru_cache(maxsize=8)
def _bases(points: int, degree: int, orders: int, phases: Phases) -> Array:
    """Bases of a spline and of its derivatives, one after the other, shape (C, orders K)."""
    found = [basis(phases.s, points, degree, order) for order in range(orders)]
    return np.ascontiguousarray(np.concatenate(found).T)


def jerks(motion: Motion, s: Array) -> Array:
    """Evaluate the joint jerks of one motion at phases s [rad/s^3], shape (n, K)."""
    p = _derivatives(motion.path[0], motion.degree, s, orders=4)
    return _jerks(p, _derivatives(motion.rate[0, :, None], motion.degree, s, orders=3))


def _in_time(p: Sequence[Array], r: Sequence[Array]) -> Course:
    """Turn derivatives of path and rate by phase into those of positions by time."""
    ddq = (p[2] * r[0] + p[1] * r[1]) * r[0]
    return Course(q=p[0], dq=p[1] * r[0], ddq=ddq, jerk=_jerks(p, r) if len(p) > ORDERS else None)


def _jerks(p: Sequence[Array], r: Sequence[Array]) -> Array:
    return np.asarray(((p[3] * r[0] + 3 * p[2] * r[1]) * r[0] + p[1] * (r[2] * r[0] + r[1] ** 2)) * r[0])


def _derivatives(control: Array, degree: int, s: Array, *, orders: int) -> list[Array]:
    """Evaluate a spline and its first derivatives by Horner's rule.

    Args:
        control: Control points, shape (C, n).
        degree: Its degree D, at least 3.
        s: Phases in [0, 1], shape (K,).
        orders: How many: 1 is the spline alone.

    Returns:
        Arrays of shape (n, K).
    """
    spans = len(control) - degree
    span = np.clip(s * spans, 0, spans - 1).astype(np.intp)
    offset = s - span / spans
    powers = control.T @ taylor(len(control), degree).transpose(0, 2, 1)  # (D + 1, n, spans)
    coefficients = powers.take(span, axis=2)
    found = [coefficients[-1], *(np.zeros_like(coefficients[-1]) for _ in range(orders - 1))]
    for coefficient in coefficients[-2::-1]:
        for order in range(orders - 1, 0, -1):
            found[order] = found[order] * offset + found[order - 1]
        found[0] = found[0] * offset + coefficient
    return [factorial(order) * each for order, each in enumerate(found)]
