"""Checks of the goals of hits, as far as the recorded stages of a dataset determine them: configuration and speed.

A hitting configuration is a maximum of ``f(q) = |J(q)^T d|^2 - |(q0 - q) / L|^2`` among
the configurations that put the tip at the goal, within the joint limits (reference 2,
section on hitting): ``d`` is the direction of the hit, ``J`` the translational Jacobian
of the tip, ``q0`` the base, the start or the home configuration, ``L`` the rated joint
velocities. There the gradient of f is a combination of the rows of J, except for joints
at a limit towards which f increases. Any of several maxima is accepted. A hitting
velocity is the fastest one or a random fraction of it.

The highest speed of a hit is the optimum of a linear program: maximize ``a . v``
subject to ``B v = 0`` and ``|v_i| <= L_i``. Here ``a`` is the tip velocity along the
hit per joint velocity, and the two rows of B are the velocities across it. The dual,
``min over y of sum_i L_i |a_i - (B^T y)_i|``, is convex and piecewise linear: its
minimum is at a vertex, where two of the terms vanish.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cnpgen.arrays import Array
from cnpgen.documents import JsonMapping
from cnpgen.judges.rows.row_report import Check, Index, compare
from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES
from cnpgen.robots.robot import Robot
from cnpgen.world.measured_parameters import MeasuredParameters

# Tolerance of the projected gradient of f [m^2/rad]. In float32 the joints have errors
# of 1e-7 rad.
STATIONARITY_TOLERANCES = {"float64": 1e-8, "float32": 1e-5}
# Joints closer to a limit are at the limit.
ACTIVE_LIMIT_TOLERANCES_RAD = {
    "float64": 1e-9,
    "float32": 1e-6,
}
# Between quotients of stored numbers that were equal.
FRACTION_TOLERANCES = {
    "float64": 4e-16,
    "float32": 2.5e-7,
}
MIN_PROBABILITY = 1e-9  # of equal fractions by chance
# Relative determinant below which two terms have no vertex that can be computed.
PARALLEL_TOLERANCE = 1e-9


@dataclass(frozen=True)
class HitRule:
    """Rule by which the stages of a dataset chose its goals.

    They stay close to the configuration "base", "start" or "home", if it is not empty.
    A fraction of the hits has the highest possible speed; None if no stage chooses the
    speed.
    """

    near: str = ""
    full_speed: float | None = None


def hit_rule(stages: Iterable[JsonMapping]) -> HitRule:
    """Read the rule for goals from resolved stages."""
    # The rule depends on two stages; other ones leave goals as they are.
    by_kind = {stage.get("use"): stage for stage in stages}
    near = by_kind.get("hitting-configuration", {}).get("near", "")
    return HitRule(str(near), by_kind.get("hitting-velocity", {}).get("full_speed"))


def judge_goals(
    robot: Robot, rule: HitRule, columns: Mapping[str, Array], finite: Index, dtype: str
) -> list[tuple[Check, Index]]:
    """Check the goals of finite rows against the rule of the stages.

    Columns, field -> values in SI units, have shape (rows, width). The float type is
    that of the stored rows.
    """
    judged = []
    if rule.near and "hit_angle" in columns:
        judged.append(_judge_configurations(robot, rule, columns, finite, dtype))
    if rule.full_speed is not None and "hit_speed_max" in columns:
        judged.append(_judge_velocities(robot, rule, columns, finite, dtype))
    return judged


def _judge_configurations(
    robot: Robot, rule: HitRule, columns: Mapping[str, Array], finite: Index, dtype: str
) -> tuple[Check, Index]:
    """Check that goals are maxima of f: its gradient vanishes in the directions that the constraints leave free."""
    q = columns["goal_q"][finite]
    near_base = np.broadcast_to(robot.home, q.shape)
    home = near_base if rule.near == "base" else columns[f"{rule.near}_q"][finite]
    direction = _directions(robot, columns, finite)
    at_limit = ACTIVE_LIMIT_TOLERANCES_RAD[dtype]
    return compare(
        "hitting configuration",
        "m^2/rad",
        violation=_projected_gradients(robot, q, home, direction, at_limit),
        tolerance=STATIONARITY_TOLERANCES[dtype],
        row=finite,
    )


def _judge_velocities(
    robot: Robot, rule: HitRule, columns: Mapping[str, Array], finite: Index, dtype: str
) -> tuple[Check, Index]:
    """Check that joint velocities are within the fraction of their limits that the speed is of the highest one."""
    fraction = speed_fractions(columns)[finite]
    share = fraction * velocity_factors(robot, columns)[finite]
    velocity = np.abs(columns["goal_dq"][finite])
    violation = velocity - share[:, None] * robot.velocity_limit
    # With a full speed of 1 every hit is the fastest one; slower hits were changed
    # later.
    slow = np.where(fraction == 1, 0.0, np.inf)
    too_slow = slow if rule.full_speed == 1 else np.zeros(len(finite))
    error = np.maximum(violation.max(axis=1, initial=0.0), 0.0)
    return compare(
        "hitting velocity",
        "rad/s",
        violation=np.maximum(error, too_slow),
        tolerance=BOUNDARY_TOLERANCES[dtype]["velocity"],
        row=finite,
    )


def speed_fractions(columns: Mapping[str, Array]) -> Array:
    """Compute the speed of each hit as a fraction of the highest possible one, shape (rows,)."""
    speed, highest = (
        np.asarray(columns[name], np.float64).reshape(-1)
        for name in ("hit_speed", "hit_speed_max")
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(speed / highest)


def repeated_fraction(fractions: Array, dtype: str) -> tuple[int, float]:
    """Find a fraction below 1 that more hits have than chance explains: such hits were scaled in time afterwards.

    The fractions are those of all rows of a dataset. Return the number of hits with the
    fraction, and the fraction; 0 if there is none.
    """
    drawn = np.sort(fractions[(fractions > 0) & (fractions < 1)])
    # Chance that m of N uniform numbers lie within the tolerance e: about N (N e)^(m-1)
    # / (m-1)!. Find the smallest m that chance does not explain.
    expected = len(drawn) * FRACTION_TOLERANCES[dtype]
    count = 2
    while (
        len(drawn) * expected ** (count - 1) / math.factorial(count - 1)
        > MIN_PROBABILITY
    ):
        count += 1
    close = (
        drawn[count - 1 :] - drawn[: max(len(drawn) - count + 1, 0)]
        <= FRACTION_TOLERANCES[dtype]
    )
    if not close.any():
        return 0, 0.0
    value = float(drawn[int(np.argmax(close))])
    return int((np.abs(drawn - value) <= FRACTION_TOLERANCES[dtype]).sum()), value


def velocity_factors(robot: Robot, columns: Mapping[str, Array]) -> Array:
    """Return the factor of the velocity limits of every row, shape (rows,)."""
    names = robot.parameters.names
    if "velocity_factor" not in names:
        return np.ones(len(columns["goal_q"]))
    return columns["parameters"][:, names.index("velocity_factor")]


def _directions(robot: Robot, columns: Mapping[str, Array], finite: Index) -> Array:
    """Return the unit directions of hits on the tables of finite rows, in the world frame, shape (rows, 3)."""
    angle = columns["hit_angle"][finite, 0]
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    # The hit is planned in the plane of the table, which may be tilted.
    if robot.parameters.tilts_table:
        table = MeasuredParameters(robot)
        for row, values in enumerate(columns["parameters"][finite]):
            table.set(values)
            direction[row] = table.along_world(direction[row])
    return direction


def _projected_gradients(
    robot: Robot, q: Array, home: Array, direction: Array, at_limit: float
) -> Array:
    """Compute the gradient of f in the directions that the constraints leave free [m^2/rad], shape (rows,)."""
    jacobian, gradient = _gradients(robot, q, home, direction)
    low = q - robot.position_lower < at_limit
    high = robot.position_upper - q < at_limit
    # Joints at a limit are fixed: without their columns, the multiplier explains the
    # gradient by the rows of J as far as possible.
    free = jacobian * ~(low | high)[:, None]
    multiplier = np.linalg.pinv(free @ free.swapaxes(1, 2)) @ (
        free @ gradient[:, :, None]
    )
    projected = gradient - (jacobian.swapaxes(1, 2) @ multiplier)[:, :, 0]
    # At a limit f may increase towards the limit.
    ascent = np.where(high, -projected, np.where(low, projected, np.abs(projected)))
    return np.asarray(ascent.max(axis=1, initial=0.0))


def _gradients(
    robot: Robot, q: Array, home: Array, direction: Array
) -> tuple[Array, Array]:
    """Return J, shape (rows, 3, n), and the gradient of f, shape (rows, n), by derivatives of the tip's velocity.

    Pinocchio differentiates the velocity of the tip's frame as if its axes turned with
    it. That adds a combination of the rows of J to the gradient, which the projection
    removes.
    """
    import pinocchio as pin

    model = robot.model
    tip = robot.tip_frame
    frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    data = model.createData()
    zero = np.zeros(robot.n)
    jacobian = np.empty((len(q), 3, robot.n))
    gradient = np.empty((len(q), robot.n))
    for row in range(len(q)):
        jacobian[row] = pin.computeFrameJacobian(model, data, q[row], tip, frame)[:3]
        pin.computeForwardKinematicsDerivatives(
            model, data, q[row], direction[row] @ jacobian[row], zero
        )
        by_position, _ = pin.getFrameVelocityDerivatives(model, data, tip, frame)
        gradient[row] = direction[row] @ by_position[:3]
    return jacobian, 2 * gradient + 2 * (home - q) / robot.rated_velocity**2


def highest_speed(jacobian: Array, angle: Array, limit: Array) -> Array:
    """Compute the highest speed of the tip along hits in the x-y plane within velocity limits [m/s], shape (rows,).

    Translational Jacobians in world axes [m] have shape (rows, 3, n), directions [rad]
    (rows,). The speed is inf where B has less than two independent columns.
    """
    x, y, z = jacobian.transpose(1, 0, 2)
    cosine = np.cos(angle)[:, None]
    sine = np.sin(angle)[:, None]
    a = cosine * x + sine * y
    b = cosine * y - sine * x
    # Vertices of the dual: y solves a_k = (B' y)_k for two joints i and j (Cramer's
    # rule).
    i, j = np.array(list(combinations(range(len(limit)), 2))).T
    first = b[:, i] * z[:, j]
    second = z[:, i] * b[:, j]
    # A determinant that is rounding error gives no vertex.
    vertex = np.abs(first - second) > PARALLEL_TOLERANCE * (
        np.abs(first) + np.abs(second)
    )
    scale = 1 / np.where(vertex, first - second, 1.0)
    u = (a[:, i] * z[:, j] - z[:, i] * a[:, j]) * scale
    w = (b[:, i] * a[:, j] - a[:, i] * b[:, j]) * scale
    residual = np.abs(
        a[:, :, None] - b[:, :, None] * u[:, None] - z[:, :, None] * w[:, None]
    )
    # The dual function at each vertex; its minimum is the highest speed (strong
    # duality).
    return np.asarray(
        np.where(vertex, limit @ residual, np.inf).min(axis=1, initial=np.inf)
    )
