"""Where the optimiser starts from when there is no plan: straight, gentle, bent through a configuration, or smooth."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.boundary import Boundary, anchor_line
from cnpgen.trajectory.spec import TrajectorySpec
from cnpgen.trajectory.spline import basis

Array = NDArray[np.float64]
LOW, RISE = 0.3, 0.3  # share of the rate with which gentle motions begin, and share of the rates by which it is whole
SHORTEST = 0.3  # s: first guess of the duration of motions between neighbouring configurations


def straight(boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec) -> tuple[Array, Array]:
    """The line between the boundary control points at a constant rate.

    Args:
        boundary: Boundary conditions of one motion.
        velocity_limit: Of every joint [rad/s], shape (n,).
        spec: Degree and numbers of control points.

    Returns:
        ``(path, rate)``: interior path control points [rad], shape (m, n), and rate control points [1/s], shape (R,).
    """
    rate = _constant_rate(boundary, velocity_limit, spec)
    return anchor_line(boundary, rate[None], spec)[0], rate


def gentle(boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec) -> tuple[Array, Array]:
    """The same as ``straight``, but at first at a low rate where a motion sets off from rest and arrives moving.

    Of hits that take equally long those that are found from there have three fifths of the jerk: the objective hardly
    says how fast accelerations rise, so that it stays as it began.
    """
    interior, rate = straight(boundary, velocity_limit, spec)
    at_rest = not (np.any(boundary.start_dq) or np.any(boundary.start_ddq))
    if at_rest and np.any(boundary.goal_dq):
        rate = rate * np.minimum(LOW + (1 - LOW) * np.linspace(0, 1, len(rate)) / RISE, 1.0)
    return interior, rate


def through(boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec, *, middle: Array) -> tuple[Array, Array]:
    """The same as ``straight``, bent half way towards a configuration ``middle`` [rad], shape (n,)."""
    interior, rate = straight(boundary, velocity_limit, spec)
    if not len(interior):  # the ends alone decide where a motion of so few control points goes
        return interior, rate
    along = np.linspace(0, 1, len(interior))[:, None]
    bend = 4 * along * (1 - along)
    chord = (interior[0] + interior[-1]) / 2
    return interior + 0.5 * bend * (middle - chord), rate


def smooth(boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec) -> tuple[Array, Array]:
    """The same as ``straight``, but with a path fitted to the quintic polynomial of the boundary conditions."""
    rate = _constant_rate(boundary, velocity_limit, spec)
    duration = 1.0 / rate[0]
    s = np.linspace(0, 1, 4 * spec.path_control_points)
    q0, q1 = boundary.start_q[0], boundary.goal_q[0]
    v0, v1 = boundary.start_dq[0] * duration, boundary.goal_dq[0] * duration
    a0 = boundary.start_ddq[0] * duration**2
    constraint = np.array([[1, 1, 1], [3, 4, 5], [6, 12, 20]], float)
    right = np.stack([q1 - q0 - v0 - a0 / 2, v1 - v0 - a0, -a0])
    cubic = np.linalg.solve(constraint, right)
    powers = s[:, None] ** np.arange(6)
    q = powers @ np.concatenate([[q0, v0, a0 / 2], cubic])
    control = np.linalg.lstsq(basis(s, spec.path_control_points, spec.degree), q, rcond=None)[0]
    return control[3 : spec.path_control_points - boundary.fixed_at_goal], rate


def _constant_rate(boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec) -> Array:
    duration = max(float(np.max(np.abs(boundary.goal_q - boundary.start_q) / velocity_limit)), SHORTEST)
    return np.full(spec.rate_control_points, 1.0 / duration)
