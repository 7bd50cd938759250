"""Signed distances of convex bodies, measured by Coal and certified.

The separation along the direction that Coal returns can be computed independently, and
it is a lower bound of the signed distance. No failure of Coal can therefore
overestimate a distance.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.convex_solid import Solid
from cnpgen.robots.shape.hull import coal_hull

# Rotation matrix of shape (3, 3), and origin [m], shape (3,).
Pose = tuple[Array, Array]

# Tolerances of GJK and EPA. With both at 1e-9, EPA fails for 2 % of the overlaps of a
# hull and a round shape; with the first pair 50,000 distances of hulls and boxes are
# exact to 1e-9 m. The others are for cases that the first one fails.
GJK_EPA_TOLERANCES = ((1e-9, 1e-6), (1e-6, 1e-6), (1e-6, 1e-4))
MAX_CERTIFICATE_GAP_M = 1e-6  # between a measured distance and its certificate
MAX_BLOCK_PRODUCTS = 65_536  # of corners and directions, per temporary array
MIN_CELL_CORNERS = 256  # of a body whose corners are searched by cells of directions
CELLS = 4  # from the middle of a face of the cube of directions to its edge


@dataclass(frozen=True)
class ConvexBody:
    """A convex body: the hull of its corners, extended by a radius.

    Attributes:
        corners: Corners of the hull [m], shape (V, 3).
        radius: Radius that is added to the hull [m].
        equivalent: Coal shape that is measured in place of the hull; None for the hull
            itself.
    """

    corners: Array
    radius: float
    equivalent: Any = None

    @cached_property
    def shape(self) -> Any:
        """Coal shape of the hull, built when a distance is first measured."""
        return coal_hull(self.corners) if self.equivalent is None else self.equivalent

    def support(self, pose: Pose, direction: Array) -> float:
        """Evaluate the support function along a unit vector of shape (3,), from the origin of the world [m]."""
        rotation, origin = pose
        return float(
            (self.corners @ (direction @ rotation)).max()
            + self.radius
            + direction @ origin
        )

    def lowest_products(self, directions: Array) -> Array:
        """Return the smallest product of the corners with each of K unit vectors, shape (3, K).

        Hulls of meshes have thousands of corners, of which few can be the lowest along
        similar directions. So directions are rounded to cells of a cube, and each cell
        keeps its candidates.
        """
        if len(self.corners) < MIN_CELL_CORNERS or not np.isfinite(directions).all():
            return lowest_products(self.corners, directions)
        lowest = np.empty(directions.shape[1])
        scaled = CELLS / np.abs(directions).max(axis=0, initial=0.5)
        cells = np.rint(directions * scaled).astype(int)
        codes = np.array([1, 64, 4096]) @ (cells + CELLS)
        for code in np.unique(codes).tolist():
            (members,) = np.nonzero(codes == code)
            if (corners := self._candidates.get(code)) is None:
                corners = self._lowest_in_cell(cells[:, members[0]])
                self._candidates[code] = corners
            lowest[members] = lowest_products(corners, directions[:, members])
        return lowest

    @cached_property
    def _candidates(self) -> dict[int, Array]:
        """Cell of directions -> corners that are the lowest along one of them."""
        return {}

    def _lowest_in_cell(self, cell: Array) -> Array:
        """Return the corners that can be the lowest along a direction that is rounded to a cell, shape (V', 3).

        Such a unit vector d differs from the cell's own u by at most e = sqrt(1/2) /
        CELLS: the cell is at least CELLS from the origin. With the lowest corner c* of
        u, d (c - c*) >= u (c - c*) - e |c - c*|, so c is never the lowest if this is
        positive.
        """
        direction = cell / np.linalg.norm(cell)
        heights = self.corners @ direction
        apart = np.linalg.norm(self.corners - self.corners[heights.argmin()], axis=1)
        # The factor covers rounding.
        reach = 1.001 * np.sqrt(0.5) / CELLS * apart
        return np.asarray(self.corners[heights - heights.min() <= reach])


def lowest_products(corners: Array, directions: Array) -> Array:
    """Return the smallest product of N corners with each of K directions, shape (K,), in blocks for the cache."""
    size = max(MAX_BLOCK_PRODUCTS // max(directions.shape[1], 1), 1)
    lowest = (corners[:size] @ directions).min(axis=0)
    for first in range(size, len(corners), size):
        np.minimum(
            lowest, (corners[first : first + size] @ directions).min(axis=0), out=lowest
        )
    return np.asarray(lowest)


PlacedBody = tuple[ConvexBody, Pose]


def convex_body(corners: Array, radius: float = 0.0) -> ConvexBody:
    """Return the body of all points within ``radius`` of the hull of ``corners``.

    Bodies of links are cached.
    """
    return _cached_body(corners.tobytes(), radius)


@lru_cache(maxsize=512)
def _cached_body(corners: bytes, radius: float) -> ConvexBody:
    points = np.frombuffer(corners).reshape(-1, 3)
    return ConvexBody(points, radius)


def placed_solid(solid: Solid) -> PlacedBody:
    """Return an obstacle as a body with its pose."""
    return convex_body(solid.corners, solid.radius), (np.eye(3), solid.position)


class CertifiedDistance:
    """Measures pairs of convex bodies.

    It reuses Coal's memory: use it in one process and one thread only.
    """

    def __init__(self) -> None:
        import coal

        self._requests = [coal.DistanceRequest() for _ in GJK_EPA_TOLERANCES]
        for request, (gjk, epa) in zip(self._requests, GJK_EPA_TOLERANCES, strict=True):
            request.gjk_tolerance = gjk
            request.epa_tolerance = epa
        self._result = coal.DistanceResult()
        self._transforms = (coal.Transform3s(), coal.Transform3s())

    def between(
        self, a: ConvexBody, pose_a: Pose, b: ConvexBody, pose_b: Pose
    ) -> tuple[float, Array]:
        """Measure a signed distance [m]: minus the penetration depth if the bodies overlap.

        Returns:
            The distance, and the unit vector of shape (3,) from a to b along which the
            bodies have this distance; minus infinity and a vector of nan if Coal finds
            no direction.
        """
        import coal

        for (rotation, origin), transform in zip(
            (pose_a, pose_b), self._transforms, strict=True
        ):
            transform.setRotation(rotation)
            transform.setTranslation(origin)
        best = -np.inf
        normal = np.full(3, np.nan)
        # From the strictest to the loosest tolerances, until one result agrees with its
        # certificate.
        for request in self._requests:
            self._result.clear()
            measured = coal.distance(
                a.shape,
                self._transforms[0],
                b.shape,
                self._transforms[1],
                request,
                self._result,
            )
            direction = np.array(self._result.normal)
            # Separation along the direction: min over b of n . x minus max over a of n
            # . x.
            certified = -b.support(pose_b, -direction) - a.support(pose_a, direction)
            if certified > best:
                # False for nan, which means that there is no direction
                best = certified
                normal = direction
            if abs(measured - a.radius - b.radius - certified) <= MAX_CERTIFICATE_GAP_M:
                break
        return best, normal

    def witnesses(self) -> tuple[Array, Array]:
        """Return the closest points of the two hulls that were measured last [m], shape (3,) each."""
        return np.array(self._result.getNearestPoint1()), np.array(
            self._result.getNearestPoint2()
        )
