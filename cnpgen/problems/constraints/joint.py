"""Limits of joints: position, velocity, acceleration, jerk and torque; limit of the speed of the tip.

Tolerances of all joint limits but the position are fractions of the limit.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from cnpgen.arrays import Array
from cnpgen.problems.constraints.constraint import Condition, Conditions, Constraint
from cnpgen.robots.drive import RIGID, Drive, DriveSpec, SpeedLine
from cnpgen.robots.parameter_ranges import PAYLOAD_PARAMETERS
from cnpgen.schema.keys import field, keys
from cnpgen.store.joint_units import units_of_joints

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.robots.robot import Robot
    from cnpgen.world.world import World

POWER_UNIT = "W"  # of conditions that limit powers, which are cubic in the velocity


@dataclass(frozen=True, kw_only=True)
class _RelativeLimit(Constraint):
    """Base class: symmetric limit of rates, None for jerks of boundary states, with a relative tolerance."""

    condition_name: ClassVar[str]
    unit: ClassVar[str]
    rates: ClassVar[str]
    limit: ClassVar[str]
    factor_name: ClassVar[str] = ""  # parameter by which samples scale the limit

    tolerance: float = field(
        "violation that a valid motion may have, as a fraction of the limit", low=0.0
    )

    def allowed(self, condition: Condition) -> Array:
        """Return the fraction of the limit, shape (m,)."""
        return self.tolerance * condition.upper

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the limits on the rates in SI units."""
        return self._within(state, state.parameters.get(self.factor_name))

    def measured(self, world: "World") -> Conditions:
        """Compare the rates in SI units with the limits.

        Torques are Pinocchio's inverse dynamics.
        """
        return self._within(world, world.parameters.values.get(self.factor_name))

    def _within(self, state: "SymbolicState | World", factor: Any) -> Conditions:
        """Divide rates by the factor of their limits, so that the bounds are the same for all samples."""
        # Boundary states have no jerk.
        if (rates := getattr(state, self.rates)) is None:
            return ()
        # A limit times a factor is the same as a rate divided by it.
        g = list(rates) if factor is None else [rate / factor for rate in rates]
        limit = getattr(state.robot, self.limit)
        unit = state.robot.units(self.unit)
        return (Condition(self.condition_name, unit, g, -limit, limit, "limit"),)


def _between(robot: "Robot", q: list[Any]) -> Conditions:
    bounds = robot.position_lower, robot.position_upper
    return (Condition("joint position", robot.units("rad"), q, *bounds, "limit"),)


@dataclass(frozen=True, kw_only=True)
class JointPosition(Constraint):
    """Constraint: joint positions are within their limits: ``lower <= q <= upper``."""

    reason = "joint position limit"
    reads = (
        "limits.position",
        "limits.position_scale",
        "limits.soft",
        "limits.sources.position",
    )
    training_weight = 4000.0
    training_factor = 0.999
    tolerance: float = field(
        "violation that a valid motion may have", unit="rad", low=0.0, plausible=1.0
    )

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the limits on q [rad]."""
        return _between(state.robot, state.q)

    def measured(self, world: "World") -> Conditions:
        """Compare q [rad] with the limits."""
        return _between(world.robot, list(world.q))


@dataclass(frozen=True, kw_only=True)
class JointVelocity(_RelativeLimit):
    """Constraint: joint velocities are within their limits: ``|dq| <= limit``."""

    reason = "joint velocity limit"
    reads = (
        "limits.velocity",
        "limits.velocity_scale",
        "limits.sources.velocity",
        "parameters.velocity_factor",
    )
    training_weight = 100.0
    training_factor = 0.99
    condition_name = "joint velocity"
    unit = "rad/s"
    rates = "dq"
    limit = "velocity_limit"
    factor_name = "velocity_factor"


@dataclass(frozen=True, kw_only=True)
class JointAcceleration(_RelativeLimit):
    """Constraint: joint accelerations are within their limits: ``|ddq| <= limit``."""

    reason = "joint acceleration limit"
    reads = (
        "limits.acceleration",
        "limits.acceleration_rate",
        "limits.acceleration_cap",
        "limits.sources.acceleration",
        "parameters.acceleration_factor",
    )
    training_weight = 5.0
    training_factor = 0.985
    condition_name = "joint acceleration"
    unit = "rad/s^2"
    rates = "ddq"
    limit = "acceleration_limit"
    factor_name = "acceleration_factor"


@dataclass(frozen=True, kw_only=True)
class JointJerk(_RelativeLimit):
    """Constraint: joint jerks are within their limits: ``|jerk| <= limit``; they may be discontinuous.

    Boundary states have no jerk and always satisfy it.
    """

    reason = "joint jerk limit"
    reads = "limits.jerk", "limits.sources.jerk"
    training_weight = 0.01
    training_factor = 0.97
    condition_name = "joint jerk"
    unit = "rad/s^3"
    rates = "jerk"
    limit = "jerk_limit"
    uses_jerk: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class JointTorque(_RelativeLimit):
    """Constraint: joint torques, including the payload, are within their limits: ``|ID(q, dq, ddq)| <= limit``.

    With [drive], the torques and powers of the motors are within theirs, too, for all
    friction that may act.
    """

    reason = "joint torque limit"
    reads = (
        "limits.torque",
        "limits.torque_scale",
        "limits.sources.torque",
        "limits.sources.motor",
        *(f"drive.{key.name}" for key in keys(DriveSpec)),
        *(f"payload.{key}" for key in ("mass", "centre", "inertia", "size")),
        *(f"parameters.{name}" for name in PAYLOAD_PARAMETERS),
    )
    training_weight = 1.5
    training_factor = 0.97
    condition_name = "joint torque"
    unit = "N m"
    rates = "torque"
    limit = "torque_limit"

    def _within(self, state: "SymbolicState | World", factor: Any) -> Conditions:
        drive = state.robot.drive
        if drive is None:
            return super()._within(state, factor)
        # drive.limits chooses the side of the gear: the rigid torque at the joint, that
        # of the motor, or both.
        joint = super()._within(state, factor) if drive.limits_joint else ()
        moving = MotorTorques(state.dq, state.motor_torque)
        return (*joint, *motor_conditions(state.robot, drive, moving))


class MotorTorques(NamedTuple):
    """Joint velocities [rad/s], and the lowest and highest torques at the motors [N m], symbolic or measured."""

    dq: Any
    torque: tuple[Any, Any]


def motor_conditions(
    robot: "Robot", drive: Drive, state: MotorTorques
) -> Iterator[Condition]:
    """Yield the limits of motors: torques, torque-speed lines and powers, for all friction that may act."""
    low, high = state.torque
    # Both rows have both bounds: the redundant ones never bind, since high >= low.
    ends = {
        "highest": (high, drive.motor_rows),
        "lowest": (low, drive.uncertain_rows),
    }
    # The limit of the torque is a line of slope zero.
    flat = SpeedLine(drive.torque_limit, np.zeros(robot.n), motoring=True)
    for number, line in enumerate((flat, *drive.lines)):
        for end, (torque, joints) in ends.items():
            if joints:
                name = f"{end} motor torque" + (f", line {number}" if number else "")
                yield _line_condition(robot, name, line, (torque, state.dq), joints)
    if drive.power_limit is not None:
        yield _power_condition(robot, drive, drive.power_limit, state)


def _line_condition(
    robot: "Robot", name: str, line: SpeedLine, state: Any, joints: tuple[int, ...]
) -> Condition:
    """Return the condition that torques of motors are below a line: ``|tau_m + s slope dq| <= torque``."""
    torque, dq = state
    rows = joints * len(line.signs)
    signs = np.repeat(line.signs, len(joints)).tolist()
    unit = units_of_joints("N m", tuple(robot.prismatic[joint] for joint in rows))
    # A line without slope omits the velocity, so that kernels have no product with
    # zero.
    g = [
        torque[joint] + sign * slope * dq[joint]
        if (slope := float(line.slope[joint]))
        else torque[joint]
        for joint, sign in zip(rows, signs, strict=True)
    ]
    limit = line.torque[list(rows)]
    parts = tuple(robot.joint_names[joint] for joint in rows)
    return Condition(name, unit, g, -limit, limit, "limit", parts)


def _power_condition(
    robot: "Robot", drive: Drive, power: Array, state: MotorTorques
) -> Condition:
    """Return the condition that motors deliver at most their power, ``tau_m dq <= P``; braking is not limited.

    The highest torque bounds the power of forward motion, the lowest that of backward
    motion. The lower bound is twice what the limits of torque and velocity allow, so
    that it is finite and never binds.
    """
    dq, (low, high) = state
    rows = [*drive.motor_rows, *drive.uncertain_rows]
    g = [high[joint] * dq[joint] for joint in drive.motor_rows]
    g += [low[joint] * dq[joint] for joint in drive.uncertain_rows]
    # |tau dq| <= tau_max dq_max, so that twice this bound is never reached.
    lowest = -2 * (np.maximum(drive.torque_limit * robot.velocity_limit, power))[rows]
    parts = tuple(robot.joint_names[joint] for joint in rows)
    return Condition("motor power", POWER_UNIT, g, lowest, power[rows], "limit", parts)


def judged_torque(constraints: Sequence[Constraint], robot: "Robot") -> str:
    """Return which torque the constraints limit, in words; empty if they limit none."""
    if not any(isinstance(each, JointTorque) for each in constraints):
        return ""
    return RIGID if robot.drive is None else robot.drive.summary


@dataclass(frozen=True, kw_only=True)
class TipSpeed(Constraint):
    """Constraint: tip speed within a limit, ``|v| <= limit``, stated for the square, a smooth function."""

    reason = "tip too fast"
    reads = ()
    limit: float = field("maximum speed of the tip", unit="m/s", low=1e-6)
    tolerance: float = field(
        "additional speed that a valid motion may have",
        unit="m/s",
        low=0.0,
        plausible=1.0,
    )

    def allowed(self, condition: Condition) -> Array:
        """Return the tolerance of the square of the speed [m^2/s^2]."""
        # (limit + tolerance)^2 - limit^2 is the tolerance of the square.
        return np.full(
            len(condition.g), (self.limit + self.tolerance) ** 2 - self.limit**2
        )

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the square of the tip's speed [m^2/s^2]."""
        return self._slow(state.tip_velocity)

    def measured(self, world: "World") -> Conditions:
        """Evaluate Pinocchio's velocity of the tip."""
        return self._slow(list(world.tip_velocity))

    def _slow(self, velocity: Sequence[Any]) -> Conditions:
        square = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
        return (
            Condition(
                "tip speed",
                "m^2/s^2",
                [square],
                # A square is never below zero.
                np.array([-np.inf]),
                np.array([self.limit**2]),
                "velocity",
            ),
        )
