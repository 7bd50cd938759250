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
    """A box.

    Its numbers are the position, half its edge lengths, and its rotation matrix if it
    is rotated.
    """

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

    def _bounds(self, top: Any) -> tuple[Array, Array]:
        """Return lower and upper corners [m], shape (..., 3), at heights of the upper face, shape (...)."""
        low = top - (self.height or UNBOUNDED_OBSTACLE_HEIGHT_M)
        ends = (self.x.low, self.y.low, low), (self.x.high, self.y.high, top)
        first, second = (np.stack(np.broadcast_arrays(*end), axis=-1) for end in ends)
        return first, second

    def polytope(self) -> tuple[Array, float]:
        """See ``ObstacleShape``."""
        height = self.height or UNBOUNDED_OBSTACLE_HEIGHT_M
        edges = self.x.high - self.x.low, self.y.high - self.y.low, height
        return CUBE * edges, 0.0

    def solid(self, numbers: Array) -> Solid:
        """See ``ObstacleShape``."""
        low, high = self._bounds(numbers[0])
        center = (low + high) / 2
        corners, _ = self.polytope()
        # The mean of both faces would be rounded as a depth without lower end is.
        center[2] = high[2] - corners[-1, 2]
        return Box(center, corners, low, high)

    def place(
        self, numbers: Array, center: Array, rotation: Array, size: Array
    ) -> None:
        """See ``SizedShape``."""
        del rotation  # is a unit
        low, high = self._bounds(numbers[:, 0])
        center[:], size[:] = (low + high) / 2, (high - low) / 2

    def symbolic(self, values: Any, makers: Any) -> Any:
        """See ``ObstacleShape``."""
        (top,) = values
        low = None if self.height is None else top - self.height
        sides = [(side.low, side.high) for side in (self.x, self.y)]
        return makers.upright([*sides, (low, top)])

    depths = BoxShape.depths
