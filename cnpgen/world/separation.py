"""Lower bounds of the signed distance between moving convex bodies and boxes that stand still.

The signed distance of two convex bodies (minus their depth, where they overlap) is the maximum over unit vectors u of
their separation ``min over a of u . a - max over b of u . b``: any u gives a lower bound. Box faces and the body's own
faces are tried on all states at once; better vectors come from measurements (``cnpgen.world.sweep``).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Box:
    """A box along the world's axes.

    Attributes:
        low: Its lowest corner [m], shape (3,).
        high: Its highest corner [m], shape (3,).
    """

    low: Array
    high: Array


def separation(vertices: Array, box: Box, direction: Array) -> Array:
    """Compute how far a convex body is from a box along a direction, at every state [m].

    Args:
        vertices: Its vertices [m], shape (V, 3, K).
        box: The box.
        direction: Unit vector from the box to the body, shape (3,).

    Returns:
        Shape (K,).
    """
    return np.asarray((direction @ vertices).min(axis=0) - _furthest(box, direction))


def cuboid_separation(position: Array, rotation: Array, size: Array, box: Box, direction: Array) -> Array:
    """Compute how far a cuboid is from a box along a direction, at every state [m].

    Args:
        position: The cuboid's centre [m], shape (3, K).
        rotation: Its rotation matrices, shape (3, 3, K).
        size: Its edge lengths [m], shape (3,).
        box: The box.
        direction: Unit vector from the box to the cuboid, shape (3,).

    Returns:
        Shape (K,).
    """
    reach = (size / 2) @ np.abs(np.einsum("i,ijk->jk", direction, rotation))
    return np.asarray(direction @ position - reach - _furthest(box, direction))


def _furthest(box: Box, direction: Array) -> float:
    """How far a box reaches along a direction [m]."""
    return float(np.where(direction > 0, box.high, box.low) @ direction)


def gaps(low: Array, high: Array, box: Box) -> Array:
    """Bound the distance of what lies between two corners from a box.

    Where there are gaps along several axes, the distance is at least the length of the vector that they form.

    Args:
        low: The body's lowest coordinates [m], shape (3, K).
        high: Its highest ones.
        box: The box.

    Returns:
        Shape (K,).
    """
    gap = np.maximum(low - box.high[:, None], box.low[:, None] - high)
    apart = np.maximum(gap, 0.0)
    distance = np.sqrt(np.einsum("ik,ik->k", apart, apart))
    return np.asarray(np.where(distance > 0, distance, gap.max(axis=0)))


def cuboid_gaps(position: Array, rotation: Array, size: Array, box: Box) -> Array:
    """Bound the signed distance of a cuboid from a box by the faces of both.

    Args:
        position: The cuboid's centre [m], shape (3, K).
        rotation: Its rotation matrices, shape (3, 3, K).
        size: Its edge lengths [m], shape (3,).
        box: The box.

    Returns:
        Shape (K,).
    """
    turned = np.abs(rotation)
    reach = np.einsum("ijk,j->ik", turned, size / 2)  # of the cuboid along the world's axes
    middle, half = (box.low + box.high) / 2, (box.high - box.low) / 2
    centre = np.einsum("ijk,ik->jk", rotation, position - middle[:, None])  # in the cuboid's axes
    own = np.abs(centre) - (size / 2)[:, None] - np.einsum("ijk,i->jk", turned, half)
    return np.asarray(np.maximum(gaps(position - reach, position + reach, box), own.max(axis=0)))
