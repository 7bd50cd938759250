"""Convex bodies in the world, from which judges measure distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array


@dataclass(frozen=True)
class Solid:
    """Convex body in the world: all points within ``radius`` of the hull of ``corners``, translated by ``position``.

    Attributes:
        position: Position [m], shape (3,).
        corners: Corners of the hull relative to the position, in world axes [m], shape
            (V, 3).
        low: Lower corner of the bounding box [m], shape (3,).
        high: Upper corner of the bounding box [m], shape (3,).
        radius: Radius around the hull [m].
    """

    position: Array
    corners: Array
    low: Array
    high: Array
    radius: float = 0.0

    def furthest(self, direction: Array) -> float:
        """Return its extent along a unit vector of shape (3,), from the world's origin [m]."""
        return float(
            self.position @ direction + (self.corners @ direction).max() + self.radius
        )


class Box(Solid):
    """Box aligned with the world axes."""

    def furthest(self, direction: Array) -> float:
        """Return its extent along a unit vector; see ``Solid``."""
        # Support of a box: the corner in the direction, coordinate by coordinate.
        return float(np.where(direction > 0, self.high, self.low) @ direction)


def solid_around(position: Array, corners: Array, radius: float = 0.0) -> Solid:
    """Return the body with corners in world axes, shape (V, 3), and a radius [m], at a position [m]."""
    low = position + corners.min(axis=0) - radius
    high = position + corners.max(axis=0) + radius
    return Solid(position, corners, low, high, radius)


def same_shape(a: Solid, b: Solid) -> bool:
    """Return whether two bodies differ at most in their position."""
    return a is b or (
        type(a) is type(b)
        and a.radius == b.radius
        and np.array_equal(a.corners, b.corners)
    )
