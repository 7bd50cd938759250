"""Signed distances of the robot's capsules and of the held object from obstacles, as SX: one class per kind.

Sizes and poses are scalar inputs of kernels. All distances are exact or lower bounds:
exact for segments and boxes, spheres and capsules, bisected for cylinders, and those of
a box cut by planes for meshes. The depth of a segment inside an obstacle is that of one
point: the deepest in a cylinder, the midpoint of the overlap in a box with a pose.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import NamedTuple

from cnpgen.arrays import Array
from cnpgen.kernels.symbolic.convex_distances import (
    SMOOTHING_M2,
    UNBOUNDED_EXTENT_M,
    Bounds,
    cuboid_separation,
    segment_box_distance,
    segment_box_separation,
    segment_distance,
    signed_segment_box_distance,
    upright_box_separation,
)
from cnpgen.kernels.symbolic.linalg import (
    Scalar,
    Vec,
    add,
    dot,
    scale,
    subtract,
    transposed_times,
)
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.robots.shape.hull import supporting_planes
from cnpgen.robots.solid import number_slices

Size = tuple[float, float, float]
Freeze = Callable[[Scalar], Scalar]

BISECTION_STEPS = 6  # of the parameter of a segment's point closest to a cylinder


class SymbolicSolid(ABC):
    """The shape of an obstacle as SX."""

    @abstractmethod
    def separation(self, first: Vec, second: Vec, freeze: Freeze) -> Scalar:
        """Return the signed distance of a segment from the obstacle, or a lower bound [m].

        Args:
            first: First end of the segment [m].
            second: Second end of the segment [m].
            freeze: Function that makes a value constant for differentiation.
        """

    def smooth_separation(self, first: Vec, second: Vec, freeze: Freeze) -> Scalar:
        """Return a signed distance of a segment that is smooth inside the obstacle, for descent methods [m]."""
        return self.separation(first, second, freeze)

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Return the distance of a segment [m], possibly without a gradient."""
        return self.separation(first, second, lambda value: value)

    @abstractmethod
    def cuboid_separation(self, center: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Return the signed distance of a cuboid from the obstacle, or a lower bound [m].

        Args:
            center: Center of the cuboid [m].
            rotation: Rows of its rotation matrix.
            size: Edge lengths of the cuboid [m].
        """


@dataclass(frozen=True)
class SymbolicUprightBox(SymbolicSolid):
    """An axis-aligned box given by its bounds; distances are exact, those of cuboids if they are upright.

    Attributes:
        bounds: Bounds along x, y, z [m].
    """

    bounds: Bounds

    def separation(self, first: Vec, second: Vec, freeze: Freeze) -> Scalar:  # noqa: ARG002
        """Return the signed distance."""
        return segment_box_separation(first, second, self.bounds)

    def smooth_separation(self, first: Vec, second: Vec, freeze: Freeze) -> Scalar:
        """Return the distance, or inside minus the depth of the overlap's midpoint."""
        return signed_segment_box_distance(first, second, self.bounds, freeze=freeze)

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Return the distance, 0 if they overlap."""
        return segment_box_distance(first, second, self.bounds)

    def cuboid_separation(self, center: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Return the largest separation along a face normal."""
        return upright_box_separation(center, rotation, size, self.bounds)


@dataclass(frozen=True)
class SymbolicBox(SymbolicSolid):
    """A box along the axes of a frame.

    Attributes:
        center: Center in the frame [m].
        half: Half edge lengths [m].
        origin: Origin of the frame [m].
        rotation: Rows of the frame's rotation matrix, or None for the world's axes.
    """

    center: Vec
    half: Vec
    origin: Vec
    rotation: list[Vec] | None

    @property
    def bounds(self) -> Bounds:
        """Bounds in the frame [m]."""
        return [
            (x - half, x + half) for x, half in zip(self.center, self.half, strict=True)
        ]

    def within(self, point: Vec) -> Vec:
        """Return a point in the frame."""
        from_origin = subtract(point, self.origin)
        return (
            from_origin
            if self.rotation is None
            else transposed_times(self.rotation, from_origin)
        )

    def axes_within(self, rotation: list[Vec]) -> list[Vec]:
        """Return the columns of a rotation matrix in the frame."""
        columns = [[row[i] for row in rotation] for i in range(3)]
        return (
            columns
            if self.rotation is None
            else [transposed_times(self.rotation, column) for column in columns]
        )

    def separation(self, first: Vec, second: Vec, freeze: Freeze) -> Scalar:
        """Return the distance, or inside minus the depth of the overlap's midpoint."""
        return signed_segment_box_distance(
            self.within(first), self.within(second), self.bounds, freeze=freeze
        )

    def distance(self, first: Vec, second: Vec) -> Scalar:
        """Return the distance, 0 if they overlap."""
        return segment_box_distance(
            self.within(first), self.within(second), self.bounds
        )

    def cuboid_separation(self, center: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Return the largest separation along the 15 separating axes of two cuboids."""
        position = subtract(self.within(center), self.center)
        return cuboid_separation(
            position, self.axes_within(rotation), [edge / 2 for edge in size], self.half
        )


@dataclass(frozen=True)
class SymbolicHull(SymbolicBox):
    """A convex hull, the intersection of a box and half-spaces in one frame, with a radius around it.

    Attributes:
        planes: Outer unit normals and offsets [m] of the half-spaces, each of shape
            (4,).
        radius: Radius around the hull [m].
    """

    planes: Sequence[Sequence[float]] = ()
    radius: float = 0.0

    def separation(self, first: Vec, second: Vec, freeze: Freeze) -> Scalar:
        """Return the larger one of the distance from the box and the largest separation along a plane's normal."""
        import casadi as ca

        # On one plane the closer end of the segment has the smaller offset. The
        # distance is at least the largest of these offsets over the planes.
        a = self.within(first)
        b = self.within(second)
        best: Scalar = -UNBOUNDED_EXTENT_M
        plane = [0.0] * 4
        for *normal, offset in self.planes:
            gap = ca.fmin(dot(normal, a), dot(normal, b)) - offset
            better = gap > best
            best = ca.fmax(best, gap)
            # Keep the plane that attains the maximum: the gradient is its normal.
            plane = [
                ca.if_else(better, new, old)
                for new, old in zip((*normal, offset), plane, strict=True)
            ]
        *normal, offset = plane  # constant for differentiation
        gap = ca.fmin(dot(normal, a), dot(normal, b)) - offset if self.planes else best
        return self._rounded(ca.fmax(super().separation(first, second, freeze), gap))

    def _rounded(self, distance: Scalar) -> Scalar:
        """Return the distance from the hull with its radius."""
        return distance - self.radius if self.radius else distance

    distance = SymbolicSolid.distance

    def cuboid_separation(self, center: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Return the larger one of the separation from the box and the largest one along a plane's normal."""
        import casadi as ca

        best = super().cuboid_separation(center, rotation, size)
        position = self.within(center)
        axes = self.axes_within(rotation)
        for *normal, offset in self.planes:
            # Extent of the cuboid along the plane's normal.
            reach = sum(
                edge / 2 * ca.fabs(dot(normal, axis))
                for edge, axis in zip(size, axes, strict=True)
            )
            best = ca.fmax(best, dot(normal, position) - reach - offset)
        return self._rounded(best)


@dataclass(frozen=True)
class SymbolicCapsule(SymbolicSolid):
    """A capsule, or a sphere if both ends coincide.

    Attributes:
        first: First end of the axis [m].
        second: Second end of the axis [m].
        radius: Radius [m].
    """

    first: Vec
    second: Vec
    radius: Scalar

    def separation(self, first: Vec, second: Vec, freeze: Freeze) -> Scalar:
        """Return the exact signed distance, or minus the radius for crossing segments."""
        return (
            segment_distance((first, second), (self.first, self.second), freeze=freeze)
            - self.radius
        )

    def cuboid_separation(self, center: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Return the exact signed distance."""
        first, second = (
            transposed_times(rotation, subtract(end, center))
            for end in (self.first, self.second)
        )
        return (
            segment_box_separation(
                first, second, [(-edge / 2, edge / 2) for edge in size]
            )
            - self.radius
        )


class _LineAroundAxis(NamedTuple):
    """A segment beside a cylinder: squared distance from the axis and height along it at a parameter t.

    rho(t)^2 = c0 + 2 c1 t + c2 t^2,   z(t) = height + t axial
    """

    c0: Scalar
    c1: Scalar
    c2: Scalar
    height: Scalar
    axial: Scalar
    extent: Scalar  # half the length of the cylinder
    radius: Scalar

    def gaps(self, t: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        """Return the distance of a point from the axis, and its distances from the lateral surface and the ends."""
        import casadi as ca

        squared = self.c0 + t * (2 * self.c1 + t * self.c2)
        from_axis = ca.sqrt(ca.fmax(squared, 0) + SMOOTHING_M2)
        side = from_axis - self.radius
        return from_axis, side, ca.fabs(self.height + t * self.axial) - self.extent

    def derivative(self, t: Scalar) -> Scalar:
        """Return the derivative of the signed distance with respect to t.

        Outside the distance is ``d = sqrt(side+^2 + end+^2)``, so its derivative weights
        both gaps by their sizes over d. Inside it is the larger gap alone.
        """
        import casadi as ca

        from_axis, side, end = self.gaps(t)
        outside = ca.fmax(side, end) > 0
        by_side = ca.if_else(outside, ca.fmax(side, 0), side >= end)
        by_end = ca.if_else(outside, ca.fmax(end, 0), side < end)
        weighted = (
            by_side * (self.c1 + t * self.c2) / from_axis
            + by_end * ca.sign(self.height + t * self.axial) * self.axial
        )
        return weighted / ca.sqrt(by_side * by_side + by_end * by_end + SMOOTHING_M2)


@dataclass(frozen=True)
class SymbolicCylinder(SymbolicSolid):
    """A cylinder.

    Attributes:
        center: Center [m].
        half: Vector from the center to the center of an end [m].
        radius: Radius [m].
    """

    center: Vec
    half: Vec
    radius: Scalar

    def separation(self, first: Vec, second: Vec, freeze: Freeze) -> Scalar:
        """Return a lower bound of the distance by bisection of the closest point's parameter.

        The distance is convex along the segment. Its minimum is at least the value at
        the last bisection point minus the remaining interval times the derivative
        there. The closest point is constant for differentiation.
        """
        import casadi as ca

        line = self._line(first, second)
        # Bisection of the sign of the derivative: the number of steps is fixed, since
        # SX has no loops that depend on values.
        t = ca.SX(0.5)
        width = 0.5
        for _ in range(BISECTION_STEPS):
            width /= 2
            t = t + ca.if_else(line.derivative(t) < 0, width, -width)
        t, error_bound = freeze(t), freeze(width * ca.fabs(line.derivative(t)))
        _, side, end = line.gaps(t)
        distance = ca.sqrt(ca.fmax(side, 0) ** 2 + ca.fmax(end, 0) ** 2 + SMOOTHING_M2)
        return distance + ca.fmin(ca.fmax(side, end), 0) - error_bound

    def _line(self, first: Vec, second: Vec) -> "_LineAroundAxis":
        """Return a segment in coordinates of the cylinder."""
        import casadi as ca

        extent = ca.sqrt(dot(self.half, self.half))
        axis = scale(self.half, 1 / extent)
        from_center = subtract(first, self.center)
        along = subtract(second, first)
        height = dot(from_center, axis)
        axial = dot(along, axis)
        radial = subtract(from_center, scale(axis, height))
        radial_along = subtract(along, scale(axis, axial))
        squares = (
            dot(radial, radial),
            dot(radial, radial_along),
            dot(radial_along, radial_along),
        )
        return _LineAroundAxis(*squares, height, axial, extent, self.radius)

    def cuboid_separation(self, center: Vec, rotation: list[Vec], size: Size) -> Scalar:
        """Return the largest separation along the cylinder's axis, directions from it, and the face normals."""
        import casadi as ca

        # In the frame of the cuboid, where its face normals are the coordinate axes.
        position = transposed_times(rotation, subtract(self.center, center))
        half = transposed_times(rotation, self.half)
        edges = [edge / 2 for edge in size]
        extent = ca.sqrt(dot(half, half))
        axis = scale(half, 1 / extent)
        bounds: Bounds = [(-edge, edge) for edge in edges]
        best = (
            segment_box_separation(
                add(position, half), subtract(position, half), bounds
            )
            - self.radius
        )
        reach = sum(edge * ca.fabs(x) for edge, x in zip(edges, axis, strict=True))
        best = ca.fmax(best, ca.fabs(dot(position, axis)) - extent - reach)
        # Half extent of the cylinder along a face normal: half length times the cosine
        # and radius times the sine of the angle to its axis.
        for x, edge, cosine, along in zip(position, edges, axis, half, strict=True):
            extent_of_disk = self.radius * ca.sqrt(
                ca.fmax(1 - cosine * cosine, 0) + SMOOTHING_M2
            )
            best = ca.fmax(best, ca.fabs(x) - edge - ca.fabs(along) - extent_of_disk)
        return best


def held_cuboid(state: SymbolicState) -> SymbolicBox:
    """Return the held object as a box with a pose."""
    half = [edge / 2 for edge in state.object_size or (0.0, 0.0, 0.0)]
    return SymbolicBox([0.0] * 3, half, state.kinematics.tip, state.kinematics.rotation)


def _box(half: Vec, position: Vec, rotation: Vec) -> SymbolicBox:
    """Return a box by half its edges [m]; without a rotation its axes are those of the world."""
    turn = _three_rows(rotation) if rotation else None
    return SymbolicBox([0.0] * 3, half, position, turn)


def _capsule(position: Vec, half: Vec, radius: Scalar) -> SymbolicCapsule:
    """Return a capsule by half its axis [m]."""
    return SymbolicCapsule(subtract(position, half), add(position, half), radius)


def _hull(corners: Array, radius: float, position: Vec, rotation: Vec) -> SymbolicHull:
    """Return the hull of constant corners with a radius [m]."""
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    center = ((low + high) / 2).tolist()
    half = ((high - low) / 2).tolist()
    planes = supporting_planes(corners).tolist()
    return SymbolicHull(center, half, position, _three_rows(rotation), planes, radius)


# Makers of solids from the values of poses and sizes, which shapes call.
SOLIDS = SimpleNamespace(
    upright=SymbolicUprightBox,
    box=_box,
    ball=SymbolicCapsule,
    capsule=_capsule,
    cylinder=SymbolicCylinder,
    hull=_hull,
)


def symbolic_solids(state: SymbolicState) -> list[SymbolicSolid]:
    """Return the shapes of the obstacles around a robot."""
    parts = [state.obstacle_poses[part] for part in number_slices(state.obstacles)]
    return [
        obstacle.form.symbolic(values, SOLIDS)
        for obstacle, values in zip(state.obstacles, parts, strict=True)
    ]


def _three_rows(values: Vec) -> list[Vec]:
    return [values[0:3], values[3:6], values[6:9]]
