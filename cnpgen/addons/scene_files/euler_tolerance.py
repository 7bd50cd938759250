"""Tolerances of XYZ Euler angles as tolerances of a rotation vector."""

from __future__ import annotations

import numpy as np

from cnpgen.arrays import Array

MAX_ANGLE = 0.5  # rad up to which the second-order bound below holds
SECOND_ORDER = (
    0.75  # above the factor 1/2 of the second-order term, for the higher ones
)


def rotation_vector_tolerance(angles: Array) -> Array:
    """Return tolerances of a rotation vector [rad] that keep XYZ Euler angles within theirs, shape (3,).

    For R = Rx(a) Ry(b) Rz(c) = exp([w]), the angles differ from w by products of two of
    its components to second order: |a - wx| <= |wy wz| / 2, and so on. An angle of pi
    is free. If c is free, a and b are the tilt of the z axis, which is at most |(wx,
    wy)|; if a is free, b and c are that of the x axis.

    Raises:
        ValueError: The second angle, or two of them, are free.
    """
    free = angles >= np.pi
    if free.all():
        return angles.copy()
    if free[1] or free.sum() > 1:
        raise ValueError(
            "XYZ Euler angles that are free about y, or about two axes, are not"
            " supported: use parameterization 1 (ROTATION_VECTOR)"
        )
    # Smaller tolerances keep the larger ones, too, and the bound holds up to MAX_ANGLE.
    inner = np.minimum(angles, MAX_ANGLE)
    if free.any():
        # The tilt mixes both components: a square in the circle of the smaller one.
        square = inner[~free].min() / np.sqrt(2)
        return np.where(free, np.pi, square)
    # |a - wx| is below 3/4 |wy wz| with higher terms, so each tolerance loses this
    # much.
    reduced = inner - SECOND_ORDER * np.array(
        [inner[1] * inner[2], inner[0] * inner[2], inner[0] * inner[1]]
    )
    # where one tolerance is small against the others, a cube of the smallest
    cube = inner.min() * (1 - SECOND_ORDER * inner.min())
    return reduced if reduced.min() >= 0.5 * inner.min() else np.full(3, cube)
