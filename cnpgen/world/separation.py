"""Lower bounds of the signed distance between moving convex bodies and what stands still.

The signed distance of two convex bodies (minus their depth, where they overlap) is the maximum over unit vectors u of
their separation ``min over a of u . a - max over b of u . b``: any u gives a lower bound. Box faces and the body's own
faces are tried on all states at once; better vectors come from measurements (``cnpgen.world.sweep``).
"""

from collections.abc import Sequence

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


def gaps(low: Array, high: Array, solids: Sequence[Solid]) -> Array:
    """Bound the distances of what lies between two corners from S solids.

    Where there are gaps along several axes, the distance is at least the length of the vector that they form.

    Args:
        low: The lowest coordinates of bodies [m], shape (..., 3, K).
        high: Their highest ones.
        solids: What stands still.

    Returns:
        Shape (..., S, K).
    """
    floor, top = _boxes(solids)
    gap = np.maximum(low[..., None, :, :] - top[..., None], floor[..., None] - high[..., None, :, :])
    apart = np.maximum(gap, 0.0)
    distance = np.sqrt((apart * apart).sum(axis=-2))
    return np.asarray(np.where(distance > 0, distance, gap.max(axis=-2)))


def cuboid_gaps(position: Array, rotation: Array, size: Array, solids: Sequence[Solid]) -> Array:
    """Bound the signed distances of a cuboid from S solids, by the faces of it and of the boxes that hold those.

    Args:
        position: The cuboid's centre [m], shape (3, K).
        rotation: Its rotation matrices, shape (3, 3, K).
        size: Its edge lengths [m], shape (3,).
        solids: What stands still.

    Returns:
        Shape (S, K).
    """
    turned, (floor, top) = np.abs(rotation), _boxes(solids)
    reach = np.einsum("ijk,j->ik", turned, size / 2)  # of the cuboid along the world's axes
    away = position - (floor + top)[..., None] / 2
    centre = np.einsum("ijk,sik->sjk", rotation, away)  # in the cuboid's axes
    own = np.abs(centre) - (size / 2)[:, None] - np.einsum("ijk,si->sjk", turned, (top - floor) / 2)
    return np.asarray(np.maximum(gaps(position - reach, position + reach, solids), own.max(axis=1)))


def _boxes(solids: Sequence[Solid]) -> tuple[Array, Array]:
    """Return the lowest and the highest coordinates of S solids [m], shape (S, 3) each."""
    low, high = ([getattr(each, end) for each in solids] for end in ("low", "high"))
    return np.array(low).reshape(-1, 3), np.array(high).reshape(-1, 3)
