"""One motion at many phases: joint positions and their derivatives in time, joint by joint."""

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import taylor

Array = NDArray[np.float64]


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
    p, p1, p2 = _derivatives(motion.path[0], motion.degree, s, orders=3)
    r, r1 = _derivatives(motion.rate[0, :, None], motion.degree, s, orders=2)
    return Course(q=p, dq=p1 * r, ddq=(p2 * r + p1 * r1) * r, jerk=jerks(motion, s) if jerk else None)


def jerks(motion: Motion, s: Array) -> Array:
    """Evaluate the joint jerks of one motion at phases s [rad/s^3], shape (n, K)."""
    _, p1, p2, p3 = _derivatives(motion.path[0], motion.degree, s, orders=4)
    r, r1, r2 = _derivatives(motion.rate[0, :, None], motion.degree, s, orders=3)
    return np.asarray(((p3 * r + 3 * p2 * r1) * r + p1 * (r2 * r + r1**2)) * r)


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
