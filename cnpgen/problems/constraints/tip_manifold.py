"""Base of ``table``, ``plane``, ``line`` and ``pose``: the tip on a point, a line or a plane of the world.

A manifold is an orthonormal frame at a point with some fixed directions. Along these
the tip stays at the point. At its ends, a motion has velocity and acceleration along
the other directions only (paper, Appendix B, for the table).
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from cnpgen.arrays import Array
from cnpgen.problems.constraints.constraint import (
    Condition,
    Conditions,
    Constraint,
    End,
)
from cnpgen.schema.keys import Range

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.world.world import World

Vectors = Sequence[Sequence[float]]  # Python floats, used in scalar products
# Phases between which a motion that starts off the manifold must reach it.
BOUND_KINKS = 0.1, 0.3


@dataclass(frozen=True)
class TipRegion:
    """Region of the tip: a manifold with ranges.

    Attributes:
        point: A point of the manifold [m], shape (3,).
        held: Unit vectors along which the tip stays at the point, k of them.
        bounded: Unit vectors along which it stays in a range, m of them, orthogonal to
            the others.
        ranges: Ranges relative to the point [m], m of them.
    """

    point: Array
    held: Vectors
    bounded: Vectors = ()
    ranges: tuple[Range, ...] = ()

    @cached_property
    def height(self) -> Array:
        """Coordinates along each of ``held``, relative to the world's origin [m], shape (k,)."""
        return np.asarray(np.array(self.held) @ self.point)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Bounds along each of ``bounded``, relative to the world's origin [m], shape (m,) each."""
        origin = np.array(self.bounded) @ self.point
        low, high = (
            np.array([getattr(each, end) for each in self.ranges])
            for end in ("low", "high")
        )
        # Ranges are relative to the point; bounds have the coordinates of the world.
        return origin + low, origin + high


@dataclass(frozen=True, kw_only=True)
class TipManifold(Constraint):
    """Base class: the tip stays in a region that subclasses define."""

    reads = ()
    training_weight = 1e4  # one weight for position and orientation of a pose

    inside_name: ClassVar[str]
    held_name: ClassVar[str]
    velocity_name: ClassVar[str]
    acceleration_name: ClassVar[str]
    parts: ClassVar[tuple[tuple[str, ...], tuple[str, ...]]] = ((), ())
    # Whether parameters of the problem move it.
    moves_with_table: ClassVar[bool] = False

    @property
    @abstractmethod
    def place(self) -> TipRegion:
        """Region of the tip; subclasses cache it, since it is used at every state."""

    @property
    def band(self) -> float:
        """Maximum distance of a start from the manifold [m]: the key ``start_band`` of kinds that have it."""
        return float(getattr(self, "start_band", 0.0))

    def symbolic(self, state: "SymbolicState") -> Conditions:
        """State the tip position [m]."""
        return self._position(self._symbolic_tip(state), 0.0, state.parameters)

    def measured(self, world: "World") -> Conditions:
        """Evaluate Pinocchio's tip position [m]."""
        return self._position(self._measured_tip(world), 0.0, world.parameters.values)

    def symbolic_at(self, state: "SymbolicState", end: End) -> Conditions:
        """State position, velocity and acceleration of a boundary state."""
        position = self._position(
            self._symbolic_tip(state), self._band_at(end), state.parameters
        )
        rates = state.tip_velocity, state.tip_acceleration
        return (
            *position,
            *self._moving(
                *(map(state.along_table, rates) if self.moves_with_table else rates)
            ),
        )

    def measured_at(self, world: "World", end: End) -> Conditions:
        """Evaluate position, velocity and acceleration with Pinocchio."""
        position = self._position(
            self._measured_tip(world), self._band_at(end), world.parameters.values
        )
        rates = (world.tip_velocity, world.tip_acceleration)
        turned = world.parameters.along_table
        return (
            *position,
            *self._moving(*(map(turned, rates) if self.moves_with_table else rates)),
        )

    def _symbolic_tip(self, state: "SymbolicState") -> Sequence[Any]:
        tip = state.kinematics.tip
        return state.on_table(tip) if self.moves_with_table else tip

    def _measured_tip(self, world: "World") -> Sequence[Any]:
        tip = world.tip_position
        return list(world.parameters.on_table(tip) if self.moves_with_table else tip)

    def bound_relaxation(
        self, condition: Condition, s: Array, start_tip: Array
    ) -> Array:
        """Relax the bounds for a start off the manifold: by ``start_off`` until s = 0.1, by zero from s = 0.3 on."""
        # Ranges and rates hold from the start on.
        if condition.name != self.held_name:
            return super().bound_relaxation(condition, s, start_tip)
        # Linear between both kinks.
        open_: Array = np.minimum(
            np.maximum((BOUND_KINKS[1] - s) / (BOUND_KINKS[1] - BOUND_KINKS[0]), 0.0),
            1.0,
        )
        return self.start_off(start_tip)[..., None] * open_

    def start_off(self, start_tip: Array) -> Array:
        """Return the distances of starts, shape (..., 3), from the manifold, at most ``band`` [m]."""
        place = self.place
        pairs = zip(place.held, place.height, strict=True)
        # The largest of all fixed directions, which is a distance per direction.
        off = reduce(
            np.maximum,
            [np.abs(along(row, start_tip.T).T - height) for row, height in pairs],
        )
        return np.asarray(np.minimum(off, self.band))

    def _position(
        self, tip: Sequence[Any], band: float, parameters: Mapping[str, Any]
    ) -> Conditions:
        place = self.place
        found = []
        if place.ranges:
            found.append(self._inside(tip, parameters))
        if place.held:
            # row . p - height is the distance from the manifold along a fixed
            # direction.
            low = place.height - band
            high = place.height + band
            g = [along(row, tip) for row in place.held]
            found.append(
                Condition(self.held_name, "m", g, low, high, "position", self.parts[1])
            )
        return tuple(found)

    def _inside(self, tip: Sequence[Any], parameters: Mapping[str, Any]) -> Condition:  # noqa: ARG002
        """State the position within the ranges, which parameters of the problem may change."""
        g = [along(row, tip) for row in self.place.bounded]
        return Condition(
            self.inside_name, "m", g, *self.place.bounds, "position", self.parts[0]
        )

    def _band_at(self, end: End) -> float:
        return self.band if end == "start" else 0.0

    def _moving(
        self, velocity: Sequence[Any] | Array, acceleration: Sequence[Any] | Array
    ) -> Conditions:
        """State that the tip moves along the manifold only."""
        held = self.place.held
        parts = self.parts[1]
        # A region without fixed directions leaves the velocity free.
        if not held:
            return ()
        zero = np.zeros(len(held))
        rates = [
            [along(row, values) for row in held] for values in (velocity, acceleration)
        ]
        return (
            Condition(
                self.velocity_name, "m/s", rates[0], zero, zero, "velocity", parts
            ),
            Condition(
                self.acceleration_name,
                "m/s^2",
                rates[1],
                zero,
                zero,
                "acceleration",
                parts,
            ),
        )


def along(direction: Sequence[float], vector: Sequence[Any] | Array) -> Any:
    """Return the component along a unit vector of a vector of SX scalars, numbers or arrays; no term is 0."""
    total = None
    # Zero shares add no term: SX would keep the product.
    for share, value in zip(direction, vector, strict=True):
        if share:
            term = value if share == 1 else share * value
            total = term if total is None else total + term
    return total


def unit(vector: Sequence[float] | Array, what: str) -> Array:
    """Return a vector divided by its length.

    ValueError if that is zero or not finite.
    """
    given = np.array(vector, float)
    length = np.linalg.norm(given)
    if not (np.isfinite(length) and length > 1e-9):
        raise ValueError(f"{what} must be a direction, which {tuple(vector)} is not")
    # A vector of length 1 keeps its digits.
    return np.asarray(given if length == 1 else given / length)


def beside(direction: Array) -> Array:
    """Return two unit vectors orthogonal to a unit vector and to each other, shape (2, 3); x and y for z."""
    # The coordinate axis that is most orthogonal, made orthogonal (Gram-Schmidt).
    first = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = first - direction * (direction @ first)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])
