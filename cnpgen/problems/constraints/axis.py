"""Constraints that align an axis of the tip with a world direction, exactly or within an angle."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.problems.constraints.constraint import (
    Condition,
    Conditions,
    Constraint,
    End,
)
from cnpgen.problems.constraints.tip_manifold import along, beside, unit
from cnpgen.robots.parameter_ranges import UPRIGHT_TOLERANCE
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.world.world import World


@dataclass(frozen=True, kw_only=True)
class TipAxis(Constraint):
    """Base class: the tip's axis a is along the world direction d: ``e1 . R a = e2 . R a = 0`` and ``d . R a > 0``.

    e1 and e2 are orthogonal to d: ``1 - d . R a`` has no gradient at the solution. The
    two values are the components of the tilt [rad] to first order. The verdict limits
    the angle between both, so the tolerance of each component is that of the angle
    divided by the square root of 2.

    Parameters of the problem may turn d and change the tolerance. Vectors are then
    along axes that turn with d, and the tilt of motions is multiplied by the ratio of
    the tolerances, so that the bounds are the same for all samples.
    """

    reads = ()
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

    @property
    def nominal_tolerance(self) -> float:
        """Value of the parameter ``upright_tolerance`` of samples without it [rad]."""
        return self.tolerance

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the tilt [rad]."""
        return self._held(self._symbolic_axis(state), state.parameters)

    def measured(self, world: "World") -> Conditions:
        """Evaluate the tilt of Pinocchio's tip frame [rad]."""
        return self._held(self._measured_axis(world), world.parameters.values)

    def symbolic_at(self, state: "SymbolicState", end: End) -> Conditions:  # noqa: ARG002
        """State the tilt of a boundary state [rad], in radians for all samples."""
        return self._held(self._symbolic_axis(state), {})

    def measured_at(self, world: "World", end: End) -> Conditions:  # noqa: ARG002
        """Evaluate the tilt of a boundary state [rad], in radians for all samples."""
        return self._held(self._measured_axis(world), {})

    def judged(self, world: "World") -> Conditions:
        """Evaluate the angle between axis and direction [rad]."""
        # Without parameters the tilt is in rad: the verdict limits the angle, not its
        # multiple.
        tilt, upright = self._held(self._measured_axis(world), {})
        # atan2(|sine|, cosine): accurate at all angles, unlike the arccosine near 1.
        angle = np.arctan2(np.hypot(*tilt.g), upright.g[0])
        tolerance = world.parameters.values.get(UPRIGHT_TOLERANCE)
        accepted = None if tolerance is None else np.array([float(tolerance)])
        return (
            replace(
                tilt,
                g=[angle],
                lower=np.zeros(1),
                upper=np.zeros(1),
                parts=(),
                accepted=accepted,
            ),
        )

    def allowed(self, condition: Condition) -> Array:
        """Return the tolerance of the angle, or of each of its components."""
        if condition.accepted is not None:
            return condition.accepted
        # Each of k equal components may be the angle divided by sqrt(k).
        return np.asarray(super().allowed(condition) / np.sqrt(len(condition.g)))

    def _symbolic_axis(self, state: "SymbolicState") -> list[Any]:
        # R a, the axis in the world, along axes that turn with the direction.
        axis, _ = self.directions
        return state.along_upright(
            [along(axis, row) for row in state.kinematics.rotation]
        )

    def _measured_axis(self, world: "World") -> list[Any]:
        axis, _ = self.directions
        return list(
            world.parameters.along_upright(
                [along(axis, row) for row in world.tip_rotation]
            )
        )

    def _held(
        self, pointing: Sequence[Any], parameters: Mapping[str, Any]
    ) -> Conditions:
        """State the tilt of an axis, which is given along axes that turn with the direction."""
        # e1 . R a and e2 . R a: sines of the tilt.
        tilt = [along(row, pointing) for row in self.across]
        if (tolerance := parameters.get(UPRIGHT_TOLERANCE)) is not None:
            # In units of the nominal tolerance: a sample with half of it has twice the
            # values.
            tilt = [value * (self.tolerance / tolerance) for value in tilt]
        # d . R a > 0 excludes the axis that points the opposite way, where both sines
        # are zero, too.
        upright = [along(self.directions[1], pointing)]
        return (
            Condition(
                "tilt", "rad", tilt, np.zeros(2), np.zeros(2), "angle", ("x", "y")
            ),
            Condition(
                "upright", "1", upright, np.zeros(1), np.full(1, np.inf), "angle"
            ),
        )


@dataclass(frozen=True, kw_only=True)
class Axis(TipAxis):
    """Constraint: a tip axis is within an angle of a direction, or aligned with it and at rest at the ends."""

    reason = "tool tilted"
    axis: Vector3 = field(
        "axis in the tip frame, of any length", default=(0.0, 0.0, 1.0)
    )
    direction: Vector3 = field(
        "direction in the world, of any length", default=(0.0, 0.0, 1.0)
    )
    angle: float = field(
        "maximum angle between axis and direction",
        unit="rad",
        default=0.0,
        low=0.0,
        high=1.5,
    )
    tolerance: float = field(
        "additional angle that a valid motion may have",
        unit="rad",
        low=1e-9,
        plausible=1.0,
    )

    def __post_init__(self) -> None:
        """Check both directions; ValueError if one is zero or not finite."""
        unit(self.axis, "axis")
        unit(self.direction, "direction")

    @cached_property
    def directions(self) -> tuple[list[float], list[float]]:
        """The axis in the tip's frame and the direction in the world, unit vectors."""
        return unit(self.axis, "axis").tolist(), unit(
            self.direction, "direction"
        ).tolist()

    @property
    def nominal_tolerance(self) -> float:
        """Value of the parameter ``upright_tolerance`` of samples without it [rad]."""
        # A cone is limited by its angle, an aligned axis by its tolerance.
        return self.angle or self.tolerance

    def allowed(self, condition: Condition) -> Array:
        """Return the tolerance of motions; with an angle, that of its cosine."""
        if not self.angle or condition.accepted is not None:
            return super().allowed(condition)
        return np.full(len(condition.g), self._cosine_tolerance(self.angle))

    def judged(self, world: "World") -> Conditions:
        """Evaluate the angle between axis and direction [rad], or its cosine for a range of angles."""
        if not self.angle:
            return super().judged(world)
        (condition,) = self._held(self._measured_axis(world), {})
        angle = world.parameters.values.get(UPRIGHT_TOLERANCE)
        if angle is None:
            return (condition,)
        return (
            replace(
                condition,
                lower=np.cos([angle]),
                accepted=np.array([self._cosine_tolerance(angle)]),
            ),
        )

    def symbolic_at(self, state: "SymbolicState", end: End) -> Conditions:
        """State the tilt and, for an aligned axis, its rates."""
        # The axis may move within its cone at the ends, so that its rates are free.
        if self.angle:
            return self.symbolic(state)
        turning = map(
            state.along_upright,
            (state.tip_angular_velocity, state.tip_angular_acceleration),
        )
        return (
            *super().symbolic_at(state, end),
            *self._resting(self._symbolic_axis(state), *turning),
        )

    def measured_at(self, world: "World", end: End) -> Conditions:
        """Evaluate the tilt and, for an aligned axis, its rates."""
        if self.angle:
            return self.measured(world)
        turning = map(
            world.parameters.along_upright,
            (world.tip_angular_velocity, world.tip_angular_acceleration),
        )
        return (
            *super().measured_at(world, end),
            *self._resting(self._measured_axis(world), *map(list, turning)),
        )

    def _held(
        self, pointing: Sequence[Any], parameters: Mapping[str, Any]
    ) -> Conditions:
        if not self.angle:
            return super()._held(pointing, parameters)
        # d . R a >= cos(angle): the cosine is linear in R, the angle is not smooth at
        # zero.
        cosine = along(self.directions[1], pointing)
        least = np.cos(self.angle)
        if (angle := parameters.get(UPRIGHT_TOLERANCE)) is not None:
            # Affine in the cosine, so that bound and accepted violation map to those of
            # the problem.
            ratio = self._cosine_tolerance(self.angle) / self._cosine_tolerance(angle)
            cosine = least + (cosine - _cosine(angle)) * ratio
        return (
            Condition(
                "tilt cosine",
                "1",
                [cosine],
                np.full(1, least),
                np.full(1, np.inf),
                "angle",
            ),
        )

    def _cosine_tolerance(self, angle: Any) -> Any:
        """Return by how much the cosine of a valid tilt may be below that of an angle; ``angle`` may be a symbol."""
        return _cosine(angle) - _cosine(angle + self.tolerance)

    def _resting(
        self, u: Sequence[Any], omega: Sequence[Any], alpha: Sequence[Any]
    ) -> Conditions:
        """Return the rates of the axis u orthogonal to the direction, from ``w x u`` and ``a x u + w x (w x u)``."""
        from cnpgen.kernels.symbolic.linalg import add, cross

        # du/dt = w x u; its derivative a x u + w x (w x u) is the acceleration of the
        # axis.
        rate = cross(omega, u)
        second = add(cross(alpha, u), cross(omega, rate))
        zero = np.zeros(2)
        rows = self.across
        return (
            Condition(
                "tilt rate",
                "rad/s",
                [along(row, rate) for row in rows],
                zero,
                zero,
                "velocity",
            ),
            Condition(
                "tilt acceleration",
                "rad/s^2",
                [along(row, second) for row in rows],
                zero,
                zero,
                "acceleration",
            ),
        )


@dataclass(frozen=True, kw_only=True)
class Vertical(TipAxis):
    """Constraint: the tip's z axis points up, a special case of ``axis``: ``R_02 = R_12 = 0`` and ``R_22 > 0``.

    It is the vertical-orientation manifold of the paper's heavy object (Appendix B).
    """

    reason = "not vertical"
    tolerance: float = field(
        "tilt that a valid motion may have", unit="rad", low=1e-9, plausible=1.0
    )

    @cached_property
    def directions(self) -> tuple[list[float], list[float]]:
        """Return both z axes."""
        return [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]


def _cosine(angle: Any) -> Any:
    """Return the cosine of an angle, -1 above a half turn.

    ``angle`` may be a symbol.
    """
    import casadi as ca

    return (
        # Beyond a half turn the cosine would rise again, and a larger angle would be
        # stricter.
        np.cos(min(angle, np.pi))
        if isinstance(angle, float)
        else ca.cos(ca.fmin(angle, np.pi))
    )
