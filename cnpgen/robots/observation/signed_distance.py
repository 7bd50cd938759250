"""Exact signed distances of points from boxes, spheres, cylinders, capsules and convex meshes."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.observation.primitives import Primitives

Array = NDArray[np.float64]

POINTS_PER_CHUNK = 65_536  # keeps the temporary arrays of one primitive in the cache


def signed_distances(primitives: Primitives, points: Array) -> Array:
    """Compute the signed distances of P world points from M primitives [m], negative inside, shape (M, P)."""
    distances = np.empty((len(primitives), len(points)))
    for index in range(len(primitives)):
        mesh, kind, size = primitives.mesh(index), int(primitives.kinds[index]), primitives.sizes[index]
        for first in range(0, len(points), POINTS_PER_CHUNK):
            part = slice(first, first + POINTS_PER_CHUNK)
            local = (points[part] - primitives.centers[index]) @ primitives.rotations[index]
            distances[index, part] = mesh.distances(local) if mesh else _distance(kind, size, local)
    return distances


def smallest_signed_distances(primitives: Primitives, points: Array) -> Array:
    """Compute the smallest signed distance of points from any primitive [m], shape (P,); inf without primitives."""
    smallest = np.full(len(points), np.inf)
    for index in range(len(primitives)):
        np.minimum(smallest, signed_distances(primitives[np.array([index])], points)[0], out=smallest)
    return smallest


def _distance(kind: int, size: Array, local: Array) -> Array:
    """Return the signed distances of points in the frame of a primitive, shape (P,)."""
    if kind == 0:
        return _outside_or_inside(np.abs(local) - size)
    radius, half = size[0], size[1]
    if kind == 2:
        radial = np.hypot(local[:, 0], local[:, 1]) - radius
        return _outside_or_inside(np.stack([radial, np.abs(local[:, 2]) - half], axis=1))
    along = np.clip(local[:, 2], -half, half)  # half is 0 for a sphere
    return np.asarray(np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2 + (local[:, 2] - along) ** 2) - radius)


def _outside_or_inside(gaps: Array) -> Array:
    """Return the distance from a product of intervals, or of a disc and an interval, from the gap along each."""
    outside = np.linalg.norm(np.maximum(gaps, 0), axis=1)
    return np.asarray(np.where(outside > 0, outside, gaps.max(axis=1)))
