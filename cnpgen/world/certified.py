"""Signed distances of convex bodies: measured by Coal, and certified.

Whatever direction Coal says two bodies are apart in, how far they are apart along it can be computed, and is a lower
bound of their signed distance. So no failure of Coal's makes bodies look further apart than they are.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.shape.hull import coal_hull

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # rotation matrix of shape (3, 3), and origin [m], shape (3,)

# Tolerances of GJK and EPA. With both at 1e-9, EPA fails for 2 % of the overlaps of a hull and a round shape; with the
# first pair 50,000 distances of hulls and boxes are exact to 1e-9 m. The second is for what the first cannot solve.
TOLERANCES = ((1e-9, 1e-6), (1e-6, 1e-6), (1e-6, 1e-4))
CERTAIN = 1e-6  # m: what is measured and what is certified may differ by this much


@dataclass(frozen=True)
class Body:
    """A convex body.

    Attributes:
        corners: Corners of its hull [m], shape (V, 3).
        radius: How thick the hull is wrapped [m].
        shape: The hull as Coal's.
    """

    corners: Array
    radius: float
    shape: Any

    def furthest(self, pose: Pose, direction: Array) -> float:
        """How far it reaches along a unit vector of shape (3,), from the world's origin [m]."""
        turn, at = pose
        return float((self.corners @ (direction @ turn)).max() + self.radius + direction @ at)


def body(corners: Array, radius: float = 0.0) -> Body:
    """Return the body of all points within ``radius`` of the hull of ``corners``."""
    return Body(corners, radius, coal_hull(corners))


class CertifiedDistance:
    """Measures pairs of bodies. One process, one thread: Coal's memory is reused."""

    def __init__(self) -> None:
        import coal

        self._requests = [coal.DistanceRequest() for _ in TOLERANCES]
        for request, (gjk, epa) in zip(self._requests, TOLERANCES, strict=True):
            request.gjk_tolerance, request.epa_tolerance = gjk, epa
        self._result, self._places = coal.DistanceResult(), (coal.Transform3s(), coal.Transform3s())

    def between(self, a: Body, pose_a: Pose, b: Body, pose_b: Pose) -> tuple[float, Array]:
        """Measure a signed distance [m]: minus the depth where the bodies overlap.

        Returns:
            The distance, and the unit vector of shape (3,) in which b is that far away from a; a vector of nan, and
            minus infinity, if Coal finds none.
        """
        import coal

        for (turn, at), place in zip((pose_a, pose_b), self._places, strict=True):
            place.setRotation(turn)
            place.setTranslation(at)
        best, away = -np.inf, np.full(3, np.nan)
        for request in self._requests:
            self._result.clear()
            found = coal.distance(a.shape, self._places[0], b.shape, self._places[1], request, self._result)
            direction = np.array(self._result.normal)
            certified = -b.furthest(pose_b, -direction) - a.furthest(pose_a, direction)
            if certified > best:  # where there is no direction it is nan, which is not
                best, away = certified, direction
            if abs(found - a.radius - b.radius - certified) <= CERTAIN:
                break
        return best, away

    def witnesses(self) -> tuple[Array, Array]:
        """Return the points at which the two cores measured last are nearest to each other [m], shape (3,) each."""
        return np.array(self._result.getNearestPoint1()), np.array(self._result.getNearestPoint2())
