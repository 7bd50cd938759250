"""Exact distances between the robot's capsules, an upright cuboid and axis-aligned boxes, as SX."""

import math
from collections.abc import Callable
from typing import Any

from cnpgen.kernels.symbolic.linalg import Scalar, Vec, cross, dot

Bounds = list[tuple[Any, Any]]  # (low, high) per axis; None where the box has no end
ENDLESS = 100.0  # m: a box without a lower end reaches this far down where one is needed
TOUCHING = 1e-30  # m^2: the square root of less has no gradient
FLAT = 1e-12  # m: what a segment's extent along an axis is taken for where it has none, so that there is 1 / extent
PARALLEL = 1e-16  # m^2: a segment that is no further along an edge's normals is parallel to the edge
SINE = 1e-12  # square of the sine of an angle: edges that are closer to parallel have no common normal
POINT = 1e-12  # m^2: keeps a signed distance of nothing differentiable


def segment_box_distance(first: Vec, second: Vec, box: Bounds) -> Scalar:
    """Distance from a segment to an axis-aligned box [m]; 0, and without a gradient, where they touch.

    ``d^2`` of the point ``first + t (second - first)`` is convex in t and its derivative is piecewise linear with a
    knot where a coordinate meets a face. The knots bracket the minimum; between the two nearest the derivative is
    linear.

    Args:
        first: One end [m].
        second: Other end [m].
        box: Bounds along x, y, z [m].
    """
    import casadi as ca

    along = [b - a for a, b in zip(first, second, strict=True)]
    t = _nearest(first, along, box)
    outside = [_outside(first[axis] + t * along[axis], box[axis]) for axis in range(3)]
    return ca.sqrt(ca.fmax(sum(x * x for x in outside), TOUCHING)) - math.sqrt(TOUCHING)


def segment_box_separation(first: Vec, second: Vec, box: Bounds) -> Scalar:
    """Signed distance of a segment from an axis-aligned box: minus the depth where they overlap [m].

    The depth is the shortest way by which one must be moved to leave the other. The separating axes of the two are the
    faces' normals, and normals of the segment and an edge.

    Args:
        first: One end [m].
        second: Other end [m].
        box: Bounds along x, y, z [m].
    """
    import casadi as ca

    ends = [(high - ENDLESS if low is None else low, low + ENDLESS if high is None else high) for low, high in box]
    middle, half = [(low + high) / 2 for low, high in ends], [(high - low) / 2 for low, high in ends]
    along = [b - a for a, b in zip(first, second, strict=True)]
    place = [a - m for a, m in zip(first, middle, strict=True)]
    separation: Scalar = -ENDLESS
    for a, b, (low, high) in zip(first, second, ends, strict=True):
        separation = ca.fmax(separation, ca.fmax(low - ca.fmax(a, b), ca.fmin(a, b) - high))
    for axis in range(3):
        normal = cross([float(i == axis) for i in range(3)], along)
        square = dot(normal, normal)
        reach = sum(extent * ca.fabs(x) for extent, x in zip(half, normal, strict=True))
        apart = (ca.fabs(dot(normal, place)) - reach) / ca.sqrt(ca.fmax(square, PARALLEL))
        separation = ca.fmax(separation, ca.if_else(square > PARALLEL, apart, -ENDLESS))
    return segment_box_distance(first, second, box) + ca.fmin(separation, 0)


def signed_segment_box_distance(first: Vec, second: Vec, box: Bounds, *, hold: Callable[[Scalar], Scalar]) -> Scalar:
    """Distance from a segment to an axis-aligned box, negative where it is inside [m]: it has no kink but on entering.

    Inside it is the depth, below the nearest face, of the middle of the part that is inside. Outside, the nearest point
    of the segment may be held while the distance is differentiated: it minimises the distance, so that to first order
    its own motion changes nothing.

    Args:
        first: One end [m].
        second: Other end [m].
        box: Bounds along x, y, z [m].
        hold: Returns a value as a constant for differentiation.
    """
    import casadi as ca

    along = [b - a for a, b in zip(first, second, strict=True)]
    t = hold(_nearest(first, along, box))
    outside = [_outside(first[axis] + t * along[axis], box[axis]) for axis in range(3)]
    middle = _middle(first, along, box)
    depth: Scalar = -ENDLESS
    for axis, (low, high) in enumerate(box):
        x = first[axis] + middle * along[axis]
        for gap in ([] if low is None else [low - x]) + ([] if high is None else [x - high]):
            depth = ca.fmax(gap, depth)
    return ca.sqrt(sum(x * x for x in outside) + POINT) + ca.fmin(depth, 0)


def _middle(first: Vec, along: Vec, box: Bounds) -> Scalar:
    """Where on a segment the middle of its part inside a box is, in [0, 1]; anywhere on it if it is outside."""
    import casadi as ca

    enter, leave = ca.SX(0), ca.SX(1)
    for axis, (low, high) in enumerate(box):
        bounds = [high - ENDLESS if low is None else low, low + ENDLESS if high is None else high]
        faces = [(face - first[axis]) * _inverse(along[axis]) for face in bounds]
        enter, leave = ca.fmax(enter, ca.fmin(*faces)), ca.fmin(leave, ca.fmax(*faces))
    return ca.fmax(ca.fmin(0.5 * (enter + leave), 1), 0)


def _nearest(first: Vec, along: Vec, box: Bounds) -> Scalar:
    """Where on a segment its point nearest to a box is, in [0, 1]."""
    import casadi as ca

    knots = [
        ca.fmin(ca.fmax((face - first[axis]) * _inverse(along[axis]), 0), 1)
        for axis in range(3)
        for face in box[axis]
        if face is not None
    ]
    low, high = ca.SX(0), ca.SX(1)
    for knot in knots:
        slope = _slope(first, along, box, knot)
        low = ca.fmax(low, ca.if_else(slope <= 0, knot, 0))
        high = ca.fmin(high, 1 - ca.if_else(slope >= 0, 1 - knot, 0))
    slope_low, slope_high = _slope(first, along, box, low), _slope(first, along, box, high)
    fraction = ca.fmax(ca.fmin(-slope_low / ca.fmax(slope_high - slope_low, 1e-30), 1), 0)  # a number of float32, too
    return low + fraction * (high - low)


def _inverse(extent: Scalar) -> Scalar:
    return 1 / (extent + FLAT * (extent == 0))


def _outside(x: Scalar, bounds: tuple[Any, Any]) -> Scalar:
    """Signed distance of a coordinate beyond its bounds: positive above, negative below, 0 inside."""
    import casadi as ca

    low, high = bounds
    inside = x if low is None else ca.fmax(x, low)
    return x - (inside if high is None else ca.fmin(inside, high))


def _slope(first: Vec, along: Vec, box: Bounds, t: Scalar) -> Scalar:
    """Half the derivative of the squared distance at t."""
    total: Scalar = 0.0
    for axis in range(3):
        total = total + _outside(first[axis] + t * along[axis], box[axis]) * along[axis]
    return total


def upright_box_separation(centre: Vec, rotation: list[Vec], size: tuple[float, float, float], box: Bounds) -> Scalar:
    """Separation of a cuboid from an axis-aligned box along the best face normal [m]; negative inside.

    Exact for a cuboid whose z axis is vertical and that overlaps the box (its faces' normals and the box's are then all
    the separating axes that there are), and a lower bound of the distance where they are apart. Where the cuboid is
    tilted it is a lower bound, too, up to terms of the order of depth x tilt^2: axes that lean like the cuboid, and
    those between edges, are not tried, so that contacts look deeper by up to tilt [rad] x its longest edge (2.8 mm at
    0.01 rad for 0.3 m).

    Args:
        centre: Centre of the cuboid [m].
        rotation: Rows of its rotation matrix.
        size: Edge lengths of the cuboid [m].
        box: Bounds of the box along x, y, z [m]; None for "no end", which separates on the other side only.
    """
    import casadi as ca

    half = [edge / 2 for edge in size]
    gaps = []
    for axis, (low, high) in enumerate(box):
        spread = sum(half[i] * ca.fabs(rotation[axis][i]) for i in range(3))
        if low is not None:
            gaps.append(low - centre[axis] - spread)
        if high is not None:
            gaps.append(centre[axis] - high - spread)
    middle = [(low + high) / 2 for low, high in box[:2]]
    extent = [(high - low) / 2 for low, high in box[:2]]
    for i in range(2):
        normal = [rotation[axis][i] for axis in range(2)]  # its horizontal part: all of it if the cuboid is upright
        shift = sum((centre[axis] - middle[axis]) * normal[axis] for axis in range(2))
        own = sum(half[j] * ca.fabs(dot(normal, [rotation[0][j], rotation[1][j]])) for j in range(3))
        spread = own + sum(extent[axis] * ca.fabs(normal[axis]) for axis in range(2))
        gaps.append(ca.fabs(shift) - spread)
    best = gaps[0]
    for gap in gaps[1:]:
        best = ca.fmax(best, gap)
    return best


def cuboid_separation(place: Vec, axes: list[Vec], half: Vec, other: Vec) -> Scalar:
    """Separation of two cuboids along the best of their 15 axes [m].

    Args:
        place: Centre of the first in the frame of the second [m].
        axes: Its axes there.
        half: Half its edge lengths [m].
        other: Half the edge lengths of the second [m].
    """
    import casadi as ca

    units = [[float(i == j) for j in range(3)] for i in range(3)]
    best: Scalar = -ENDLESS
    for normal in [*units, *axes, *(cross(unit, axis) for unit in units for axis in axes)]:
        square = dot(normal, normal)
        reach = sum(edge * ca.fabs(dot(normal, axis)) for edge, axis in zip(half, axes, strict=True))
        reach = reach + sum(edge * ca.fabs(x) for edge, x in zip(other, normal, strict=True))
        apart = (ca.fabs(dot(normal, place)) - reach) / ca.sqrt(ca.fmax(square, SINE))
        best = ca.fmax(best, ca.if_else(square > SINE, apart, -ENDLESS))
    return best
