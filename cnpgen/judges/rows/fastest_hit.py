"""The highest speed of a hit, recomputed: a linear programme by its dual.

Maximise ``a . v`` subject to ``B v = 0`` and ``|v_i| <= L_i``, where ``a`` is the tip's velocity along the hit per
joint velocity and the two rows of B are those across it. The dual, ``min over y of sum_i L_i |a_i - (B^T y)_i|``, is
convex and piecewise linear: its minimum is at a vertex, where two of the terms vanish.
"""

from itertools import combinations

import numpy as np

from cnpgen.judges.rows.report import Array

PARALLEL = 1e-9  # relative size of a determinant below which two terms have no vertex that could be computed


def highest_speed(jacobian: Array, angle: Array, limit: Array) -> Array:
    """Compute how fast the tip can move along hits in the x-y plane, whatever the joints do within their limits [m/s].

    Args:
        jacobian: Translational Jacobians of the tip in world axes [m], shape (rows, 3, n).
        angle: Directions of the hits [rad], shape (rows,).
        limit: Velocity limits of the joints [rad/s], shape (n,).

    Returns:
        Shape (rows,); inf where B has not two independent columns.
    """
    x, y, z = jacobian.transpose(1, 0, 2)
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    a, b = cosine * x + sine * y, cosine * y - sine * x
    i, j = np.array(list(combinations(range(len(limit)), 2))).T
    first, second = b[:, i] * z[:, j], z[:, i] * b[:, j]
    vertex = np.abs(first - second) > PARALLEL * (np.abs(first) + np.abs(second))
    scale = 1 / np.where(vertex, first - second, 1.0)
    u, w = (a[:, i] * z[:, j] - z[:, i] * a[:, j]) * scale, (b[:, i] * a[:, j] - a[:, i] * b[:, j]) * scale
    rest = np.abs(a[:, :, None] - b[:, :, None] * u[:, None] - z[:, :, None] * w[:, None])
    return np.asarray(np.where(vertex, limit @ rest, np.inf).min(axis=1, initial=np.inf))
