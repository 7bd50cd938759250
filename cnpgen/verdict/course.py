"""One motion at many phases: joint positions and their derivatives in time, joint by joint."""

from dataclasses import dataclass

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
        jerk: Joint jerks [rad/s^3].
    """

    q: Array
    dq: Array
    ddq: Array
    jerk: Array


def course(motion: Motion, s: Array) -> Course:
    """Evaluate one motion at phases s, by the chain rule that ``cnpgen.trajectory.motion.Motion.at`` states.

    Many phases of one motion take a tenth of the time that ``Motion.at`` needs for them.

    Args:
        motion: One motion.
        s: Phases in [0, 1], shape (K,).
    """
    p, p1, p2, p3 = _derivatives(motion.path[0], motion.degree, s)
    r, r1, r2, _ = _derivatives(motion.rate[0, :, None], motion.degree, s)
    return Course(
        q=p,
        dq=p1 * r,
        ddq=(p2 * r + p1 * r1) * r,
        jerk=((p3 * r + 3 * p2 * r1) * r + p1 * (r2 * r + r1**2)) * r,
    )


def _derivatives(control: Array, degree: int, s: Array) -> tuple[Array, Array, Array, Array]:
    """Evaluate a spline and its first three derivatives by Horner's rule.

    Args:
        control: Control points, shape (C, n).
        degree: Its degree D, at least 3.
        s: Phases in [0, 1], shape (K,).

    Returns:
        Four arrays of shape (n, K).
    """
    spans = len(control) - degree
    span = np.clip(s * spans, 0, spans - 1).astype(np.intp)
    offset = s - span / spans
    powers = np.tensordot(taylor(len(control), degree), control, axes=1)  # (D + 1, spans, n)
    coefficients = np.ascontiguousarray(powers.transpose(0, 2, 1)).take(span, axis=2)
    value = coefficients[-1]
    first, second, third = (np.zeros_like(value) for _ in range(3))
    for coefficient in coefficients[-2::-1]:
        third = third * offset + second
        second = second * offset + first
        first = first * offset + value
        value = value * offset + coefficient
    return value, first, 2 * second, 6 * third
