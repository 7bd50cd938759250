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
from cnpgen.robots.shape.hull import coal_hull
from cnpgen.robots.solid import Solid

# Rotation matrix of shape (3, 3), and origin [m], shape (3,).
Pose = tuple[Array, Array]

# Tolerances of GJK and EPA. With both at 1e-9, EPA fails for 2 % of the overlaps of a
# hull and a round shape; with the first pair 50,000 distances of hulls and boxes are
# exact to 1e-9 m. The others are for cases that the first one fails.
GJK_EPA_TOLERANCES = ((1e-9, 1e-6), (1e-6, 1e-6), (1e-6, 1e-4))
MAX_CERTIFICATE_GAP_M = 1e-6  # between a measured distance and its certificate


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
            request.gjk_tolerance, request.epa_tolerance = gjk, epa
        self._result, self._transforms = (
            coal.DistanceResult(),
            (coal.Transform3s(), coal.Transform3s()),
        )

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
        best, normal = -np.inf, np.full(3, np.nan)
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
                best, normal = certified, direction
            if abs(measured - a.radius - b.radius - certified) <= MAX_CERTIFICATE_GAP_M:
                break
        return best, normal

    def witnesses(self) -> tuple[Array, Array]:
        """Return the closest points of the two hulls that were measured last [m], shape (3,) each."""
        return np.array(self._result.getNearestPoint1()), np.array(
            self._result.getNearestPoint2()
        )
