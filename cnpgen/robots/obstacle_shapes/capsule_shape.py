"""Capsules, and what all shapes round an axis share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.convex_solid import Solid, solid_around
from cnpgen.robots.obstacle_shapes.obstacle_shape import (
    SizedShape,
)
from cnpgen.robots.shape.hull import frames_along
from cnpgen.schema.keys import field


@dataclass(frozen=True, kw_only=True)
class AxialShape(SizedShape):
    """A shape round an axis; its numbers are the position, the vector to the end of the axis, and a radius."""

    radius: float = field("radius", unit="m", low=1e-6)
    length: float = field("length along the z axis", unit="m", low=1e-6)

    radius_share: ClassVar[float] = 1.0  # of the radius among the numbers

    widths = (7, 7)

    @classmethod
    def numbers(cls, position: Array, size: Array, rotation: Array) -> Array:
        """See ``ObstacleShape``."""
        half = size[:, 1:2] / 2 * rotation[..., 2]
        outer = size[:, :1] / cls.radius_share
        return np.concatenate([position, half, outer], axis=1)

    def place(
        self, numbers: Array, center: Array, rotation: Array, size: Array
    ) -> None:
        """See ``SizedShape``."""
        half = np.array([math.hypot(*vector) for vector in numbers[:, 3:6]])
        center[:] = numbers[:, :3]
        rotation[:] = frames_along(numbers[:, 3:6], half)
        size[:, 0] = numbers[:, 6]
        size[:, 1] = half


@dataclass(frozen=True, kw_only=True)
class CapsuleShape(AxialShape):
    """A capsule, whose length is that without its round ends."""

    def polytope(self) -> tuple[Array, float]:
        """See ``ObstacleShape``."""
        half = self.length / 2
        return np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), self.radius

    def solid(self, numbers: Array) -> Solid:
        """See ``ObstacleShape``."""
        ends = np.array([-numbers[3:6], numbers[3:6]])
        return solid_around(numbers[:3], ends, float(numbers[6]))

    def symbolic(self, values: Any, makers: Any) -> Any:
        """See ``ObstacleShape``."""
        return makers.capsule(values[:3], values[3:6], values[6])

    @staticmethod
    def depths(local: Array, size: Array) -> Array:
        """See ``SizedShape``."""
        across = np.hypot(local[..., 0], local[..., 1])
        beyond = np.maximum(local[..., 2] - size[..., 1], 0.0)
        return np.asarray(size[..., 0] - np.hypot(across, beyond))

    def coal(self) -> Any:
        """See ``ObstacleShape``."""
        import coal

        return coal.Capsule(self.radius, self.length)
