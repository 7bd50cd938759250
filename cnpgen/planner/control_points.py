"""The paper's Omega block: control points from network outputs, and the vector-Jacobian product back.

``C_{3+i} = line_i + correction_i + scale phi_i`` with the line from C_2 to C_{C-N_d}, and ``rate = e^o / T_expected``.
The boundary control points follow from the rates, so that boundary conditions hold by construction. The line depends
on two of them, so gradients of the path reach the rates both directly and through the line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.planner.tasks import Tasks
from cnpgen.trajectory.boundary import Boundary, boundary_derivatives, goal_points, start_points
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

Array = NDArray[Any]


@dataclass(frozen=True)
class ControlPoints:
    """Control points of N motions.

    Attributes:
        path: Control points of p [rad], shape (N, C, n).
        rate: Control points of r [1/s], shape (N, R).
    """

    path: Array
    rate: Array

    def __repr__(self) -> str:
        return f"<ControlPoints: path {np.shape(self.path)}, rate {np.shape(self.rate)}>"


def control_points(tasks: Tasks, phi: Array, log_rate: Array, *, scale: float, spec: TrajectorySpec) -> ControlPoints:
    """Compute control points in the dtype of the arguments.

    Args:
        tasks: N tasks.
        phi: Output of the configuration head, in (-1, 1), shape (N, m n).
        log_rate: Output of the time head, shape (N, R).
        scale: Factor of phi [rad] (the paper's pi).
        spec: Degree and numbers of control points.
    """
    boundary = tasks.boundary
    rate = np.exp(log_rate)
    rate /= tasks.expected_time[:, None]
    first, last = start_points(boundary, rate, spec), goal_points(boundary, rate, spec)
    n = boundary.start_q.shape[1]
    interior = (scale * phi).reshape(len(phi), phi.shape[1] // n, n)
    begin = first[:, 2:3]
    interior += begin + (last[:, :1] - begin) * along_line(interior.shape[1], interior.dtype.name)
    if tasks.correction is not None:
        interior += tasks.correction
    return ControlPoints(np.concatenate([first, interior, last], axis=1), rate)


def vjp(
    tasks: Tasks,
    points: ControlPoints,
    *,
    path_gradient: Array,
    rate_gradient: Array,
    scale: float,
    spec: TrajectorySpec,
) -> tuple[Array, Array]:
    """Convert gradients with respect to the control points to gradients with respect to the network's outputs.

    Args:
        tasks: N tasks.
        points: Result of ``control_points``.
        path_gradient: Gradient with respect to ``points.path``, shape (N, C, n).
        rate_gradient: Gradient with respect to ``points.rate``, shape (N, R).
        scale: Factor of phi [rad], as in ``control_points``.
        spec: Degree and numbers of control points.

    Returns:
        Gradients with respect to phi, shape (N, m n), and to the logarithms of the rates, shape (N, R).
    """
    interior = path_gradient[:, 3 : spec.path_control_points - tasks.boundary.fixed_at_goal]
    along = along_line(interior.shape[1], interior.dtype.name)[:, 0]
    total = path_gradient.copy()
    total[:, 2] += (1 - along) @ interior
    total[:, spec.path_control_points - tasks.boundary.fixed_at_goal] += along @ interior
    rates = rate_gradient.copy()
    for partial in boundary_derivatives(tasks.boundary, points.rate, spec):
        rates[:, partial.variable] += np.einsum("ij,ij->i", total[:, partial.point], partial.derivative)
    rates *= points.rate
    return scale * interior.reshape(len(interior), math.prod(interior.shape[1:])), rates


def lines_at_rest(boundary: Boundary, correction: Array) -> Array:
    """Return control points of lines between states at rest, shape (N, C, n), plus corrections [rad], (N, m, n)."""
    start, goal = boundary.start_q[:, None], boundary.goal_q[:, None]
    interior = start + (goal - start) * along_line(correction.shape[1]) + correction
    last = np.repeat(goal, boundary.fixed_at_goal, axis=1)
    return np.concatenate([np.repeat(start, 3, axis=1), interior, last], axis=1)


@lru_cache(maxsize=16)
def along_line(count: int, dtype: str = "float64") -> Array:
    """Return the interior control points' fractions of the line from C_2 to C_{C-N_d}, shape (m, 1)."""
    return np.linspace(0, 1, count, dtype=dtype)[:, None]
