"""Stages: boundary velocities and accelerations, zero or random, exactly on the table manifold."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from cnpgen.documents import NamedErrors
from cnpgen.kernels.symbolic.drive import motor_torque
from cnpgen.kernels.symbolic.dynamics import inverse_dynamics
from cnpgen.kernels.symbolic.kinematics import (
    bias_acceleration,
    forward_kinematics,
    tip_velocity,
)
from cnpgen.kernels.symbolic.linalg import (
    Scalar,
    Vec,
    add,
    dot,
    scale,
    subtract,
    symbols,
)
from cnpgen.pipelines.stages.stage import (
    CandidateBatch,
    Context,
    Stage,
    StageFunction,
    fraction,
)
from cnpgen.problems.constraints.joint import MotorTorques, motor_conditions
from cnpgen.problems.constraints.table import Table
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field
from cnpgen.store.field import Field, Fields

PROJECTION_STEPS = 3  # Newton steps from a millimetre to rounding error
MAX_VELOCITY_RATIO = 1.005  # largest ratio of a plan's velocity to its limit
# Rad/s and rad/s^2: rounding error of a velocity or acceleration that is zero.
AT_REST_TOLERANCE = 1e-9


def _motion_fields(context: Context, end: str) -> tuple[Field, Field]:
    role = "input" if end == "start" else "target"
    return (
        context.joint_field(
            f"{end}_dq", "rad/s", f"joint velocities at the {end}", role
        ),
        context.joint_field(
            f"{end}_ddq", "rad/s^2", f"joint accelerations at the {end}", role
        ),
    )


@dataclass(frozen=True, kw_only=True)
class AtRest(Stage):
    """Stage: zero velocity and acceleration at one end.

    The goal acceleration is prescribed only if requested.
    """

    end: str = field("end that is at rest", choices=("start", "goal"))
    acceleration: str = field(
        'whether motions must end with an acceleration of "zero", which is stored then, or are "free" to stop with any;'
        " they always start with zero",
        choices=("free", "zero"),
        default="free",
        since_version=2,
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if self.end == "start" and self.acceleration == "zero":
            yield "acceleration", "motions always start with zero: omit it"

    def describe(self) -> str:
        if self.end == "goal" and self.acceleration == "free":
            return "set the velocity of the goal to zero; its acceleration is free"
        kept = ", which motions must end with" if self.end == "goal" else ""
        return f"set velocity and acceleration of the {self.end} to zero{kept}"

    def outputs(self, context: Context) -> Fields:
        fields = _motion_fields(context, self.end)
        return (
            fields if self.end == "start" or self.acceleration == "zero" else fields[:1]
        )

    def writes(self, context: Context) -> tuple[str, ...]:
        """List velocity and acceleration.

        The checks use an acceleration that is not stored, too.
        """
        return f"{self.end}_dq", f"{self.end}_ddq"

    def prepare(self, context: Context) -> StageFunction:
        n = context.robot.n

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            for name in (f"{self.end}_dq", f"{self.end}_ddq"):
                candidates[name] = np.zeros((n, len(candidates.alive)))

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Reject tasks with a non-zero given velocity or acceleration."""
        rest = self.prepare(context)
        names = [name for name in self.writes(context) if name in given]

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            for name in names:
                candidates.reject(
                    (np.abs(candidates[name]) <= AT_REST_TOLERANCE).all(0),
                    f"not at rest at the {self.end}",
                )
            rest(candidates, random)

        return work


@dataclass(frozen=True, kw_only=True)
class TableVelocity(Stage):
    """Stage: random start velocity with ``J_z dq = 0``: a direction in the box of the limits, with uniform length."""

    inputs = ("start_q",)
    at_rest: float = fraction("fraction of the starts at rest", default=0.0)

    def describe(self) -> str:
        return (
            "draw a start velocity: direction uniform in the box of the limits, projected on the table manifold, length"
            f" uniform between 0 and the first limit that it meets; zero in {100 * self.at_rest:.4g} % of the cases"
        )

    def outputs(self, context: Context) -> Fields:
        return _motion_fields(context, "start")[:1]

    def writes(self, context: Context) -> tuple[str, ...]:
        return "start_dq", "start_tip_velocity"

    def prepare(self, context: Context) -> StageFunction:
        context.constraint(Table)
        kernel = context.kernels.load(table_velocity)
        n = context.robot.n

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            # Numbers are drawn for all candidates, whatever earlier stages rejected.
            direction = 2 * candidates.draw(random, n) - 1
            length = candidates.draw(random, 1)
            choice = candidates.draw(random, 1)
            length[choice < self.at_rest] = 0.0
            candidates["start_dq"], candidates["start_tip_velocity"] = kernel(
                candidates["start_q"], direction, length
            )
            candidates.reject(
                np.isfinite(candidates["start_dq"]).all(0),
                "no velocity on the manifold",
            )

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Load the kernel of the tip velocity.

        A start without a given velocity is at rest.
        """
        kernel = context.kernels.load(velocity_of_tip)
        n = context.robot.n

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            if "start_dq" not in given:
                candidates["start_dq"] = np.zeros((n, len(candidates.alive)))
            (candidates["start_tip_velocity"],) = kernel(
                candidates["start_q"], candidates["start_dq"]
            )

        return work


@dataclass(frozen=True, kw_only=True)
class TableAcceleration(Stage):
    """Stage: random acceleration with ``J_z ddq + dJ_z dq = 0`` at one end, within acceleration and torque limits."""

    end: str = field(
        "end whose acceleration is sampled", choices=("start", "goal"), default="start"
    )

    @property
    def inputs(self) -> tuple[str, ...]:
        return f"{self.end}_q", f"{self.end}_dq"

    def describe(self) -> str:
        return (
            f"draw an acceleration of the {self.end} on the table manifold, uniform between the acceleration and torque"
            " limits that it meets along a random direction"
        )

    def outputs(self, context: Context) -> Fields:
        return _motion_fields(context, self.end)[1:]

    def prepare(self, context: Context) -> StageFunction:
        context.constraint(Table)
        kernel = context.kernels.load(table_acceleration)
        n = context.robot.n

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            direction = 2 * candidates.draw(random, n) - 1
            length = candidates.draw(random, 1)
            acceleration, interval_length = kernel(
                candidates[f"{self.end}_q"],
                candidates[f"{self.end}_dq"],
                direction,
                length,
            )
            candidates[f"{self.end}_ddq"] = acceleration
            candidates.reject(
                interval_length[0] >= 0,
                f"no acceleration within the limits at the {self.end}",
            )

        return work


def velocity_of_tip(robot: Robot) -> Any:
    """Build ``(q, dq) -> velocity of the tip`` [m/s]."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    dq_sx, dq = symbols("dq", robot.n)
    velocity = tip_velocity(forward_kinematics(robot.chain, q), dq)
    return ca.Function("velocity_of_tip", [q_sx, dq_sx], [ca.vertcat(*velocity)])


def onto_table(robot: Robot, *, height: float) -> Any:
    """Build the projection ``(q, dq, ddq) -> (q, dq, ddq)`` onto states whose tip moves and accelerates on the table.

    The table has a height [m]. Use it for deviations as small as those of plans: three
    Newton steps for q, then two projections. Velocities slightly above their limits are
    scaled to the limits.
    """
    import casadi as ca

    (q_sx, q), (dq_sx, dq), (ddq_sx, ddq) = (
        symbols(name, robot.n) for name in ("q", "dq", "ddq")
    )
    limit = [float(x) for x in robot.velocity_limit]
    # Newton with the vertical row of the Jacobian: the constraint is z(q) = height.
    for _ in range(PROJECTION_STEPS):
        kin = forward_kinematics(robot.chain, q)
        q = _project(
            q, [c[2] for c in kin.jacobian], limit, rest=kin.tip[2] - height, at=q
        )
    kin = forward_kinematics(robot.chain, q)
    row = [c[2] for c in kin.jacobian]
    # Only the component along J_z leaves the manifold: J_z dq = 0.
    dq = _project(dq, row, limit)
    # Largest ratio of a velocity to its limit.
    over = ca.mmax(
        ca.vertcat(*[ca.fabs(x) / bound for x, bound in zip(dq, limit, strict=True)])
    )
    # A plan may exceed a limit by its tolerance; larger excess is a fault and stays
    # visible.
    dq = scale(
        dq, 1.0 / ca.if_else(over <= MAX_VELOCITY_RATIO, ca.fmax(over, 1.0), 1.0)
    )
    # J_z ddq = -dJ_z dq: the bias acceleration is the prescribed part.
    ddq = _project(
        ddq,
        row,
        [float(x) for x in robot.acceleration_limit],
        rest=bias_acceleration(kin, dq)[2],
    )
    return ca.Function(
        "onto_table",
        [q_sx, dq_sx, ddq_sx],
        [ca.vertcat(*values) for values in (q, dq, ddq)],
    )


def table_velocity(robot: Robot) -> Any:
    """Build ``(q, direction, length) -> (dq, tip velocity)`` with ``J_z dq = 0``.

    The direction, in units of the limits, is projected onto the manifold in the metric
    of the limits. It is scaled until the first joint meets its limit, and multiplied by
    the length in [0, 1).
    """
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    u_sx, u = symbols("u", robot.n)
    s_sx, s = symbols("s", 1)
    kin = forward_kinematics(robot.chain, q)
    limit = [float(x) for x in robot.velocity_limit]
    on_manifold = _project(
        [x * bound for x, bound in zip(u, limit, strict=True)],
        [c[2] for c in kin.jacobian],
        limit,
    )
    # Ray from 0 to the box |dq_i| <= limit_i: divide by the largest ratio.
    ratios = (ca.fabs(x) / bound for x, bound in zip(on_manifold, limit, strict=True))
    dq = scale(on_manifold, s[0] / reduce(ca.fmax, ratios, ca.SX(0)))
    return ca.Function(
        "table_velocity",
        [q_sx, u_sx, s_sx],
        [ca.vertcat(*dq), ca.vertcat(*tip_velocity(kin, dq))],
    )


def table_acceleration(robot: Robot) -> Any:
    """Build ``(q, dq, direction, length) -> (ddq, interval_length)`` with ``J_z ddq + dJ_z dq = 0``.

    ``ddq = particular + t * projected direction`` with the particular solution of
    minimum weighted maximum norm. Torque is affine in t (two inverse dynamics), so
    every limit is an interval of t, and t is uniform in their intersection.
    ``interval_length`` is the length of the intersection, negative if the particular
    solution violates a limit.
    """
    import casadi as ca

    (q_sx, q), (dq_sx, dq), (u_sx, u), (s_sx, s) = (
        symbols(name, width)
        for name, width in (("q", robot.n), ("dq", robot.n), ("u", robot.n), ("s", 1))
    )
    kin = forward_kinematics(robot.chain, q)
    limit = [float(x) for x in robot.acceleration_limit]
    row = [column[2] for column in kin.jacobian]
    # Of all ddq with J_z ddq = c, the one with the smallest max_i |ddq_i| / limit_i has
    # all ratios equal: ddq_i = c / (sum_k limit_k |J_k|) * limit_i sign(J_i).
    pairs = list(zip(limit, row, strict=True))
    size = sum((bound * ca.fabs(x) for bound, x in pairs), 0.0)
    share = -bias_acceleration(kin, dq)[2] / size
    particular = [share * bound * ca.sign(x) for bound, x in pairs]
    # A direction within the manifold: J_z u = 0, so that every t keeps the constraint.
    scaled = [x * bound for x, bound in zip(u, limit, strict=True)]
    direction = _project(scaled, row, limit)
    # Torque is affine in ddq, so two evaluations give its value and its change with t.
    torque = inverse_dynamics(robot.chain, q, dq, particular)
    shifted = inverse_dynamics(robot.chain, q, dq, add(particular, direction))
    change = [b - a for a, b in zip(torque, shifted, strict=True)]
    torques, changes, torque_bounds = _limited_torques(
        robot, (torque, change), dq, (particular, direction)
    )
    bounds = [*limit, *torque_bounds]
    low, high = _interval([*particular, *torques], [*direction, *changes], bounds)
    ddq = add(particular, scale(direction, low + s[0] * (high - low)))
    # t = 0, the particular solution, must be admissible; otherwise no solution is
    # sought.
    admissible = ca.logic_and(low <= 0, high >= 0)
    interval_length = ca.if_else(admissible, high - low, -1.0)
    return ca.Function(
        "table_acceleration",
        [q_sx, dq_sx, u_sx, s_sx],
        [ca.vertcat(*ddq), interval_length],
    )


def _limited_torques(
    robot: Robot, torque: tuple[Vec, Vec], dq: Vec, ddq: tuple[Vec, Vec]
) -> tuple[Vec, Vec, list[float]]:
    """Return values, changes along a direction, and bounds of all limited torques.

    ``torque`` and ``ddq`` have values and changes. The friction of a drive does not
    change, since the velocity does not.
    """
    value, change = torque
    limit = [float(x) for x in robot.torque_limit]
    if robot.drive is None:
        return value, change, limit
    drive, (inner, outer) = robot.drive, ddq
    values, changes, bounds = (
        (list(value), list(change), limit) if drive.limits_joint else ([], [], [])
    )
    still, moved = (
        list(motor_conditions(robot, drive, MotorTorques(dq, torques)))
        for torques in (
            motor_torque(drive, value, dq, inner),
            motor_torque(drive, add(value, change), dq, add(inner, outer)),
        )
    )
    for first, second in zip(still, moved, strict=True):
        centers, halves = first.middle
        values += [g - x for g, x in zip(first.g, centers.tolist(), strict=True)]
        changes += [b - a for a, b in zip(first.g, second.g, strict=True)]
        bounds += halves.tolist()
    return values, changes, bounds


def _project(
    x: Vec, row: Vec, weight: list[float], *, rest: Scalar = 0.0, at: Vec | None = None
) -> Vec:
    """Project x onto the plane ``row . (x - at) + rest = 0`` in the metric ``diag(weight)^-2``.

    ``at`` is zero by default.
    """
    # x - W J (J x + rest) / (J W J) with W = diag(weight)^2: joints with large limits
    # move more.
    spread = [bound * bound * r for bound, r in zip(weight, row, strict=True)]
    miss = (dot(row, x if at is None else subtract(x, at)) + rest) / dot(row, spread)
    return [value - s * miss for value, s in zip(x, spread, strict=True)]


def _interval(
    at_zero: Vec, gradient: Vec, bounds: list[float]
) -> tuple[Scalar, Scalar]:
    """Return the interval of t with ``|at_zero + t gradient| <= bounds`` in every component."""
    import casadi as ca

    low = ca.SX(-1e9)
    high = ca.SX(1e9)
    for value, rate, bound in zip(at_zero, gradient, bounds, strict=True):
        # 1 / 0 is infinite: a component that does not change bounds t only if it is
        # violated, and then the interval is empty.
        inverse = 1.0 / rate
        one = (bound - value) * inverse
        two = (-bound - value) * inverse
        low = ca.fmax(low, ca.fmin(one, two))
        high = ca.fmin(high, ca.fmax(one, two))
    return low, high
