"""Boxes: upright ones given by ranges, and those with a pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.robots.obstacle_shapes.convex_solid import Box, Solid, solid_around
from cnpgen.robots.obstacle_shapes.obstacle_shape import (
    SizedShape,
)
from cnpgen.robots.shape.hull import CUBE
from cnpgen.schema.keys import Range, field

# Height of the box that represents an obstacle without a lower end.
UNBOUNDED_OBSTACLE_HEIGHT_M = 10.0


@dataclass(frozen=True, kw_only=True)
class BoxShape(SizedShape):
    """A box; its numbers are the position, half its edge lengths, and its rotation matrix if it is rotated."""

    size: Vector3 = field("edge lengths", unit="m", low=1e-6)

    widths = (6, 15)

    def polytope(self) -> tuple[Array, float]:
        """See ``ObstacleShape``."""
        return CUBE * self.size, 0.0

    @classmethod
    def numbers(cls, position: Array, size: Array, rotation: Array) -> Array:
        """See ``ObstacleShape``."""
        return np.concatenate([position, size / 2, rotation.reshape(-1, 9)], axis=1)

    def solid(self, numbers: Array) -> Solid:
        """See ``ObstacleShape``."""
        corners = 2 * CUBE * numbers[3:6]
        turn = numbers[6:].reshape(-1, 3).T
        return solid_around(numbers[:3], corners @ turn if turn.size else corners)

    def place(
        self, numbers: Array, center: Array, rotation: Array, size: Array
    ) -> None:
        """See ``SizedShape``."""
        center[:] = numbers[:, :3]
        size[:] = numbers[:, 3:6]
        if numbers.shape[1] > 6:
            rotation[:] = numbers[:, 6:].reshape(-1, 3, 3)

    def symbolic(self, values: Any, makers: Any) -> Any:
        """See ``ObstacleShape``."""
        return makers.box(values[3:6], values[:3], values[6:])

    @staticmethod
    def depths(local: Array, size: Array) -> Array:
        """See ``SizedShape``."""
        return np.asarray((size - local).min(axis=-1))

    def coal(self) -> Any:
        """See ``ObstacleShape``."""
        import coal

        return coal.Box(*self.size)


@dataclass(frozen=True, kw_only=True)
class UprightBox(SizedShape):
    """A box along the world's axes, given by ranges; its number is the height of its upper face."""

    x: Range  # extents [m]
    y: Range
    height: float | None  # without a lower end if None [m]

    height_place = 0
    widths = (1, 1)

    @property
    def _edges(self) -> Array:
        height = self.height or UNBOUNDED_OBSTACLE_HEIGHT_M
        return np.array([self.x.high - self.x.low, self.y.high - self.y.low, height])

    def polytope(self) -> tuple[Array, float]:
        """See ``ObstacleShape``."""
        return CUBE * self._edges, 0.0

    def solid(self, numbers: Array) -> Solid:
        """See ``ObstacleShape``."""
        (top,) = numbers
        x, y = (self.x.low + self.x.high) / 2, (self.y.low + self.y.high) / 2
        center = np.array([x, y, top - self._edges[2] / 2])
        low = np.array([self.x.low, self.y.low, top - self._edges[2]])
        high = np.array([self.x.high, self.y.high, top])
        return Box(center, self.polytope()[0], low, high)

    def place(
        self, numbers: Array, center: Array, rotation: Array, size: Array
    ) -> None:
        """See ``SizedShape``."""
        del rotation  # is a unit
        top = numbers[:, 0]
        low = top - self._edges[2]
        center[:, :2] = (self.x.low + self.x.high) / 2, (self.y.low + self.y.high) / 2
        center[:, 2] = (low + top) / 2
        size[:] = self._edges / 2
        size[:, 2] = (top - low) / 2

    def symbolic(self, values: Any, makers: Any) -> Any:
        """See ``ObstacleShape``."""
        (top,) = values
        low = None if self.height is None else top - self.height
        sides = [(side.low, side.high) for side in (self.x, self.y)]
        return makers.upright([*sides, (low, top)])

    depths = BoxShape.depths
