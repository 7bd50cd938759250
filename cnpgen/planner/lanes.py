"""Rows of numbers as kernels take them: one column per row."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]


def lanes(values: NDArray[Any]) -> Array:
    """Turn (N, ...) into (width, N), float64."""
    return np.ascontiguousarray(values.reshape(len(values), math.prod(values.shape[1:])).T, np.float64)


def rows(values: Array, n: int) -> Array:
    """Turn (points n, N) into (N, points, n)."""
    return np.ascontiguousarray(values.T).reshape(values.shape[1], values.shape[0] // n, n)


def ends_of(boundary: Boundary) -> Array:
    """Boundary conditions of N motions as ``curves`` takes them, shape (5 n, N)."""
    parts = (boundary.start_q, boundary.start_dq, boundary.start_ddq, boundary.goal_q, boundary.goal_dq)
    return np.ascontiguousarray(np.concatenate(parts, axis=1).T)
