"""Initial guesses without a plan: lines, a quintic polynomial, and fits to joint-space paths."""

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.solid import place_obstacles
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from cnpgen.trajectory.spline import basis
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from cnpgen.world.world import World

# First value of a rising rate; fraction of its rising control points.
RISING_FRACTION = 0.3
RISING_PHASE = 0.3
MIN_GUESS_DURATION_S = 0.3  # of motions between close configurations
# Of the duration at the velocity limits, for motions along joint-space paths.
PATH_DURATION_FACTOR = 2.0
# States along a tip path; Gauss-Newton steps for each.
TIP_PATH_STATES = 24
TIP_PATH_STEPS = 4
# Singular values below this fraction of the largest are ignored.
TIP_PATH_CONDITION = 1e-3
SAMPLES_PER_CONTROL_POINT = 20  # of the fit to a joint-space path
RAMP_PHASE = 0.2  # in which a motion along a path accelerates, and brakes
# Of the length of a path around a corner that gets more phase.
CORNER_WIDTH = 0.06
PLACING_PHASES = 300  # of the integrals below


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
    if not len(interior):
        # The boundary conditions fix all control points.
        return interior, rate
    along = np.linspace(0, 1, len(interior))[:, None]
    # 0 at both ends and 1 in the middle.
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
    q0 = boundary.start_q[0]
    q1 = boundary.goal_q[0]
    # Derivatives by the phase s = t / T: dq T and ddq T^2.
    v0 = boundary.start_dq[0] * duration
    v1 = boundary.goal_dq[0] * duration
    a0 = boundary.start_ddq[0] * duration**2
    # Rows: value, first and second derivative of c3 s^3 + c4 s^4 + c5 s^5 at s = 1.
    constraint = np.array([[1, 1, 1], [3, 4, 5], [6, 12, 20]], float)
    # The goal acceleration is zero.
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
    """Fit a motion to states (K, n) of a joint-space path by least squares: (interior control points, rate).

    See ``straight_line``. A fit that is near the path is near the free space in which
    trees found it.
    """
    min_duration = float(
        (np.abs(np.diff(states, axis=0)) / velocity_limit).max(axis=1).sum()
    )
    rate = np.full(
        spec.rate_control_points, 1.0 / (PATH_DURATION_FACTOR * min_duration + 0.1)
    )
    s = np.linspace(0, 1, SAMPLES_PER_CONTROL_POINT * spec.path_control_points)
    q = _states_along(states, s)
    count = spec.path_control_points - 3 - boundary.fixed_at_goal
    n = states.shape[1]
    # The control points of the ends are known: the least squares fit has only the
    # interior ones.
    fixed = assemble(boundary, np.zeros((1, count, n)), rate[None], spec)[0]
    table = basis(s, spec.path_control_points, spec.degree)
    inner = slice(3, 3 + count)
    return np.linalg.lstsq(table[:, inner], q - table @ fixed, rcond=None)[0], rate


def _states_along(states: Array, s: Array) -> Array:
    """Return the states of a path (K, n) at phases s, shape (S, n), from rest to rest and slower around corners.

    Let l in [0, 1] be the fraction of the path's length, t_k the unit direction of its
    edge k, and l_k the corner between the edges k and k + 1. Then l(s) solves

        int_0^l w(l') dl' / int_0^1 w  =  int_0^s v(s') ds' / int_0^1 v,
        w(l) = 1 + sum_k |t_{k+1} - t_k| exp(-((l - l_k) / CORNER_WIDTH)^2),
        v(s) = 3 r^2 - 2 r^3  with  r = min(s, 1 - s, RAMP_PHASE) / RAMP_PHASE.

    Splines have few control points. The weight w puts more of them around corners, and
    with short ramps v the middle of the path has as many of them as its ends.
    """
    lengths = _arc_lengths(states)
    grid = np.linspace(0, 1, PLACING_PHASES)
    length = max(float(lengths[-1]), np.finfo(float).tiny)
    edges = np.diff(states, axis=0)
    directions = edges / np.maximum(np.diff(lengths), np.finfo(float).tiny)[:, None]
    # Change of the unit direction at each corner, from 0 for none to 2 for a reversal.
    turns = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    distances = (grid[:, None] - lengths[1:-1] / length) / CORNER_WIDTH
    # More phase, hence a lower speed, around corners.
    weight = 1 + np.exp(-(distances**2)) @ turns
    ramp = np.minimum(np.minimum(grid, 1 - grid) / RAMP_PHASE, 1)
    # Smoothstep: its slope is zero at both ends of the ramp.
    speed = ramp**2 * (3 - 2 * ramp)
    weights = _integral(weight)
    distance = _integral(speed)
    along = np.interp(np.interp(s, grid, distance), weights, grid)
    return np.stack(
        [np.interp(along * length, lengths, joint) for joint in states.T], axis=1
    )


def _integral(values: Array) -> Array:
    """Return the integral of values on an even grid by trapezoids, scaled to end at 1."""
    sums: Array = np.append(0.0, np.cumsum((values[1:] + values[:-1]) / 2))
    return sums / float(sums[-1])


def along_tip_path(
    world: World, start_q: Array, goal_q: Array, tip_path: Array
) -> Array:
    """Return joint positions along a tip path [m], a polyline of shape (K, 3): [rad], shape (TIP_PATH_STATES, n).

    They result from Gauss-Newton steps of minimum norm from the joint-space line; the
    world is moved.
    """
    lengths = _arc_lengths(tip_path)
    rest = np.zeros(len(start_q))
    along = np.linspace(0, 1, TIP_PATH_STATES)
    tips = np.stack(
        [np.interp(along * lengths[-1], lengths, values) for values in tip_path.T],
        axis=1,
    )
    # The straight line selects one of the arm's redundant configurations for each tip
    # position.
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
