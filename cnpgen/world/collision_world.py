"""Distances of the robot's segments and of the held object from the obstacles, measured by Coal."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.convex_solid import Box, Solid, same_shape
from cnpgen.robots.shape.hull import CUBE, frame_along
from cnpgen.world.certified import CertifiedDistance, ConvexBody, Pose, convex_body

Point = Sequence[float]

# Coal's default tolerance of 1e-6 shows up in full in distances just above contact.
# With these, 20 000 segments and 20 000 upright boxes (aligned, touching, at a distance
# of 1e-12 m, inside) agree with the exact distance to 4e-11 m, which is 1e-10 of the
# boxes' size: Coal enlarges a box by that much when GJK's direction is parallel to a
# face.
GJK_TOLERANCE = 1e-12
EPA_TOLERANCE = 1e-9
_AXIS = np.array([[0, 0, -0.5], [0, 0, 0.5]])  # ends of a segment of length 1


class CollisionWorld:
    """The obstacles, the segments of a robot and the held object as Coal shapes.

    A segment is a capsule of radius 0, so that Coal's distance is that of the segment
    itself. GJK runs without Nesterov acceleration, which reports contacts that do not
    exist. Distances from upright boxes are Coal's; those from other obstacles are
    certified. Shapes are moved in place: use it in one process and one thread only.

    Args:
        object_size: Edge lengths of the held object [m], or None.
    """

    def __init__(self, object_size: tuple[float, float, float] | None) -> None:
        import coal

        self._request = coal.DistanceRequest()
        self._result = coal.DistanceResult()
        self._request.gjk_tolerance = GJK_TOLERANCE
        self._request.epa_tolerance = EPA_TOLERANCE
        self._certified = CertifiedDistance()
        self._capsule = coal.Capsule(0.0, 1.0)
        self._object = (
            None
            if object_size is None
            else ConvexBody(CUBE * np.array(object_size), 0.0, coal.Box(*object_size))
        )
        self._transform = coal.Transform3s()
        self._solids = list[Solid]()
        self._bodies = list[ConvexBody | None]()
        self._transforms = list[Any]()
        self._from_capsule = list[Any]()
        self._from_object = list[Any]()

    def place(self, solids: Sequence[Solid]) -> None:
        """Set the obstacles."""
        import coal

        # Obstacles of the same shapes keep their functors of Coal: only their positions
        # change.
        same = len(solids) == len(self._solids) and all(
            map(same_shape, solids, self._solids)
        )
        self._solids = list(solids)
        if not same:
            self._transforms = [coal.Transform3s() for _ in solids]
            sizes = [
                np.ptp(solid.corners, axis=0) if isinstance(solid, Box) else None
                for solid in solids
            ]
            self._boxes = [None if size is None else coal.Box(*size) for size in sizes]
            self._bodies = [
                None
                if isinstance(solid, Box)
                else convex_body(solid.corners, solid.radius)
                for solid in solids
            ]
            self._from_capsule = self._measures(self._capsule)
            self._from_object = (
                [] if self._object is None else self._measures(self._object.shape)
            )
        for transform, solid in zip(self._transforms, solids, strict=True):
            transform.setTranslation(solid.position)

    def _measures(self, shape: Any) -> list[Any]:
        """Return Coal's distance functors of a shape and every obstacle.

        None for certified distances.
        """
        import coal

        return [box and coal.ComputeDistance(shape, box) for box in self._boxes]

    def segment_distances(self, segments: Sequence[tuple[Point, Point]]) -> list[float]:
        """Measure the signed distance of every segment, two ends, from every obstacle, segment by segment [m]."""
        distances: list[float] = []
        for a, b in segments:
            self._place_segment(a, b)
            distances += self._measure(self._from_capsule)
        return distances

    def segment_distance(
        self, a: Point, b: Point, obstacle: int
    ) -> tuple[float, Array]:
        """Measure the signed distance of the segment from a to b [m] from one obstacle.

        Returns:
            The distance [m], minus the penetration depth if they overlap, and the
            separating unit vector from the obstacle to the segment, shape (3,).
        """
        self._place_segment(a, b)
        return self._distance_and_normal(self._from_capsule, obstacle)

    def _place_segment(self, a: Point, b: Point) -> None:
        (ax, ay, az), (bx, by, bz) = a, b
        # A capsule of length |b - a| along z, turned to the segment.
        along = bx - ax, by - ay, bz - az
        length = math.hypot(*along)
        self._capsule.halfLength = length / 2
        pose = (
            frame_along(along, length),
            np.array([(ax + bx) / 2, (ay + by) / 2, (az + bz) / 2]),
        )
        self._place(ConvexBody(length * _AXIS, 0.0, self._capsule), pose)

    def _place(self, mover: ConvexBody, pose: Pose) -> None:
        self._mover = mover
        self._pose = pose
        self._transform.setRotation(pose[0])
        self._transform.setTranslation(pose[1])

    def object_distances(self, position: Array, rotation: Array) -> list[float]:
        """Measure the signed distance of the held object from every obstacle [m], negative if they overlap."""
        self._place_object(position, rotation)
        return self._measure(self._from_object)

    def object_distance(
        self, position: Array, rotation: Array, obstacle: int
    ) -> tuple[float, Array]:
        """Measure the signed distance of the held object from one obstacle.

        See ``segment_distance``.
        """
        self._place_object(position, rotation)
        return self._distance_and_normal(self._from_object, obstacle)

    def _place_object(self, position: Array, rotation: Array) -> None:
        if self._object is not None:
            self._place(self._object, (rotation, position))

    def _distance_and_normal(
        self, measures: list[Any], obstacle: int
    ) -> tuple[float, Array]:
        distance = self._distance(measures, obstacle)
        # Coal's normal points from the first shape, here the segment, to the obstacle.
        return distance, self._normal if measures[obstacle] is None else -np.array(
            self._result.normal
        )

    def _measure(self, measures: list[Any]) -> list[float]:
        """Measure the distances of the placed body from every obstacle [m]."""
        return [self._distance(measures, obstacle) for obstacle in range(len(measures))]

    def _distance(self, measures: list[Any], obstacle: int) -> float:
        measure = measures[obstacle]
        body = self._bodies[obstacle]
        if body is not None:
            pose = np.eye(3), self._solids[obstacle].position
            distance, self._normal = self._certified.between(
                body, pose, self._mover, self._pose
            )
            return distance
        # Otherwise Coal keeps the smallest distance of earlier calls.
        self._result.clear()
        return float(
            measure(
                self._transform, self._transforms[obstacle], self._request, self._result
            )
        )
