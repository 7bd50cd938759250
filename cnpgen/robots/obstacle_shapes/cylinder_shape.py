"""Cylinders, which judges replace by prisms round them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.capsule_shape import AxialShape
from cnpgen.robots.obstacle_shapes.convex_solid import Solid, solid_around
from cnpgen.robots.shape.hull import frame_along

# Of the prism that contains a cylinder; its corners exceed the radius by 0.12 %.
PRISM_SIDES = 64
_ANGLES = np.arange(PRISM_SIDES) * (2 * math.pi / PRISM_SIDES)
_UNIT_PRISM = np.array(
    [[math.cos(angle), math.sin(angle), z] for z in (-1.0, 1.0) for angle in _ANGLES]
)


@dataclass(frozen=True, kw_only=True)
class CylinderShape(AxialShape):
    """A cylinder.

    The radius among its numbers is that of the corners of the prism round it.
    """

    radius_share = math.cos(math.pi / PRISM_SIDES)

    def polytope(self) -> tuple[Array, float]:
        """See ``ObstacleShape``."""
        return _prism(self.radius / self.radius_share, self.length / 2), 0.0

    def solid(self, numbers: Array) -> Solid:
        """See ``ObstacleShape``."""
        half = float(np.linalg.norm(numbers[3:6]))
        turn = frame_along(numbers[3:6].tolist(), half)
        return solid_around(numbers[:3], _prism(float(numbers[6]), half) @ turn.T)

    def symbolic(self, values: Any, makers: Any) -> Any:
        """See ``ObstacleShape``."""
        return makers.cylinder(values[:3], values[3:6], values[6])

    @staticmethod
    def depths(local: Array, size: Array) -> Array:
        """See ``SizedShape``."""
        across = np.hypot(local[..., 0], local[..., 1])
        return np.minimum(size[..., 0] - across, size[..., 1] - local[..., 2])

    def coal(self) -> Any:
        """See ``ObstacleShape``."""
        import coal

        return coal.Cylinder(self.radius, self.length)


def _prism(outer: float, half: float) -> Array:
    """Return the corners of a prism along z by their distance from z and half its length [m], shape (2 sides, 3)."""
    return _UNIT_PRISM * [outer, outer, half]
