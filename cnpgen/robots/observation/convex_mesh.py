"""Convex meshes of obstacles: faces for distances and rays, triangles for points on the surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cnpgen.robots.shape.hull import Array
from cnpgen.robots.shape.inline import corners_of

PLANE_DECIMALS = 9  # to which the planes of triangles of one face agree
MIN_AREA_M2 = 1e-12  # of a triangle; smaller ones have no normal in single precision
MAX_KEPT_MESHES = 256


@dataclass(frozen=True, eq=False)
class ConvexMesh:
    """The convex hull of corners, relative to the center of its bounding box.

    Attributes:
        center: Center of the bounding box in the frame of the mesh [m], shape (3,).
        half: Half the edge lengths of the bounding box [m], shape (3,).
        corners: The corners [m], shape (V, 3).
        triangles: Triangles of the surface: a corner and the edges to the two others [m], shape (T, 3, 3).
        planes: Outer unit normals n and offsets c of the faces, shape (F, 4): ``n @ x + c <= 0`` inside.
    """

    center: Array
    half: Array
    corners: Array
    triangles: Array
    planes: Array

    def distances(self, points: Array) -> Array:
        """Return the signed distances of points [m], shape (P, 3), negative inside, shape (P,)."""
        distances: Array = (points @ self.planes[:, :3].T + self.planes[:, 3]).max(axis=1)
        outside = distances > 0
        distances[outside] = np.sqrt(self._squared_distances(points[outside]))
        return distances

    def _squared_distances(self, points: Array) -> Array:
        """Return squared distances from the nearest triangle."""
        smallest = np.full(len(points), np.inf)
        for corner, first, second in self.triangles:
            normal = np.cross(first, second)
            ends = (corner, first), (corner + first, second - first), (corner + second, -second)
            offsets = [points - start for start, _ in ends]
            above = [offset @ np.cross(normal, edge) >= 0 for offset, (_, edge) in zip(offsets, ends, strict=True)]
            to_plane = (offsets[0] @ normal) ** 2 / (normal @ normal)
            to_edges = [_squared_from_segment(offset, edge) for offset, (_, edge) in zip(offsets, ends, strict=True)]
            squared = np.where(np.all(above, axis=0), to_plane, np.min(to_edges, axis=0))
            np.minimum(smallest, squared, out=smallest)
        return smallest

    def entries(self, origin: Array, rays: Array) -> Array:
        """Return where rays from an origin [m], shape (P, 3), enter, in ray lengths, shape (P,); nan for none."""
        enter, leave = np.full(len(rays), -np.inf), np.full(len(rays), np.inf)
        for plane in self.planes:
            speed = rays @ plane[:3]
            with np.errstate(all="ignore"):
                crossing = -(plane[:3] @ origin + plane[3]) / speed
            enter = np.where(speed < 0, np.fmax(enter, crossing), enter)
            leave = np.where(speed < 0, leave, np.fmin(leave, crossing))  # -inf for rays along a face, outside of it
        return np.where(enter <= leave, enter, np.nan)


def _squared_from_segment(offsets: Array, edge: Array) -> Array:
    """Return squared distances from a segment of points relative to its start, shape (P,)."""
    along = np.clip(offsets @ edge / (edge @ edge), 0, 1)
    return np.asarray(((offsets - along[:, None] * edge) ** 2).sum(axis=1))


@lru_cache(MAX_KEPT_MESHES)
def convex_mesh(address: str) -> ConvexMesh:
    """Return the mesh of an obstacle from its corners, a ``data:`` address (``cnpgen.robots.shape.inline``)."""
    from scipy.spatial import ConvexHull

    corners = corners_of(address)
    center, half = (corners.max(axis=0) + corners.min(axis=0)) / 2, np.ptp(corners, axis=0) / 2
    hull = ConvexHull(corners - center)
    first, second, third = (hull.points[index] for index in hull.simplices.T)
    planes = hull.equations[np.sort(np.unique(hull.equations.round(PLANE_DECIMALS), axis=0, return_index=True)[1])]
    triangles = np.stack([first, second - first, third - first], axis=1)
    areas = np.linalg.norm(np.cross(triangles[:, 1], triangles[:, 2]), axis=1) / 2
    return ConvexMesh(center, half, hull.points, triangles[areas > MIN_AREA_M2], planes)
