"""Constraints that align an axis of the tip with a world direction, exactly or within an angle."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition, Constraint, End
from cnpgen.problems.constraints.tip_manifold import Vector, along, beside, unit
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.world.world import World

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class TipAxis(Constraint):
    """Base class: the tip's axis a is along the world direction d: ``e1 . R a = e2 . R a = 0`` and ``d . R a > 0``.

    e1 and e2 are orthogonal to d: ``1 - d . R a`` has no gradient at the solution. The two values are the components of
    the tilt [rad] to first order. The verdict limits the angle between both, so the tolerance of each component is that
    of the angle divided by the square root of 2.
    """

    training_weight = 300.0

    @property
    @abstractmethod
    def directions(self) -> tuple[list[float], list[float]]:
        """Return the axis in the tip frame and the direction in the world, unit vectors; subclasses cache them."""

    @cached_property
    def across(self) -> list[list[float]]:
        """Return two world unit vectors orthogonal to the direction."""
        found: list[list[float]] = beside(np.array(self.directions[1])).tolist()
        return found

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the tilt [rad]."""
        return self._held(state.kinematics.rotation)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Evaluate the tilt of Pinocchio's tip frame [rad]."""
        return self._held(list(world.tip_rotation))

    def judged(self, world: "World") -> tuple[Condition, ...]:
        """Evaluate the angle between axis and direction [rad]."""
        tilt, upright = self.measured(world)
        angle = np.arctan2(np.hypot(*tilt.g), upright.g[0])
        return (replace(tilt, g=[angle], lower=np.zeros(1), upper=np.zeros(1), parts=()),)

    def allowed(self, condition: Condition) -> Array:
        """Return the tolerance of the angle, or of each of its components."""
        return np.asarray(super().allowed(condition) / np.sqrt(len(condition.g)))

    def _held(self, rotation: Sequence[Any]) -> tuple[Condition, ...]:
        axis, direction = self.directions
        pointing = [along(axis, row) for row in rotation]
        tilt = [along(row, pointing) for row in self.across]
        upright = [along(direction, pointing)]
        return (
            Condition("tilt", "rad", tilt, np.zeros(2), np.zeros(2), "angle", ("x", "y")),
            Condition("upright", "1", upright, np.zeros(1), np.full(1, np.inf), "angle"),
        )


@dataclass(frozen=True, kw_only=True)
class Axis(TipAxis):
    """Constraint: a tip axis is within an angle of a direction, or aligned with it and at rest at the ends."""

    reason = "tool tilted"
    axis: Vector = field("axis in the tip frame, of any length", default=(0.0, 0.0, 1.0))
    direction: Vector = field("direction in the world, of any length", default=(0.0, 0.0, 1.0))
    angle: float = field("maximum angle between axis and direction", unit="rad", default=0.0, low=0.0, high=1.5)
    tolerance: float = field("additional angle that a valid motion may have", unit="rad", low=1e-9)

    def __post_init__(self) -> None:
        """Check both directions.

        Raises:
            ValueError: A direction is zero or not finite.
        """
        unit(self.axis, "axis")
        unit(self.direction, "direction")

    @cached_property
    def directions(self) -> tuple[list[float], list[float]]:
        """The axis in the tip's frame and the direction in the world, unit vectors."""
        return unit(self.axis, "axis").tolist(), unit(self.direction, "direction").tolist()

    def allowed(self, condition: Condition) -> Array:
        """Return the tolerance of motions; with an angle, that of its cosine."""
        if not self.angle:
            return super().allowed(condition)
        return np.full(len(condition.g), np.cos(self.angle) - np.cos(min(self.angle + self.tolerance, np.pi)))

    def judged(self, world: "World") -> tuple[Condition, ...]:
        """Evaluate the angle between axis and direction [rad], or its cosine for a range of angles."""
        return self.measured(world) if self.angle else super().judged(world)

    def symbolic_at(self, state: "SymbolicState", end: End) -> tuple[Condition, ...]:
        """State the tilt and, for an aligned axis, its rates."""
        found = super().symbolic_at(state, end)
        if self.angle:
            return found
        turning = state.tip_angular_velocity, state.tip_angular_acceleration
        return (*found, *self._resting(state.kinematics.rotation, *turning))

    def measured_at(self, world: "World", end: End) -> tuple[Condition, ...]:
        """Evaluate the tilt and, for an aligned axis, its rates."""
        found = super().measured_at(world, end)
        if self.angle:
            return found
        turning = list(world.tip_angular_velocity), list(world.tip_angular_acceleration)
        return (*found, *self._resting(list(world.tip_rotation), *turning))

    def _held(self, rotation: Sequence[Any]) -> tuple[Condition, ...]:
        if not self.angle:
            return super()._held(rotation)
        axis, direction = self.directions
        cosine = [along(direction, [along(axis, row) for row in rotation])]
        bounds = np.full(1, np.cos(self.angle)), np.full(1, np.inf)
        return (Condition("tilt cosine", "1", cosine, *bounds, "angle"),)

    def _resting(self, rotation: Sequence[Any], omega: Sequence[Any], alpha: Sequence[Any]) -> tuple[Condition, ...]:
        """Return the rates of the axis u orthogonal to the direction, from ``w x u`` and ``a x u + w x (w x u)``."""
        axis, _ = self.directions
        u = [along(axis, row) for row in rotation]
        rate = _cross(omega, u)
        second = [a + b for a, b in zip(_cross(alpha, u), _cross(omega, rate), strict=True)]
        zero, rows = np.zeros(2), self.across
        return (
            Condition("tilt rate", "rad/s", [along(row, rate) for row in rows], zero, zero, "velocity"),
            Condition("tilt acceleration", "rad/s^2", [along(row, second) for row in rows], zero, zero, "acceleration"),
        )


def _cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
