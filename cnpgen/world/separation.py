"""Lower bounds of the signed distance between moving convex bodies and what stands still.

The signed distance of two convex bodies (minus their depth, where they overlap) is the maximum over unit vectors u of
their separation ``min over a of u . a - max over b of u . b``: any u gives a lower bound. Box faces and the body's own
faces are tried on all states at once; better vectors come from measurements (``cnpgen.world.sweep``).
"""

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.solid import Solid

Array = NDArray[np.float64]


def separation(vertices: Array, solid: Solid, direction: Array) -> Array:
    """Compute how far a convex body is from what stands still along a direction, at every state [m].

    Args:
        vertices: Its vertices [m], shape (V, 3, K).
        solid: What stands still.
        direction: Unit vector from it to the body, shape (3,).

    Returns:
        Shape (K,).
    """
    return np.asarray((direction @ vertices).min(axis=0) - solid.furthest(direction))


def cuboid_separation(position: Array, rotation: Array, size: Array, solid: Solid, direction: Array) -> Array:
    """Compute how far a cuboid is from what stands still along a direction, at every state [m].

    Args:
        position: The cuboid's centre [m], shape (3, K).
        rotation: Its rotation matrices, shape (3, 3, K).
        size: Its edge lengths [m], shape (3,).
        solid: What stands still.
        direction: Unit vector from it to the cuboid, shape (3,).

    Returns:
        Shape (K,).
    """
    reach = (size / 2) @ np.abs(np.einsum("i,ijk->jk", direction, rotation))
    return np.asarray(direction @ position - reach - solid.furthest(direction))


def gaps(low: Array, high: Array, solid: Solid) -> Array:
    """Bound the distance of what lies between two corners from a solid.

    Where there are gaps along several axes, the distance is at least the length of the vector that they form.

    Args:
        low: The body's lowest coordinates [m], shape (3, K).
        high: Its highest ones.
        solid: What stands still.

    Returns:
        Shape (K,).
    """
    gap = np.maximum(low - solid.high[:, None], solid.low[:, None] - high)
    apart = np.maximum(gap, 0.0)
    distance = np.sqrt(np.einsum("ik,ik->k", apart, apart))
    return np.asarray(np.where(distance > 0, distance, gap.max(axis=0)))


def cuboid_gaps(position: Array, rotation: Array, size: Array, solid: Solid) -> Array:
    """Bound the signed distance of a cuboid from what stands still, by the faces of it and of the box that holds that.

    Args:
        position: The cuboid's centre [m], shape (3, K).
        rotation: Its rotation matrices, shape (3, 3, K).
        size: Its edge lengths [m], shape (3,).
        solid: What stands still.

    Returns:
        Shape (K,).
    """
    turned = np.abs(rotation)
    reach = np.einsum("ijk,j->ik", turned, size / 2)  # of the cuboid along the world's axes
    middle, half = (solid.low + solid.high) / 2, (solid.high - solid.low) / 2
    centre = np.einsum("ijk,ik->jk", rotation, position - middle[:, None])  # in the cuboid's axes
    own = np.abs(centre) - (size / 2)[:, None] - np.einsum("ijk,i->jk", turned, half)
    return np.asarray(np.maximum(gaps(position - reach, position + reach, solid), own.max(axis=0)))
