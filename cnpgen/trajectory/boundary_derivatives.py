"""Derivatives of the boundary control points with respect to those of the rate, for vector-Jacobian products."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline import end_derivatives
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

Array = NDArray[Any]


@dataclass(frozen=True)
class BoundaryDerivative:
    """Derivative [rad s], shape (N, n), of a path control point with respect to a rate control point."""

    point: int
    variable: int
    derivative: Array


def boundary_derivatives(boundary: Boundary, rate: Array, spec: TrajectorySpec) -> list[BoundaryDerivative]:
    """Differentiate ``start_points`` and ``goal_points`` of ``cnpgen.trajectory.boundary``; other derivatives are zero.

    Rate control points [1/s], shape (N, R), are positive.
    """
    b, last, points = boundary, spec.rate_control_points - 1, spec.path_control_points
    c1, c2, c2_inner = _end_derivatives(b.start_dq, b.start_ddq, rate[:, :1], rate[:, 1:2], spec)
    derivatives = [BoundaryDerivative(1, 0, c1), BoundaryDerivative(2, 0, c2), BoundaryDerivative(2, 1, c2_inner)]
    if b.goal_ddq is None:
        return [*derivatives, BoundaryDerivative(points - 2, last, _first_derivative(-b.goal_dq, rate[:, -1:], spec))]
    c1, c2, c2_inner = _end_derivatives(-b.goal_dq, b.goal_ddq, rate[:, -1:], rate[:, -2:-1], spec)
    derivatives += [BoundaryDerivative(points - 2, last, c1), BoundaryDerivative(points - 3, last, c2)]
    return [*derivatives, BoundaryDerivative(points - 3, last - 1, c2_inner)]


def _first_derivative(dq: Array, outer: Array, spec: TrajectorySpec) -> Array:
    """Return dc1/dr0 at the end where the path has velocity dq, with ``c1 = q + p' / eta`` and ``p' = dq / r0``."""
    return np.asarray(-dq / (outer**2 * end_derivatives(spec.path_control_points, spec.degree).eta))


def _end_derivatives(
    dq: Array, ddq: Array, outer: Array, inner: Array, spec: TrajectorySpec
) -> tuple[Array, Array, Array]:
    """Return dc1/dr0, dc2/dr0 and dc2/dr1 at the end where the path has velocity dq and acceleration ddq.

    With ``p' = dq / r0`` and ``p'' = ddq / r0^2 - dq eta_r (r1 - r0) / r0^2``: ``c1 = q + p' / eta`` and
    ``c2 = p'' / beta - 2 q + 3 c1`` (paper, Appendix A).
    """
    path = end_derivatives(spec.path_control_points, spec.degree)
    eta = end_derivatives(spec.rate_control_points, spec.degree).eta
    c1 = _first_derivative(dq, outer, spec)
    second = (-2 * (ddq - dq * eta * (inner - outer)) / outer + dq * eta) / outer**2
    return c1, second / path.beta + 3 * c1, -dq * eta / (outer**2 * path.beta)
