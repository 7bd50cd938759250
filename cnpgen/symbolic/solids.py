"""Signed distances of the robot's capsules and of the held object from obstacles, as SX: one form per kind.

Sizes and poses are scalars: inputs of kernels. Nothing is called further away than it is. Distances of segments from
boxes, spheres and capsules are exact, from cylinders by 1e-3 of the segment, and the depth in a cylinder is that of the
deepest point; meshes are within a box and behind planes.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cnpgen.robots.shape.hull import supporting_planes
from cnpgen.robots.shape.inline import corners_of
from cnpgen.robots.solid import number_slices
from cnpgen.symbolic.boxes import (
    Bounds,
    segment_box_distance,
    segment_box_separation,
    signed_segment_box_distance,
    upright_box_separation,
)
from cnpgen.symbolic.linalg import Scalar, add, cross, dot, scale, subtract
from cnpgen.symbolic.segments import POINT, segment_distance
from cnpgen.symbolic.state import SymbolicState, Vec

if TYPE_CHECKING:
    from cnpgen.robots.obstacle import Obstacle

Size = tuple[float, float, float]
Hold = Callable[[Scalar], Scalar]

HALVINGS = 10  # of a segment, after which its point nearest to a cylinder is known
PARALLEL = 1e-12  # of the sine squared of an angle: edges that are closer to parallel have no common normal


class SymbolicSolid(ABC):
    """An obstacle as solvers see it."""

    @abstractmethod
    def separation(self, first: Vec, second: Vec) -> Scalar:
        """Signed distance of a segment from the obstacle, or less [m]."""

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Distance of a segment [m], where nothing but its size counts: it may have no gradient."""
        return self.separation(first, second)

    def descent(self, first: Vec, second: Vec, hold: Hold) -> Scalar:  # noqa: ARG002
        """Signed distance of a segment in a form that is easier to descend [m].

        Args:
            first: One end [m].
            second: Other end [m].
            hold: Returns a value as a constant for differentiation.
        """
        return self.separation(first, second)

    @abstractmethod
    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Signed distance of a cuboid from the obstacle, or less [m].

        Args:
            centre: Centre of the cuboid [m].
            rotation: Rows of its rotation matrix.
            size: Edge lengths of the cuboid [m].
        """


@dataclass(frozen=True)
class BoxForm(SymbolicSolid):
    """A box along the axes of a frame; the frame is the world's where it has no rotation.

    Attributes:
        bounds: Its bounds in the frame [m].
        origin: Origin of the frame [m].
        rotation: Rows of the frame's rotation matrix, or None.
    """

    bounds: Bounds
    origin: Vec
    rotation: list[Vec] | None = None

    def within(self, point: Vec) -> Vec:
        """Return a point in the box's frame."""
        return point if self.rotation is None else _transposed_times(self.rotation, subtract(point, self.origin))

    def separation(self, first: Vec, second: Vec) -> Scalar:
        """Return the exact signed distance."""
        return segment_box_separation(self.within(first), self.within(second), self.bounds)

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Return the distance, 0 where they touch."""
        return segment_box_distance(self.within(first), self.within(second), self.bounds)

    def descent(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Return the distance or, inside, the depth of the middle of what is inside."""
        return signed_segment_box_distance(self.within(first), self.within(second), self.bounds, hold=hold)

    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Try the normals of faces, and of pairs of edges where the box is turned."""
        if self.rotation is None:
            return upright_box_separation(centre, rotation, size, self.bounds)
        turned = [_transposed_times(self.rotation, column) for column in _columns(rotation)]
        place = self.within(centre)
        middle = [(low + high) / 2 for low, high in self.bounds]
        half = [(high - low) / 2 for low, high in self.bounds]
        return _cuboids_apart(subtract(place, middle), turned, [edge / 2 for edge in size], half)


@dataclass(frozen=True)
class HullForm(BoxForm):
    """A convex hull: what is in a box and behind planes, in one frame.

    Attributes:
        planes: Outer unit normals and offsets [m] of the planes, each of shape (4,).
    """

    planes: Sequence[Sequence[float]] = ()

    def separation(self, first: Vec, second: Vec) -> Scalar:
        """Take the larger one of the distance from the box and the separations along the planes' normals."""
        return self._beyond(super().separation(first, second), first, second)

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Likewise."""
        return self.separation(first, second)

    def descent(self, first: Vec, second: Vec, hold: Hold) -> Scalar:
        """Likewise."""
        return self._beyond(super().descent(first, second, hold), first, second)

    def _beyond(self, best: Scalar, first: Vec, second: Vec) -> Scalar:
        import casadi as ca

        a, b = self.within(first), self.within(second)
        for *normal, offset in self.planes:
            best = ca.fmax(best, ca.fmin(dot(normal, a), dot(normal, b)) - offset)
        return best

    def cuboid_separation(self, centre: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Likewise."""
        import casadi as ca

        best = super().cuboid_separation(centre, rotation, size)
        place = self.within(centre)
        columns = _columns(rotation)
        edges = columns if self.rotation is None else [_transposed_times(self.rotation, each) for each in columns]
        for *normal, offset in self.planes:
            reach = sum(edge / 2 * ca.fabs(dot(normal, axis)) for edge, axis in zip(size, edges, strict=True))
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

    def separation(self, first: Vec, second: Vec) -> Scalar:
        """Return the exact signed distance, or minus the radius where the segments cross."""
        return segment_distance((first, second), (self.first, self.second)) - self.radius

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

    def separation(self, first: Vec, second: Vec) -> Scalar:
        """Halve the segment, each time towards its nearest point; what is left of it is taken off the distance.

        The distance is convex along the segment. It has no derivative with respect to where on it the point is.
        """
        import casadi as ca

        extent = ca.sqrt(dot(self.half, self.half))
        axis = scale(self.half, 1 / extent)
        from_centre, along = subtract(first, self.centre), subtract(second, first)
        high, climb = dot(from_centre, axis), dot(along, axis)
        off, drift = subtract(from_centre, scale(axis, high)), subtract(along, scale(axis, climb))
        square, growth, bend = dot(off, off), dot(off, drift), dot(drift, drift)

        def gaps(t: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
            z = high + t * climb
            away = ca.sqrt(ca.fmax(square + t * (2 * growth + t * bend), 0) + POINT)
            return z, away, away - self.radius, ca.fabs(z) - extent

        low, width = ca.SX(0), 1.0
        for _ in range(HALVINGS):
            width /= 2
            t = low + width
            z, away, beside, beyond = gaps(t)
            outside = ca.fmax(beside, beyond) > 0
            by_side = ca.if_else(outside, ca.fmax(beside, 0), beside >= beyond)
            by_end = ca.if_else(outside, ca.fmax(beyond, 0), beside < beyond)
            slope = by_side * (growth + t * bend) + by_end * ca.sign(z) * climb * away
            low = low + width * (slope < 0)
        _, _, beside, beyond = gaps(low + width / 2)
        apart = ca.sqrt(ca.fmax(beside, 0) ** 2 + ca.fmax(beyond, 0) ** 2 + POINT)
        return apart + ca.fmin(ca.fmax(beside, beyond), 0) - width / 2 * ca.sqrt(dot(along, along))

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
    if obstacle.is_turned:
        return BoxForm([(-half, half) for half in rest[:3]], position, _three_rows(rest[3:]))
    return BoxForm([(x - half, x + half) for x, half in zip(position, rest, strict=True)], position)


def _sphere(_: "Obstacle", position: Vec, rest: Vec) -> RoundForm:
    return RoundForm(position, position, rest[0])


def _capsule(_: "Obstacle", position: Vec, rest: Vec) -> RoundForm:
    return RoundForm(subtract(position, rest[:3]), add(position, rest[:3]), rest[3])


def _cylinder(_: "Obstacle", position: Vec, rest: Vec) -> CylinderForm:
    return CylinderForm(position, rest[:3], rest[3])


def _mesh(obstacle: "Obstacle", position: Vec, rest: Vec) -> HullForm:
    corners = corners_of(obstacle.mesh)
    bounds: Bounds = list(zip(corners.min(axis=0).tolist(), corners.max(axis=0).tolist(), strict=True))
    return HullForm(bounds, position, _three_rows(rest), supporting_planes(corners).tolist())


_MADE: dict[str, Callable[["Obstacle", Vec, Vec], SymbolicSolid]] = {
    "box": _box,
    "sphere": _sphere,
    "capsule": _capsule,
    "cylinder": _cylinder,
    "mesh": _mesh,
}


def _upright(obstacle: "Obstacle", top: Scalar) -> BoxForm:
    height, spans = obstacle.height, [each for each in (obstacle.x, obstacle.y) if each is not None]
    sides: Bounds = [(span.low, span.high) for span in spans]
    return BoxForm([*sides, (None if height is None else top - height, top)], [])


def _cuboids_apart(place: Vec, axes: list[Vec], half: Vec, other: Vec) -> Scalar:
    """Separation of two cuboids along the best of their 15 axes [m].

    Args:
        place: Centre of the first in the frame of the second [m].
        axes: Its axes there.
        half: Half its edge lengths [m].
        other: Half the edge lengths of the second [m].
    """
    import casadi as ca

    units = [[float(i == j) for j in range(3)] for i in range(3)]
    best: Scalar = -1e3
    for normal in [*units, *axes, *(cross(unit, axis) for unit in units for axis in axes)]:
        square = dot(normal, normal)
        reach = sum(edge * ca.fabs(dot(normal, axis)) for edge, axis in zip(half, axes, strict=True))
        reach = reach + sum(edge * ca.fabs(x) for edge, x in zip(other, normal, strict=True))
        apart = (ca.fabs(dot(normal, place)) - reach) / ca.sqrt(ca.fmax(square, PARALLEL))
        best = ca.fmax(best, ca.if_else(square > PARALLEL, apart, -1e3))
    return best


def _three_rows(numbers: Vec) -> list[Vec]:
    return [numbers[0:3], numbers[3:6], numbers[6:9]]


def _columns(rotation: list[Vec]) -> list[Vec]:
    return [[row[i] for row in rotation] for i in range(3)]


def _transposed_times(matrix: list[Vec], vector: Vec) -> Vec:
    return [dot([matrix[row][column] for row in range(3)], vector) for column in range(3)]
