"""Joint limits: position, velocity, acceleration, jerk and torque, each within the planning limits of the robot.

Tolerances of all but the position are fractions of the limit.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.robots.robot import Robot
    from cnpgen.world.world import World


@dataclass(frozen=True, kw_only=True)
class _RelativeLimit(Constraint):
    """Base class: symmetric limit with a relative tolerance."""

    factor_name: ClassVar[str] = ""  # parameter by which samples scale the limit

    tolerance: float = field("violation that a valid motion may have, as a fraction of the limit", low=0.0)

    def allowed(self, condition: Condition) -> NDArray[np.float64]:
        """Return the fraction of the limit, shape (m,)."""
        return self.tolerance * condition.upper


def _within(name: str, unit: str, g: list[Any], limit: NDArray[np.float64]) -> tuple[Condition, ...]:
    return (Condition(name, unit, g, -limit, limit, "limit"),)


def _per_factor(rates: list[Any], factor: Any) -> list[Any]:
    """Return rates divided by the factor of their limits, so that the bounds are the same for all samples."""
    return rates if factor is None else [rate / factor for rate in rates]


def _between(robot: "Robot", q: list[Any]) -> tuple[Condition, ...]:
    bounds = robot.position_lower, robot.position_upper
    return (Condition("joint position", robot.units("rad"), q, *bounds, "limit"),)


@dataclass(frozen=True, kw_only=True)
class JointPosition(Constraint):
    """Constraint: joint positions are within their limits: ``lower <= q <= upper``."""

    reason = "joint position limit"
    training_weight, training_factor = 4000.0, 0.999
    tolerance: float = field("violation that a valid motion may have", unit="rad", low=0.0)

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the limits on q [rad]."""
        return _between(state.robot, state.q)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Compare q [rad] with the limits."""
        return _between(world.robot, list(world.q))


@dataclass(frozen=True, kw_only=True)
class JointVelocity(_RelativeLimit):
    """Constraint: joint velocities are within their limits: ``|dq| <= limit``."""

    reason = "joint velocity limit"
    training_weight, training_factor = 100.0, 0.99
    factor_name = "velocity_factor"

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the limits on dq [rad/s]."""
        rates = _per_factor(state.dq, state.parameters.get(self.factor_name))
        return _within("joint velocity", state.robot.units("rad/s"), rates, state.robot.velocity_limit)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Compare dq [rad/s] with the limits."""
        rates = _per_factor(list(world.dq), world.parameters.values.get(self.factor_name))
        return _within("joint velocity", world.robot.units("rad/s"), rates, world.robot.velocity_limit)


@dataclass(frozen=True, kw_only=True)
class JointAcceleration(_RelativeLimit):
    """Constraint: joint accelerations are within their limits: ``|ddq| <= limit``."""

    reason = "joint acceleration limit"
    training_weight, training_factor = 5.0, 0.985
    factor_name = "acceleration_factor"

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the limits on ddq [rad/s^2]."""
        rates = _per_factor(state.ddq, state.parameters.get(self.factor_name))
        return _within("joint acceleration", state.robot.units("rad/s^2"), rates, state.robot.acceleration_limit)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Compare ddq [rad/s^2] with the limits."""
        rates = _per_factor(list(world.ddq), world.parameters.values.get(self.factor_name))
        return _within("joint acceleration", world.robot.units("rad/s^2"), rates, world.robot.acceleration_limit)


@dataclass(frozen=True, kw_only=True)
class JointJerk(_RelativeLimit):
    """Constraint: joint jerks are within their limits: ``|jerk| <= limit``; they may be discontinuous.

    Boundary states have no jerk and always satisfy it.
    """

    reason = "joint jerk limit"
    training_weight, training_factor = 0.01, 0.97
    uses_jerk: ClassVar[bool] = True

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the limits on the jerk [rad/s^3], if the state has a jerk."""
        if state.jerk is None:
            return ()
        return _within("joint jerk", state.robot.units("rad/s^3"), state.jerk, state.robot.jerk_limit)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Compare the jerk [rad/s^3] with the limits, if the state has a jerk."""
        if world.jerk is None:
            return ()
        return _within("joint jerk", world.robot.units("rad/s^3"), list(world.jerk), world.robot.jerk_limit)


@dataclass(frozen=True, kw_only=True)
class JointTorque(_RelativeLimit):
    """Constraint: joint torques, including the payload, are within their limits: ``|ID(q, dq, ddq)| <= limit``."""

    reason = "joint torque limit"
    training_weight, training_factor = 1.5, 0.97

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the limits on the inverse dynamics [N m]."""
        return _within("joint torque", state.robot.units("N m"), state.torque, state.robot.torque_limit)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Compare Pinocchio's inverse dynamics [N m] with the limits."""
        return _within("joint torque", world.robot.units("N m"), list(world.torque), world.robot.torque_limit)
