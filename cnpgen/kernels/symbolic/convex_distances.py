"""Exact distances of segments from each other, and of segments and cuboids from axis-aligned boxes, as SX.

Segments are given by their ends [m], boxes by their bounds along x, y, z [m].
``freeze`` is a function that makes a value constant for differentiation.
"""

import math
from collections.abc import Callable
from functools import reduce
from typing import Any

from cnpgen.kernels.symbolic.linalg import Scalar, Vec, add, cross, dot, scale, subtract

Bounds = list[tuple[Any, Any]]  # (low, high) per axis; None for an unbounded side
# Keeps square roots of squared distances differentiable; squared length of a degenerate
# segment.
SMOOTHING_M2 = 1e-12
UNBOUNDED_EXTENT_M = 100.0  # extent of a box along an axis without a bound
# The square root of smaller values has no finite gradient.
MIN_SQUARED_DISTANCE_M2 = 1e-30
# Replaces an extent of 0 of a segment along an axis, so that 1 / extent is finite.
MIN_EXTENT_M = 1e-12
# Squared length of a cross product at which a segment is parallel to an edge.
MIN_SQUARED_NORMAL_M2 = 1e-16
MIN_SQUARED_SINE = 1e-12  # squared sine of the angle at which two edges are parallel
MIN_DENOMINATOR = 1e-30  # m^2; a normal number of float32, too


def segment_distance(
    first: tuple[Vec, Vec], second: tuple[Vec, Vec], *, freeze: Callable[[Any], Any]
) -> Scalar:
    """Return the distance of two segments [m]; it has a gradient everywhere and is 1e-6 m for crossing segments.

    The closest points of the two lines are clamped to their segments (Ericson 2005,
    section 5.1.9). They are constant for differentiation (envelope theorem), which
    ``freeze`` makes them. Segments are given by their ends [m].
    """
    import casadi as ca

    # Minimize |r + s a - t b|^2 over s and t:
    #   s = (ab br - ar bb) / (aa bb - ab^2),   t = (ab s + br) / bb.
    # For parallel lines the denominator is 0 and every s minimizes; the floor gives a
    # finite one.
    a = subtract(first[1], first[0])
    b = subtract(second[1], second[0])
    r = subtract(first[0], second[0])
    aa = dot(a, a)
    bb = dot(b, b)
    ab = dot(a, b)
    ar = dot(a, r)
    br = dot(b, r)
    s = _clamped(
        (ab * br - ar * bb) / ca.fmax(aa * bb - ab * ab, SMOOTHING_M2 * SMOOTHING_M2)
    )
    t = _clamped((ab * s + br) / ca.fmax(bb, SMOOTHING_M2))
    # Clamping t may have moved it, so s is computed again for the t that is used.
    s = freeze(_clamped((ab * t - ar) / ca.fmax(aa, SMOOTHING_M2)))
    t = freeze(t)
    difference = subtract(add(r, scale(a, s)), scale(b, t))
    # The root of the sum with a small constant has a gradient also at distance 0.
    return ca.sqrt(dot(difference, difference) + SMOOTHING_M2)


def _clamped(value: Any) -> Any:
    """Return a value limited to [0, 1]."""
    import casadi as ca

    return ca.fmax(ca.fmin(value, 1), 0)


def segment_box_distance(first: Vec, second: Vec, box: Bounds) -> Scalar:
    """Return the distance of a segment from an axis-aligned box [m]; 0 with gradient 0 if they overlap.

    ``d^2`` of the point ``first + t (second - first)`` is convex in t. Its derivative
    is piecewise linear with a knot where a coordinate meets a face. The knots bracket
    the minimum; between the two closest the derivative is linear.
    """
    import casadi as ca

    along = [b - a for a, b in zip(first, second, strict=True)]
    t = _closest_parameter(first, along, box)
    outside = [_outside(first[axis] + t * along[axis], box[axis]) for axis in range(3)]
    return ca.sqrt(
        ca.fmax(sum(x * x for x in outside), MIN_SQUARED_DISTANCE_M2)
    ) - math.sqrt(MIN_SQUARED_DISTANCE_M2)


def segment_box_separation(first: Vec, second: Vec, box: Bounds) -> Scalar:
    """Return the signed distance of a segment from an axis-aligned box [m], minus the depth if they overlap.

    The depth is the length of the smallest translation that separates them. The
    separating axes are the face normals and the common normals of the segment and an
    edge.
    """
    import casadi as ca

    # A missing side becomes a plane 100 m away, so that center and half sizes exist.
    bounds = [_finite(low, high) for low, high in box]
    center = [(low + high) / 2 for low, high in bounds]
    half = [(high - low) / 2 for low, high in bounds]
    along = [b - a for a, b in zip(first, second, strict=True)]
    # Signed separation along the axes: face normals first, then e_i x along. On the
    # normal n the intervals are |n . offset| and sum(half |n|), both divided by |n|.
    offset = [a - m for a, m in zip(first, center, strict=True)]
    separation: Scalar = -UNBOUNDED_EXTENT_M
    for a, b, (low, high) in zip(first, second, bounds, strict=True):
        separation = ca.fmax(
            separation, ca.fmax(low - ca.fmax(a, b), ca.fmin(a, b) - high)
        )
    # The projection of the segment on a normal of this kind is one point: n . along =
    # 0.
    for axis in range(3):
        normal = cross([float(i == axis) for i in range(3)], along)
        square = dot(normal, normal)
        reach = sum(extent * ca.fabs(x) for extent, x in zip(half, normal, strict=True))
        gap = (ca.fabs(dot(normal, offset)) - reach) / ca.sqrt(
            ca.fmax(square, MIN_SQUARED_NORMAL_M2)
        )
        # For a segment parallel to an edge the cross product vanishes and gives no
        # axis.
        separation = ca.fmax(
            separation,
            ca.if_else(square > MIN_SQUARED_NORMAL_M2, gap, -UNBOUNDED_EXTENT_M),
        )
    # Separating axes are exact only inside; outside, the Euclidean distance takes their
    # place.
    return segment_box_distance(first, second, box) + ca.fmin(separation, 0)


def signed_segment_box_distance(
    first: Vec, second: Vec, box: Bounds, *, freeze: Callable[[Scalar], Scalar]
) -> Scalar:
    """Return the distance of a segment from an axis-aligned box [m], negative inside and smooth except on entering.

    Inside it is minus the depth, below the closest face, of the midpoint of the
    overlapping part. Outside, the closest point of the segment is constant for
    differentiation (envelope theorem).
    """
    import casadi as ca

    along = [b - a for a, b in zip(first, second, strict=True)]
    # Envelope theorem: at the closest point the derivative with respect to t is zero,
    # or t is at an end of the segment.
    t = freeze(_closest_parameter(first, along, box))
    outside = [_outside(first[axis] + t * along[axis], box[axis]) for axis in range(3)]
    midpoint = _overlap_midpoint(first, along, box)
    depth: Scalar = -UNBOUNDED_EXTENT_M
    for axis, (low, high) in enumerate(box):
        x = first[axis] + midpoint * along[axis]
        for gap in ([] if low is None else [low - x]) + (
            [] if high is None else [x - high]
        ):
            depth = ca.fmax(gap, depth)
    # On the surface the depth is 0 and the distance is the smoothing, 1e-6 m.
    return ca.sqrt(sum(x * x for x in outside) + SMOOTHING_M2) + ca.fmin(depth, 0)


def _finite(low: Any, high: Any) -> tuple[Any, Any]:
    """Return the bounds of a box along one axis with a finite value for a missing one."""
    return (
        high - UNBOUNDED_EXTENT_M if low is None else low,
        low + UNBOUNDED_EXTENT_M if high is None else high,
    )


def _overlap_midpoint(first: Vec, along: Vec, box: Bounds) -> Scalar:
    """Return the parameter in [0, 1] of the midpoint of the part inside a box.

    An arbitrary one if there is none.
    """
    import casadi as ca

    # Slab method: the segment is inside between the last entry and the first exit.
    enter = ca.SX(0)
    leave = ca.SX(1)
    for axis, (low, high) in enumerate(box):
        faces = [
            (face - first[axis]) * _inverse(along[axis]) for face in _finite(low, high)
        ]
        enter = ca.fmax(enter, ca.fmin(*faces))
        leave = ca.fmin(leave, ca.fmax(*faces))
    return ca.fmax(ca.fmin(0.5 * (enter + leave), 1), 0)


def _closest_parameter(first: Vec, along: Vec, box: Bounds) -> Scalar:
    """Return the parameter in [0, 1] of the segment's point closest to a box."""
    import casadi as ca

    knots = [
        ca.fmin(ca.fmax((face - first[axis]) * _inverse(along[axis]), 0), 1)
        for axis in range(3)
        for face in box[axis]
        if face is not None
    ]
    # The derivative is monotonic in t: the largest knot where it is negative and the
    # smallest one where it is positive bracket the minimum. Between them it is linear,
    # so one secant step gives the root.
    low = ca.SX(0)
    high = ca.SX(1)
    for knot in knots:
        derivative = _derivative(first, along, box, knot)
        low = ca.fmax(low, ca.if_else(derivative <= 0, knot, 0))
        # ``1 - if_else(..., 1 - knot, 0)`` is the knot, or 1 where the condition does
        # not hold.
        high = ca.fmin(high, 1 - ca.if_else(derivative >= 0, 1 - knot, 0))
    at_low = _derivative(first, along, box, low)
    at_high = _derivative(first, along, box, high)
    fraction = ca.fmax(
        ca.fmin(-at_low / ca.fmax(at_high - at_low, MIN_DENOMINATOR), 1), 0
    )
    return low + fraction * (high - low)


def _inverse(extent: Scalar) -> Scalar:
    return 1 / (extent + MIN_EXTENT_M * (extent == 0))


def _outside(x: Scalar, bounds: tuple[Any, Any]) -> Scalar:
    """Return the signed violation of bounds by a coordinate: positive above, negative below, 0 inside."""
    import casadi as ca

    low, high = bounds
    inside = x if low is None else ca.fmax(x, low)
    return x - (inside if high is None else ca.fmin(inside, high))


def _derivative(first: Vec, along: Vec, box: Bounds, t: Scalar) -> Scalar:
    """Return half the derivative of the squared distance at t."""
    return sum(
        _outside(first[axis] + t * along[axis], box[axis]) * along[axis]
        for axis in range(3)
    )


def upright_box_separation(
    center: Vec, rotation: list[Vec], size: tuple[float, float, float], box: Bounds
) -> Scalar:
    """Return the largest separation of a cuboid from an axis-aligned box along a face normal [m]; negative inside.

    It is exact for an upright cuboid that overlaps the box: the face normals of both
    are then all separating axes. If they do not overlap it is a lower bound of the
    distance. For a tilted cuboid it is a lower bound up to terms of the order of depth
    x tilt^2, because tilted axes and cross products of edges are not tested. Contacts
    then appear deeper by at most tilt [rad] x the length of the largest edge (2.8 mm at
    0.01 rad for 0.3 m). The cuboid has a center [m], rows of a rotation matrix and edge
    lengths [m].
    """
    import casadi as ca

    half = [edge / 2 for edge in size]
    gaps = []
    for axis, (low, high) in enumerate(box):
        # Half extent of the cuboid along a world axis: sum over its edges of half
        # |cosine|.
        spread = sum(half[i] * ca.fabs(rotation[axis][i]) for i in range(3))
        if low is not None:
            gaps.append(low - center[axis] - spread)
        if high is not None:
            gaps.append(center[axis] - high - spread)
    # The cuboid's horizontal normals only: if it is upright, its third normal is the
    # vertical one of the box, which was tested above.
    box_center = [(low + high) / 2 for low, high in box[:2]]
    extent = [(high - low) / 2 for low, high in box[:2]]
    for i in range(2):
        # The horizontal part, which is all of it if upright.
        normal = [rotation[axis][i] for axis in range(2)]
        shift = sum(
            (center[axis] - box_center[axis]) * normal[axis] for axis in range(2)
        )
        own = sum(
            half[j] * ca.fabs(dot(normal, [rotation[0][j], rotation[1][j]]))
            for j in range(3)
        )
        spread = own + sum(extent[axis] * ca.fabs(normal[axis]) for axis in range(2))
        gaps.append(ca.fabs(shift) - spread)
    return reduce(ca.fmax, gaps)


def cuboid_separation(center: Vec, axes: list[Vec], half: Vec, other: Vec) -> Scalar:
    """Return the largest separation of two cuboids along their 15 separating axes [m].

    Center [m] and axes of the first cuboid are in the frame of the second; both have
    half edge lengths [m].
    """
    import casadi as ca

    units = [[float(i == j) for j in range(3)] for i in range(3)]
    best: Scalar = -UNBOUNDED_EXTENT_M
    # The 15 axes of two boxes: three face normals each and nine cross products of edges
    # (Gottschalk, Lin and Manocha 1996).
    for normal in [
        *units,
        *axes,
        *(cross(unit, axis) for unit in units for axis in axes),
    ]:
        square = dot(normal, normal)
        reach = sum(
            edge * ca.fabs(dot(normal, axis))
            for edge, axis in zip(half, axes, strict=True)
        )
        reach = reach + sum(
            edge * ca.fabs(x) for edge, x in zip(other, normal, strict=True)
        )
        # Cross products are no unit vectors: divide by their length to measure in
        # meters.
        gap = (ca.fabs(dot(normal, center)) - reach) / ca.sqrt(
            ca.fmax(square, MIN_SQUARED_SINE)
        )
        # Parallel edges have no common normal; the face normals cover that case.
        best = ca.fmax(
            best, ca.if_else(square > MIN_SQUARED_SINE, gap, -UNBOUNDED_EXTENT_M)
        )
    return best
