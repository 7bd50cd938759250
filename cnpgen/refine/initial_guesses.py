"""Initial guesses without a plan: lines, a quintic polynomial, and fits to joint-space paths."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.solid import place_obstacles
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from cnpgen.trajectory.spline import basis
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from cnpgen.world.world import World

Array = NDArray[np.float64]
# First value of a rising rate; fraction of its rising control points.
RISING_FRACTION, RISING_PHASE = 0.3, 0.3
MIN_GUESS_DURATION_S = 0.3  # of motions between close configurations
# Of the duration at the velocity limits, for motions along joint-space paths.
PATH_DURATION_FACTOR = 2.0
# States along a tip path; Gauss-Newton steps for each.
TIP_PATH_STATES, TIP_PATH_STEPS = 24, 4
# Singular values below this fraction of the largest are ignored.
TIP_PATH_CONDITION = 1e-3
SAMPLES_PER_CONTROL_POINT = 20  # of the fit to a joint-space path


def straight_line(
    boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec
) -> tuple[Array, Array]:
    """Return the line between the boundary control points at a constant rate.

    The result is ``(path, rate)``: interior path control points [rad], shape (m, n),
    and rate control points [1/s], shape (R,). Velocity limits [rad/s] have shape (n,).
    """
    rate = _constant_rate(boundary, velocity_limit, spec)
    return anchor_line(boundary, rate[None], spec)[0], rate


def rising_line(
    boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec
) -> tuple[Array, Array]:
    """Return ``straight_line``, with a rising rate if the motion starts at rest and arrives moving.

    Hits from this guess have three fifths of the jerk at the same duration. The
    objective hardly depends on the rise of accelerations, so that the guess decides it.
    """
    interior, rate = straight_line(boundary, velocity_limit, spec)
    at_rest = not (np.any(boundary.start_dq) or np.any(boundary.start_ddq))
    if at_rest and np.any(boundary.goal_dq):
        rising = (
            RISING_FRACTION
            + (1 - RISING_FRACTION) * np.linspace(0, 1, len(rate)) / RISING_PHASE
        )
        rate = rate * np.minimum(rising, 1.0)
    return interior, rate


def line_through(
    boundary: Boundary,
    velocity_limit: Array,
    spec: TrajectorySpec,
    *,
    configuration: Array,
) -> tuple[Array, Array]:
    """Return ``straight_line``, curved halfway towards a configuration [rad], shape (n,)."""
    interior, rate = straight_line(boundary, velocity_limit, spec)
    if not len(interior):  # the boundary conditions fix all control points
        return interior, rate
    along = np.linspace(0, 1, len(interior))[:, None]
    parabola = 4 * along * (1 - along)
    center = (interior[0] + interior[-1]) / 2
    return interior + 0.5 * parabola * (configuration - center), rate


def quintic(
    boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec
) -> tuple[Array, Array]:
    """Return ``straight_line`` with a path fitted to the quintic polynomial of the boundary conditions."""
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
    control = np.linalg.lstsq(
        basis(s, spec.path_control_points, spec.degree), q, rcond=None
    )[0]
    return control[3 : spec.path_control_points - boundary.fixed_at_goal], rate


def fit_to_path(
    states: Array, boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec
) -> tuple[Array, Array]:
    """Fit a motion to states (K, n) of a joint-space path by least squares.

    See ``straight_line``.
    """
    min_duration = float(
        (np.abs(np.diff(states, axis=0)) / velocity_limit).max(axis=1).sum()
    )
    rate = np.full(
        spec.rate_control_points, 1.0 / (PATH_DURATION_FACTOR * min_duration + 0.1)
    )
    s = np.linspace(0, 1, SAMPLES_PER_CONTROL_POINT * spec.path_control_points)
    # Starts and ends without velocity.
    lengths, eased = _arc_lengths(states), s**3 * (10 - 15 * s + 6 * s**2)
    q = np.stack(
        [np.interp(eased * lengths[-1], lengths, joint) for joint in states.T], axis=1
    )
    count, n = spec.path_control_points - 3 - boundary.fixed_at_goal, states.shape[1]
    fixed = assemble(boundary, np.zeros((1, count, n)), rate[None], spec)[0]
    table = basis(s, spec.path_control_points, spec.degree)
    inner = slice(3, 3 + count)
    return np.linalg.lstsq(table[:, inner], q - table @ fixed, rcond=None)[0], rate


def along_tip_path(
    world: World, start_q: Array, goal_q: Array, tip_path: Array
) -> Array:
    """Return joint positions along a tip path [m], a polyline of shape (K, 3): [rad], shape (TIP_PATH_STATES, n).

    They result from Gauss-Newton steps of minimum norm from the joint-space line; the
    world is moved.
    """
    lengths, rest = _arc_lengths(tip_path), np.zeros(len(start_q))
    along = np.linspace(0, 1, TIP_PATH_STATES)
    tips = np.stack(
        [np.interp(along * lengths[-1], lengths, values) for values in tip_path.T],
        axis=1,
    )
    states = start_q + along[:, None] * (goal_q - start_q)
    obstacle_poses = place_obstacles(world.obstacles)
    for k in range(1, TIP_PATH_STATES - 1):
        for _ in range(TIP_PATH_STEPS):
            world.set_state(states[k], rest, rest, obstacle_poses)
            error = tips[k] - world.tip_position
            states[k] += np.linalg.lstsq(
                world.tip_jacobian, error, rcond=TIP_PATH_CONDITION
            )[0]
    return states


def _arc_lengths(states: Array) -> Array:
    """Return the arc length of a path at each of its states, shape (K,)."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1)))


def _constant_rate(
    boundary: Boundary, velocity_limit: Array, spec: TrajectorySpec
) -> Array:
    fastest = float(np.max(np.abs(boundary.goal_q - boundary.start_q) / velocity_limit))
    return np.full(spec.rate_control_points, 1.0 / max(fastest, MIN_GUESS_DURATION_S))
