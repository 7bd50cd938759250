"""Spheres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.convex_solid import Solid, solid_around
from cnpgen.robots.obstacle_shapes.obstacle_shape import (
    SizedShape,
)
from cnpgen.schema.keys import field


@dataclass(frozen=True, kw_only=True)
class SphereShape(SizedShape):
    """A sphere.

    Its numbers are the position and the radius.
    """

    radius: float = field("radius", unit="m", low=1e-6)

    placement = ()
    widths = (4, 4)

    def polytope(self) -> tuple[Array, float]:
        """See ``ObstacleShape``."""
        return np.zeros((1, 3)), self.radius

    @classmethod
    def numbers(cls, position: Array, size: Array, rotation: Array) -> Array:  # noqa: ARG003
        """See ``ObstacleShape``."""
        return np.concatenate([position, size[:, :1]], axis=1)

    def solid(self, numbers: Array) -> Solid:
        """See ``ObstacleShape``."""
        return solid_around(numbers[:3], np.zeros((1, 3)), float(numbers[3]))

    def place(
        self, numbers: Array, center: Array, rotation: Array, size: Array
    ) -> None:
        """See ``SizedShape``."""
        del rotation  # has no effect
        center[:] = numbers[:, :3]
        size[:, 0] = numbers[:, 3]

    def symbolic(self, values: Any, makers: Any) -> Any:
        """See ``ObstacleShape``."""
        return makers.ball(values[:3], values[:3], values[3])

    @staticmethod
    def depths(local: Array, size: Array) -> Array:
        """See ``SizedShape``."""
        return np.asarray(size[..., 0] - np.linalg.norm(local, axis=-1))

    def coal(self) -> Any:
        """See ``ObstacleShape``."""
        import coal

        return coal.Sphere(self.radius)
