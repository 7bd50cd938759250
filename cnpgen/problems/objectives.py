"""Objectives of motions: the duration plus weighted terms, each the integral over time of the size of residuals.

Training, refining and reports use the same residuals. Further terms come from installed
packages, as constraints do.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from cnpgen.documents import NamedErrors
from cnpgen.errors import RecipeError, UsageError, nearest
from cnpgen.schema import registry
from cnpgen.schema.arguments import concerning
from cnpgen.schema.keys import RecipeLocation, field
from cnpgen.schema.parsing import parse

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.linalg import Vec
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState

OWN_OBJECTIVE = "time"  # the duration and the terms of the problem file
MIN_SQUARED_TIP_SPEED_M2_S2 = 1e-4  # defines the direction of a tip at rest


@dataclass(frozen=True, kw_only=True)
class ObjectiveTerm(ABC):
    """Term of the objective: weight times the integral over time of the size of residuals.

    A kind is a frozen dataclass whose fields are the keys of its ``[[objective.term]]``
    table in ``problem.toml``. It is registered under a name in cnpgen's registry or by
    a package's entry point in the group ``cnpgen.objectives``.

    The size is the sum of the squares of the residuals, or with a smoothing s their
    norm, ``sqrt(sum + s^2) - s``, which is quadratic below s, so that its gradient is
    continuous.

    Attributes:
        unit: Unit of the integral.
        smoothing: Smoothing of the norm in the unit of the residuals; 0 for the sum of
            squares.
        training_smoothing: The same in training; None for ``smoothing``.
        uses_jerk: Whether the residuals use the jerk.
        weight: Weight relative to the time.
    """

    unit: ClassVar[str]
    smoothing: ClassVar[float] = 0.0
    training_smoothing: ClassVar[float | None] = None
    uses_jerk: ClassVar[bool] = False

    weight: float = field("weight relative to the time", low=0.0, default=1.0)

    @abstractmethod
    def residuals(self, state: SymbolicState) -> Vec:
        """Return the residuals of a state, SX scalars."""

    def training_residuals(self, state: SymbolicState) -> Vec:
        """Return residuals of the same size that are cheaper in training.

        By default ``residuals``.
        """
        return self.residuals(state)


@dataclass(frozen=True, kw_only=True)
class Centrifugal(ObjectiveTerm):
    """Centrifugal acceleration ``|kappa| v^2`` of the tip (paper, Appendix B, eta).

    Weight in s^2/m.
    """

    unit = "m/s"
    smoothing = 0.5
    training_smoothing = 0.05

    def residuals(self, state: SymbolicState) -> Vec:
        """Return the acceleration of the tip across its velocity, of norm kappa v^2 [m/s^2]."""
        from cnpgen.kernels.symbolic.linalg import dot

        v = state.tip_velocity
        a = state.tip_acceleration
        # a - v (v . a) / |v|^2 is the part of a across v; the constant avoids a
        # division by zero at rest.
        along = dot(v, a) / (sum(x * x for x in v) + MIN_SQUARED_TIP_SPEED_M2_S2)
        return [y - along * x for x, y in zip(v, a, strict=True)]

    def training_residuals(self, state: SymbolicState) -> Vec:
        """Return ``v x a / |v|`` with the acceleration by the recursion of the inverse dynamics."""
        import casadi as ca

        from cnpgen.kernels.symbolic.linalg import cross, dot

        v = state.tip_velocity
        # |v x a| / |v| is the norm of the part of a across v, so that both forms have
        # the same size.
        across = cross(v, state.recursive_tip_acceleration)
        speed = ca.sqrt(dot(v, v) + MIN_SQUARED_TIP_SPEED_M2_S2)
        return [x / speed for x in across]


@dataclass(frozen=True, kw_only=True)
class Effort(ObjectiveTerm):
    """Squares of the joint torques as fractions of their limits; with [drive] those of the motors, without dry friction."""

    unit = "s"

    def residuals(self, state: SymbolicState) -> Vec:
        """Return the torques of the inverse dynamics, or of the motors, as fractions of their planning limits."""
        robot = state.robot
        drive = robot.drive
        # With drives, the motors' torques are compared with the motors' limits.
        limits = robot.torque_limit if drive is None else drive.torque_limit
        return [
            tau / float(limit)
            for tau, limit in zip(state.linear_torque, limits, strict=True)
        ]


@dataclass(frozen=True, kw_only=True)
class Jerk(ObjectiveTerm):
    """Squares of the joint jerks as fractions of their limits."""

    unit = "s"
    uses_jerk = True

    def residuals(self, state: SymbolicState) -> Vec:
        """Return the jerks as fractions of their planning limits."""
        return [
            x / float(limit)
            for x, limit in zip(state.jerk or (), state.robot.jerk_limit, strict=True)
        ]


@dataclass(frozen=True, kw_only=True)
class PathLength(ObjectiveTerm):
    """Length of the path of the tip; weight in s/m."""

    unit = "m"
    smoothing = 0.01

    def residuals(self, state: SymbolicState) -> Vec:
        """Return the velocity of the tip [m/s]."""
        return state.tip_velocity


@dataclass(frozen=True, kw_only=True)
class TipReference(ObjectiveTerm):
    """Squared distance of the tip from a reference curve; weight in 1/m^2."""

    unit = "m^2 s"
    points: tuple[tuple[float, ...], ...] = field(
        "corners of the curve, a polyline in the world frame", unit="m"
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if len(self.points) < 2 or any(len(point) != 3 for point in self.points):
            yield "points", "expected at least 2 points of 3 coordinates each"
        elif any(
            first == second
            for first, second in zip(self.points, self.points[1:], strict=False)
        ):
            yield "points", "two successive points are equal"

    def residuals(self, state: SymbolicState) -> Vec:
        """Return the vector from the nearest point of the curve to the tip [m]."""
        import casadi as ca

        from cnpgen.kernels.symbolic.linalg import dot

        tip = state.kinematics.tip
        best: Any = None
        nearest: Vec = []
        for first, second in zip(self.points, self.points[1:], strict=False):
            along = [b - a for a, b in zip(first, second, strict=True)]
            offset = [x - a for x, a in zip(tip, first, strict=True)]
            # Nearest point of a segment: a + t d with t = (x - a) . d / |d|^2, clipped
            # to [0, 1].
            fraction = ca.fmin(
                ca.fmax(dot(offset, along) / dot(along, along), 0.0), 1.0
            )
            point = [a + fraction * d for a, d in zip(first, along, strict=True)]
            distance = sum((x - y) ** 2 for x, y in zip(tip, point, strict=True))
            if best is None:
                best = distance
                nearest = point
                continue
            # The nearest point of all segments so far, selected without branches, as SX
            # needs it.
            nearest = [
                ca.if_else(distance < best, x, y)
                for x, y in zip(point, nearest, strict=True)
            ]
            best = ca.fmin(best, distance)
        # The nearest point is constant for derivatives: the gradient of the distance is
        # the same (envelope theorem).
        return [x - state.freeze(y) for x, y in zip(tip, nearest, strict=True)]


def read_objective(text: str) -> tuple[ObjectiveTerm, ...] | None:
    """Read an objective such as ``"effort"``, ``"effort=0.5"`` or ``"time=2, effort=1, jerk=0.1"``.

    Args:
        text: ``OWN_OBJECTIVE`` or empty for the objective of the problem, or names of
            terms with weights, 1 by default. The weight of the duration, ``time``,
            divides the others.

    Returns:
        The terms in addition to the duration; None for those of the problem.

    Raises:
        UsageError: A name or a weight is invalid.
    """
    if text.strip() in {"", OWN_OBJECTIVE}:
        return None
    weights: dict[str, float] = {}
    with concerning("objective"):
        for part in text.split(","):
            name, _, value = (word.strip() for word in part.partition("="))
            weights[name] = _weight(name, value) if "=" in part else 1.0
        time = weights.pop(OWN_OBJECTIVE, 1.0)
        if time == 0:
            raise UsageError(
                "the weight of time must be above 0: without it motions may be arbitrarily slow"
            )
        # w T + sum w_i J_i and T + sum (w_i / w) J_i have the same minimum.
        return tuple(_term(name, weight / time) for name, weight in weights.items())


def _weight(name: str, text: str) -> float:
    try:
        weight = float(text)
    except ValueError:
        # Text that is no number has the error of a negative number.
        weight = -1.0
    if not 0 <= weight < float("inf"):
        raise UsageError(
            f"the weight of {name!r} must be a number that is not negative, got {text!r}"
        )
    return weight


def _term(name: str, weight: float) -> ObjectiveTerm:
    known = (OWN_OBJECTIVE, *registry.names(registry.OBJECTIVES))
    if name not in known:
        expected = f"expected one of {', '.join(known)}{nearest(name, known)}"
        raise UsageError(f"objective {name!r} does not exist: {expected}")
    errors: list[str] = []
    try:
        term: Any = parse(
            registry.load(registry.OBJECTIVES, name),
            {"weight": weight},
            where=RecipeLocation(name),
            errors=errors,
        )
    except RecipeError as error:
        raise UsageError(str(error)) from error
    if term is None:
        raise UsageError(
            f"{'; '.join(errors)}: write the term as [[objective.term]] in the problem file"
        )
    found: ObjectiveTerm = term
    return found
