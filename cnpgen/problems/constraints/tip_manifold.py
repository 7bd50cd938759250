"""The tip on a point, a line or a plane of the world: what ``table``, ``plane``, ``line`` and ``pose`` have in common.

A manifold is an orthonormal frame at a point, of whose directions some are held: along those the tip stays at the
point, and where a motion begins or ends it moves and accelerates along the others only (paper, Appendix B, for the
table).
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.constraint import Condition, Constraint, End
from cnpgen.schema.keys import Range

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.state import SymbolicState
    from cnpgen.world.state import World

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Vectors = Sequence[Sequence[float]]  # numbers of Python, which are multiplied with one at a time
FUNNEL = (0.1, 0.3)  # phases between which a motion that starts off the manifold must come to it


@dataclass(frozen=True)
class Place:
    """Where the tip must be.

    Attributes:
        point: A point of the manifold [m], shape (3,).
        held: Unit vectors along which the tip stays at the point, k of them.
        bounded: Unit vectors along which it stays in a range, m of them, orthogonal to the others.
        ranges: Those ranges, measured from the point [m], m of them.
    """

    point: Array
    held: Vectors
    bounded: Vectors = ()
    ranges: tuple[Range, ...] = ()

    @cached_property
    def height(self) -> Array:
        """Where the tip is held along each of ``held``, measured from the world's origin [m], shape (k,)."""
        return np.asarray(np.array(self.held) @ self.point)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Between which it stays along each of ``bounded``, measured likewise [m], shape (m,) each."""
        origin = np.array(self.bounded) @ self.point
        low, high = (np.array([getattr(each, end) for each in self.ranges]) for end in ("low", "high"))
        return origin + low, origin + high


@dataclass(frozen=True, kw_only=True)
class TipManifold(Constraint):
    """The tip at a place; kinds say which."""

    inside_name: ClassVar[str]
    held_name: ClassVar[str]
    velocity_name: ClassVar[str]
    acceleration_name: ClassVar[str]
    parts: ClassVar[tuple[tuple[str, ...], tuple[str, ...]]] = ((), ())

    @property
    @abstractmethod
    def place(self) -> Place:
        """Where the tip must be; kinds keep it, since it is asked for at every state."""

    @property
    def band(self) -> float:
        """How far off the manifold a motion may start [m]."""
        return 0.0

    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State where the tip is [m]."""
        return self._position(state.kinematics.tip, 0.0)

    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Evaluate Pinocchio's tip position [m]."""
        return self._position(list(world.tip_position), 0.0)

    def symbolic_at(self, state: "SymbolicState", end: End) -> tuple[Condition, ...]:
        """State position, velocity and acceleration of a boundary state."""
        position = self._position(state.kinematics.tip, self._band_at(end))
        return (*position, *self._moving(state.tip_velocity, state.tip_acceleration))

    def measured_at(self, world: "World", end: End) -> tuple[Condition, ...]:
        """Evaluate position, velocity and acceleration with Pinocchio."""
        position = self._position(list(world.tip_position), self._band_at(end))
        return (*position, *self._moving(list(world.tip_velocity), list(world.tip_acceleration)))

    def funnel(self, condition: Condition, s: Array, start_tip: Array) -> Array:
        """Let a motion that starts off the manifold reach it: ``start_off`` until s = 0.1, nothing from s = 0.3 on."""
        if condition.name != self.held_name:
            return super().funnel(condition, s, start_tip)
        open_: Array = np.minimum(np.maximum((FUNNEL[1] - s) / (FUNNEL[1] - FUNNEL[0]), 0.0), 1.0)
        return self.start_off(start_tip)[..., None] * open_

    def start_off(self, start_tip: Array) -> Array:
        """Return how far off the manifold motions may begin [m]: as far as they do, up to ``band``.

        Args:
            start_tip: Positions of the tip at the start [m], shape (..., 3).
        """
        place = self.place
        pairs = zip(place.held, place.height, strict=True)
        off = reduce(np.maximum, [np.abs(along(row, start_tip.T).T - height) for row, height in pairs])
        return np.asarray(np.minimum(off, self.band))

    def _position(self, tip: Sequence[Any], band: float) -> tuple[Condition, ...]:
        place = self.place
        found = []
        if place.ranges:
            g = [along(row, tip) for row in place.bounded]
            found.append(Condition(self.inside_name, "m", g, *place.bounds, "position", self.parts[0]))
        if place.held:
            low, high = place.height - band, place.height + band
            g = [along(row, tip) for row in place.held]
            found.append(Condition(self.held_name, "m", g, low, high, "position", self.parts[1]))
        return tuple(found)

    def _band_at(self, end: End) -> float:
        return self.band if end == "start" else 0.0

    def _moving(self, velocity: Sequence[Any], acceleration: Sequence[Any]) -> tuple[Condition, ...]:
        """State that the tip moves along the manifold only."""
        held, parts = self.place.held, self.parts[1]
        if not held:
            return ()
        zero = np.zeros(len(held))
        rates = [[along(row, values) for row in held] for values in (velocity, acceleration)]
        return (
            Condition(self.velocity_name, "m/s", rates[0], zero, zero, "velocity", parts),
            Condition(self.acceleration_name, "m/s^2", rates[1], zero, zero, "acceleration", parts),
        )


def along(direction: Sequence[float], vector: Sequence[Any] | Array) -> Any:
    """Return the component along a unit vector of a vector of SX scalars, numbers or arrays; no term is 0."""
    total = None
    for share, value in zip(direction, vector, strict=True):
        if share:
            term = value if share == 1 else share * value
            total = term if total is None else total + term
    return total


def unit(vector: Sequence[float] | Array, what: str) -> Array:
    """Return a vector divided by its length.

    Raises:
        ValueError: It has none.
    """
    given = np.array(vector, float)
    length = np.linalg.norm(given)
    if not (np.isfinite(length) and length > 1e-9):
        raise ValueError(f"{what} must be a direction, which {tuple(vector)} is not")
    return np.asarray(given if length == 1 else given / length)


def beside(direction: Array) -> Array:
    """Return two unit vectors orthogonal to a unit vector and to each other, shape (2, 3); x and y beside z."""
    first = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = first - direction * (direction @ first)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])
