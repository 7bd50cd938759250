"""Lower bounds of the signed distance between moving convex bodies and obstacles.

The signed distance of two convex bodies (minus the penetration depth if they overlap) is the maximum over unit vectors
u of their separation ``min over a of u . a - max over b of u . b``: any u gives a lower bound. Faces of the boxes and
of the body are evaluated at all states at once; better directions come from measurements
(``cnpgen.world.pair_distances``).

Cuboids have centers [m], shape (3, K), rotation matrices, shape (3, 3, K), and edge lengths [m], shape (3,).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.solid import Solid

Array = NDArray[np.float64]


def separation(vertices: Array, solid: Solid, direction: Array) -> Array:
    """Compute the separation of a convex body from a solid along a direction, at every state [m], shape (K,).

    Vertices of the body [m] have shape (V, 3, K); the direction is a unit vector from the solid to the body.
    """
    return np.asarray((direction @ vertices).min(axis=0) - solid.furthest(direction))


def cuboid_separation(position: Array, rotation: Array, size: Array, solid: Solid, direction: Array) -> Array:
    """Compute the separation of a cuboid from a solid along a unit vector to it, at every state [m], shape (K,)."""
    reach = (size / 2) @ np.abs(np.einsum("i,ijk->jk", direction, rotation))
    return np.asarray(direction @ position - reach - solid.furthest(direction))


def gaps(low: Array, high: Array, solids: Sequence[Solid]) -> Array:
    """Bound the distances of axis-aligned boxes from S solids [m], shape (..., S, K).

    If there are gaps along several axes, the distance is at least the length of the vector that they form. Lowest and
    highest coordinates of the boxes [m] have shape (..., 3, K).
    """
    floor, top = _boxes(solids)
    gap = np.maximum(low[..., None, :, :] - top[..., None], floor[..., None] - high[..., None, :, :])
    outside = np.maximum(gap, 0.0)
    distance = np.sqrt((outside * outside).sum(axis=-2))
    return np.asarray(np.where(distance > 0, distance, gap.max(axis=-2)))


def cuboid_gaps(position: Array, rotation: Array, size: Array, solids: Sequence[Solid]) -> Array:
    """Bound the signed distances of a cuboid from S solids by its faces and their bounding boxes [m], shape (S, K)."""
    turned, (floor, top) = np.abs(rotation), _boxes(solids)
    reach = np.einsum("ijk,j->ik", turned, size / 2)  # of the cuboid along the world axes
    offset = position - (floor + top)[..., None] / 2
    center = np.einsum("ijk,sik->sjk", rotation, offset)  # in the frame of the cuboid
    own = np.abs(center) - (size / 2)[:, None] - np.einsum("ijk,si->sjk", turned, (top - floor) / 2)
    return np.asarray(np.maximum(gaps(position - reach, position + reach, solids), own.max(axis=1)))


def _boxes(solids: Sequence[Solid]) -> tuple[Array, Array]:
    """Return the lowest and the highest coordinates of S solids [m], shape (S, 3) each."""
    low, high = ([getattr(solid, end) for solid in solids] for end in ("low", "high"))
    return np.array(low).reshape(-1, 3), np.array(high).reshape(-1, 3)
