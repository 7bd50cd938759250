"""Distances of the robot and of what it holds from the obstacles, measured by Coal."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from cnpgen.robots.spec import Obstacle

Array = NDArray[np.float64]
Point = Sequence[float]

# Coal's default tolerance of 1e-6 shows up in full in distances just above contact. With these, 20 000 segments and
# 20 000 upright boxes (aligned, touching, 1e-12 m apart, inside) agree with the exact distance to 4e-11 m, which is
# 1e-10 of the boxes' size: so much larger Coal makes a box when GJK's direction is parallel to a face.
GJK_TOLERANCE = 1e-12
EPA_TOLERANCE = 1e-9
ENDLESS = 10.0  # m, height of the box that stands for an obstacle without a lower end


class Scene:
    """The obstacles, the segments of a robot and the held object as Coal shapes.

    A segment is a capsule of radius 0, so that Coal's distance is that of the segment itself. GJK is the plain one, not
    its Nesterov variant, which reports contacts that are none. One process, one thread: shapes are moved in place.

    Args:
        obstacles: The boxes of the world.
        object_size: Edge lengths of the held object [m], or None.
        n_segments: Number of the robot's segments.
    """

    def __init__(
        self, obstacles: "Sequence[Obstacle]", object_size: tuple[float, float, float] | None, n_segments: int
    ) -> None:
        import coal

        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()
        self._request.gjk_tolerance, self._request.epa_tolerance = GJK_TOLERANCE, EPA_TOLERANCE
        self._heights = [float(box.height or ENDLESS) for box in obstacles]
        self._boxes = [
            coal.Box(box.x.high - box.x.low, box.y.high - box.y.low, height)
            for box, height in zip(obstacles, self._heights, strict=True)
        ]
        self._middles = [((box.x.low + box.x.high) / 2, (box.y.low + box.y.high) / 2) for box in obstacles]
        self._places = [coal.Transform3s() for _ in obstacles]
        self._capsules = [coal.Capsule(0.0, 1.0) for _ in range(n_segments)]
        self._object = None if object_size is None else coal.Box(*object_size)
        self._mover = coal.Transform3s()
        self._from_capsule = [self._measures(capsule) for capsule in self._capsules]
        self._from_object = [] if self._object is None else self._measures(self._object)

    def _measures(self, shape: Any) -> list[Any]:
        import coal

        return [coal.ComputeDistance(shape, box) for box in self._boxes]

    def set_tops(self, tops: Point) -> None:
        """Move every obstacle up or down.

        Args:
            tops: Heights of the upper faces [m], one per obstacle.
        """
        for place, (x, y), height, top in zip(self._places, self._middles, self._heights, tops, strict=True):
            place.setTranslation(np.array([x, y, top - height / 2]))

    def segment_distances(self, segments: Sequence[tuple[Point, Point]]) -> list[float]:
        """Measure the signed distance of every segment from every obstacle, segment by segment [m].

        Args:
            segments: Both ends of each segment [m].
        """
        distances: list[float] = []
        for index, (a, b) in enumerate(segments):
            self._place_segment(index, a, b)
            distances += self._measure(self._from_capsule[index])
        return distances

    def segment_apart(self, a: Point, b: Point, obstacle: int) -> tuple[float, Array]:
        """Measure the signed distance of one segment from one obstacle.

        Args:
            a: One end of the segment [m].
            b: Its other end [m].
            obstacle: Index of the obstacle.

        Returns:
            The distance [m], minus the depth where they overlap, and the unit vector of shape (3,) along which they are
            apart, from the obstacle to the segment.
        """
        self._place_segment(0, a, b)
        return self._apart(self._from_capsule[0], obstacle)

    def _place_segment(self, index: int, a: Point, b: Point) -> None:
        (ax, ay, az), (bx, by, bz) = a, b
        along = bx - ax, by - ay, bz - az
        length = math.hypot(*along)
        self._capsules[index].halfLength = length / 2
        self._mover.setRotation(_frame_along(along, length))
        self._mover.setTranslation(np.array([(ax + bx) / 2, (ay + by) / 2, (az + bz) / 2]))

    def object_distances(self, position: Array, rotation: Array) -> list[float]:
        """Measure the signed distance of the held object from every obstacle [m], minus the depth where they overlap.

        Args:
            position: Centre of the object [m], shape (3,).
            rotation: Its rotation matrix, shape (3, 3).
        """
        self._mover.setRotation(rotation)
        self._mover.setTranslation(position)
        return self._measure(self._from_object)

    def object_apart(self, position: Array, rotation: Array, obstacle: int) -> tuple[float, Array]:
        """Measure the signed distance of the held object from one obstacle.

        Args:
            position: Centre of the object [m], shape (3,).
            rotation: Its rotation matrix, shape (3, 3).
            obstacle: Index of the obstacle.

        Returns:
            The distance [m], minus the depth where they overlap, and the unit vector of shape (3,) along which they are
            apart, from the obstacle to the object.
        """
        self._mover.setRotation(rotation)
        self._mover.setTranslation(position)
        return self._apart(self._from_object, obstacle)

    def _apart(self, measures: list[Any], obstacle: int) -> tuple[float, Array]:
        self._result.clear()
        distance = measures[obstacle](self._mover, self._places[obstacle], self._request, self._result)
        return distance, -np.array(self._result.normal)

    def _measure(self, measures: list[Any]) -> list[float]:
        """Distances of the shape that ``_mover`` places from every obstacle [m]."""
        distances = []
        for measure, place in zip(measures, self._places, strict=True):
            self._result.clear()  # Coal keeps the smallest distance that a result has seen
            distances.append(measure(self._mover, place, self._request, self._result))
        return distances


def _frame_along(vector: Point, length: float) -> Array:
    """Return a rotation matrix whose third column is a vector's direction (Duff et al. 2017, JCGT 6(1))."""
    if length == 0.0:
        return np.eye(3)
    x, y, z = vector[0] / length, vector[1] / length, vector[2] / length
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, b, x], [sign * b, sign + y * y * a, y], [-sign * x, -y, z]])
