"""Signed distances of the robot's capsules and of the held object from obstacles, as SX: one form per kind.

Sizes and poses are scalars: inputs of kernels. Nothing is called further away than it is. Distances of segments from
boxes, spheres and capsules are exact, from cylinders nearly so; meshes are within a box and behind planes. Where a
segment itself is inside, the depth is that of one of its points: in a cylinder the deepest one, in a box with a pose
the middle of what is inside.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cnpgen.kernels.symbolic.boxes import (
    ENDLESS,
    Bounds,
    cuboid_separation,
    segment_box_distance,
    segment_box_separation,
    signed_segment_box_distance,
    upright_box_separation,
)
from cnpgen.kernels.symbolic.linalg import Scalar, Vec, add, dot, scale, subtract
from cnpgen.kernels.symbolic.segments import POINT, segment_distance
from cnpgen.kernels.symbolic.state import SymbolicState
from cnpgen.robots.shape.hull import supporting_planes
from cnpgen.robots.shape.inline import corners_of
from cnpgen.robots.solid import number_slices

if TYPE_CHECKING:
    from cnpgen.robots.obstacle import Obstacle

Size = tuple[float, float, float]
Hold = Callable[[Scalar], Scalar]

HALVINGS = 6  # of a segment, after which its point nearest to a cylinder is known


class SymbolicSolid(ABC):
    """An obstacle as solvers see it."""

    @abstractmethod
    def separation(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Signed distance of a segment from the obstacle, or less [m].

        Args:
            first: One end [m].
            second: Other end [m].
            hold: Returns a value as a constant for differentiation.
        """

    def descent(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Signed distance of a segment in a form that is easier to descend [m]."""
        return self.separation(first, second, hold)

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Distance of a segment [m], where nothing but its size counts: it may have no gradient."""
        return self.separation(first, second, lambda value: value)

    @abstractmethod
    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Signed distance of a cuboid from the obstacle, or less [m].

        Args:
            centre: Centre of the cuboid [m].
            rotation: Rows of its rotation matrix.
            size: Edge lengths of the cuboid [m].
        """


@dataclass(frozen=True)
class UprightForm(SymbolicSolid):
    """A box along the world's axes, by ranges: all is exact, for cuboids that are upright.

    Attributes:
        bounds: Its bounds [m].
    """

    bounds: Bounds

    def separation(self, first: Vec, second: Vec, hold: Hold) -> Scalar:  # noqa: ARG002
        """Return the signed distance."""
        return segment_box_separation(first, second, self.bounds)

    def descent(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Return the distance or, inside, the depth of the middle of what is inside."""
        return signed_segment_box_distance(first, second, self.bounds, hold=hold)

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Return the distance, 0 where they touch."""
        return segment_box_distance(first, second, self.bounds)

    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Try the normals of the faces."""
        return upright_box_separation(centre, rotation, size, self.bounds)


@dataclass(frozen=True)
class BoxForm(SymbolicSolid):
    """A box along the axes of a frame, which are the world's where it has no rotation.

    Attributes:
        centre: Its centre in the frame [m].
        half: Half its edge lengths [m].
        origin: Origin of the frame [m].
        rotation: Rows of the frame's rotation matrix, or None.
    """

    centre: Vec
    half: Vec
    origin: Vec
    rotation: list[Vec] | None

    @property
    def bounds(self) -> Bounds:
        """Its bounds in the frame [m]."""
        return [(x - half, x + half) for x, half in zip(self.centre, self.half, strict=True)]

    def within(self, point: Vec) -> Vec:
        """Return a point in the frame."""
        from_origin = subtract(point, self.origin)
        return from_origin if self.rotation is None else _transposed_times(self.rotation, from_origin)

    def axes_within(self, rotation: list[Vec]) -> list[Vec]:
        """Return the columns of a rotation matrix in the frame."""
        columns = [[row[i] for row in rotation] for i in range(3)]
        return columns if self.rotation is None else [_transposed_times(self.rotation, each) for each in columns]

    def separation(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Return the distance or, inside, the depth of the middle of what is inside."""
        return signed_segment_box_distance(self.within(first), self.within(second), self.bounds, hold=hold)

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Return the distance, 0 where they touch."""
        return segment_box_distance(self.within(first), self.within(second), self.bounds)

    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Try all 15 axes that can separate two cuboids."""
        place = subtract(self.within(centre), self.centre)
        return cuboid_separation(place, self.axes_within(rotation), [edge / 2 for edge in size], self.half)


@dataclass(frozen=True)
class HullForm(BoxForm):
    """A convex hull: what is in a box and behind planes, in one frame.

    Attributes:
        planes: Outer unit normals and offsets [m] of the planes, each of shape (4,).
    """

    planes: Sequence[Sequence[float]] = ()

    def separation(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Take the larger one of the distance from the box and the best separation along a plane's normal."""
        import casadi as ca

        a, b = self.within(first), self.within(second)
        best: Scalar = -ENDLESS
        plane = [0.0] * 4
        for *normal, offset in self.planes:
            beyond = ca.fmin(dot(normal, a), dot(normal, b)) - offset
            better = beyond > best
            best = ca.fmax(best, beyond)
            plane = [ca.if_else(better, new, old) for new, old in zip((*normal, offset), plane, strict=True)]
        *normal, offset = plane  # constants for differentiation
        beyond = ca.fmin(dot(normal, a), dot(normal, b)) - offset if self.planes else best
        return ca.fmax(super().separation(first, second, hold), beyond)

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Likewise."""
        return self.separation(first, second, lambda value: value)

    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Likewise."""
        import casadi as ca

        best = super().cuboid_separation(centre, rotation, size)
        place, axes = self.within(centre), self.axes_within(rotation)
        for *normal, offset in self.planes:
            reach = sum(edge / 2 * ca.fabs(dot(normal, axis)) for edge, axis in zip(size, axes, strict=True))
            best = ca.fmax(best, dot(normal, place) - reach - offset)
        return best


@dataclass(frozen=True)
class RoundForm(SymbolicSolid):
    """A sphere or a capsule: all points near a segment.

    Attributes:
        first: One end of the segment [m].
        second: Its other end.
        radius: How near [m].
    """

    first: Vec
    second: Vec
    radius: Scalar

    def separation(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Return the exact signed distance, or minus the radius where the segments cross."""
        return segment_distance((first, second), (self.first, self.second), hold=hold) - self.radius

    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Return the exact signed distance."""
        first, second = (_transposed_times(rotation, subtract(end, centre)) for end in (self.first, self.second))
        return segment_box_separation(first, second, [(-edge / 2, edge / 2) for edge in size]) - self.radius


@dataclass(frozen=True)
class CylinderForm(SymbolicSolid):
    """A cylinder.

    Attributes:
        centre: Its centre [m].
        half: The vector from there to the middle of its end [m].
        radius: Its radius [m].
    """

    centre: Vec
    half: Vec
    radius: Scalar

    def separation(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Halve the segment some times, each time towards its nearest point.

        The distance is convex along the segment: it is nowhere less than where the halving ends, less what is left of
        the segment times the slope there. The nearest point may be held while the distance is differentiated.
        """
        import casadi as ca

        extent = ca.sqrt(dot(self.half, self.half))
        axis = scale(self.half, 1 / extent)
        from_centre, along = subtract(first, self.centre), subtract(second, first)
        high, climb = dot(from_centre, axis), dot(along, axis)
        off, drift = subtract(from_centre, scale(axis, high)), subtract(along, scale(axis, climb))
        square, growth, bend = dot(off, off), dot(off, drift), dot(drift, drift)

        def gaps(t: Scalar) -> tuple[Scalar, Scalar, Scalar]:
            """How far from the axis a point is, and how far beyond the side and the ends [m]."""
            away = ca.sqrt(ca.fmax(square + t * (2 * growth + t * bend), 0) + POINT)
            return away, away - self.radius, ca.fabs(high + t * climb) - extent

        def slope(t: Scalar) -> Scalar:
            away, beside, beyond = gaps(t)
            outside = ca.fmax(beside, beyond) > 0
            by_side = ca.if_else(outside, ca.fmax(beside, 0), beside >= beyond)
            by_end = ca.if_else(outside, ca.fmax(beyond, 0), beside < beyond)
            steep = by_side * (growth + t * bend) / away + by_end * ca.sign(high + t * climb) * climb
            return steep / ca.sqrt(by_side * by_side + by_end * by_end + POINT)

        t, width = ca.SX(0.5), 0.5
        for _ in range(HALVINGS):
            width /= 2
            t = t + ca.if_else(slope(t) < 0, width, -width)
        t, off_by = hold(t), hold(width * ca.fabs(slope(t)))
        _, beside, beyond = gaps(t)
        apart = ca.sqrt(ca.fmax(beside, 0) ** 2 + ca.fmax(beyond, 0) ** 2 + POINT)
        return apart + ca.fmin(ca.fmax(beside, beyond), 0) - off_by

    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Try the cylinder's axis, the directions from it, and the normals of the cuboid's faces."""
        import casadi as ca

        place = _transposed_times(rotation, subtract(self.centre, centre))
        half, edges = _transposed_times(rotation, self.half), [edge / 2 for edge in size]
        extent = ca.sqrt(dot(half, half))
        axis = scale(half, 1 / extent)
        bounds: Bounds = [(-edge, edge) for edge in edges]
        best = segment_box_separation(add(place, half), subtract(place, half), bounds) - self.radius
        reach = sum(edge * ca.fabs(x) for edge, x in zip(edges, axis, strict=True))
        best = ca.fmax(best, ca.fabs(dot(place, axis)) - extent - reach)
        for x, edge, lean, along in zip(place, edges, axis, half, strict=True):
            wide = self.radius * ca.sqrt(ca.fmax(1 - lean * lean, 0) + POINT)
            best = ca.fmax(best, ca.fabs(x) - edge - ca.fabs(along) - wide)
        return best


def symbolic_solids(state: SymbolicState) -> list[SymbolicSolid]:
    """Return the obstacles round a robot as solvers see them."""
    parts = number_slices(state.obstacles)
    return [_solid(each, state.tops[part]) for each, part in zip(state.obstacles, parts, strict=True)]


def _solid(obstacle: "Obstacle", numbers: Vec) -> SymbolicSolid:
    if obstacle.upright:
        return _upright(obstacle, numbers[0])
    return _MADE[obstacle.kind](obstacle, numbers[:3], numbers[3:])


def _box(obstacle: "Obstacle", position: Vec, rest: Vec) -> BoxForm:
    return BoxForm([0.0] * 3, rest[:3], position, _three_rows(rest[3:]) if obstacle.is_turned else None)


def _sphere(_: "Obstacle", position: Vec, rest: Vec) -> RoundForm:
    return RoundForm(position, position, rest[0])


def _capsule(_: "Obstacle", position: Vec, rest: Vec) -> RoundForm:
    return RoundForm(subtract(position, rest[:3]), add(position, rest[:3]), rest[3])


def _cylinder(_: "Obstacle", position: Vec, rest: Vec) -> CylinderForm:
    return CylinderForm(position, rest[:3], rest[3])


def _mesh(obstacle: "Obstacle", position: Vec, rest: Vec) -> HullForm:
    corners = corners_of(obstacle.mesh)
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, half = ((low + high) / 2).tolist(), ((high - low) / 2).tolist()
    return HullForm(centre, half, position, _three_rows(rest), supporting_planes(corners).tolist())


_MADE: dict[str, Callable[["Obstacle", Vec, Vec], SymbolicSolid]] = {
    "box": _box,
    "sphere": _sphere,
    "capsule": _capsule,
    "cylinder": _cylinder,
    "mesh": _mesh,
}


def _upright(obstacle: "Obstacle", top: Scalar) -> UprightForm:
    height, spans = obstacle.height, [each for each in (obstacle.x, obstacle.y) if each is not None]
    sides: Bounds = [(span.low, span.high) for span in spans]
    return UprightForm([*sides, (None if height is None else top - height, top)])


def _three_rows(numbers: Vec) -> list[Vec]:
    return [numbers[0:3], numbers[3:6], numbers[6:9]]


def _transposed_times(matrix: list[Vec], vector: Vec) -> Vec:
    return [dot([matrix[row][column] for row in range(3)], vector) for column in range(3)]
