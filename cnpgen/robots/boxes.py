"""Exact distances between the robot's capsules, an upright cuboid and axis-aligned boxes, as SX."""

from typing import Any

from cnpgen.robots.linalg import Scalar, dot
from cnpgen.robots.symbolic import Vec

Bounds = list[tuple[Any, Any]]  # (low, high) per axis; None where the box has no end


def segment_box_distance(first: Vec, second: Vec, box: Bounds) -> Scalar:
    """Distance from a segment to an axis-aligned box [m], 0 where they touch.

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
    knots = [
        ca.fmin(ca.fmax((face - first[axis]) / along[axis], 0), 1)
        for axis in range(3)
        for face in box[axis]
        if face is not None
    ]
    low, high = ca.SX(0), ca.SX(1)
    slope_low, slope_high = _slope(first, along, box, ca.SX(0)), _slope(first, along, box, ca.SX(1))
    start, end = slope_low, slope_high
    for knot in knots:
        slope = _slope(first, along, box, knot)
        falls = ca.logic_and(slope <= 0, low < knot)
        low, slope_low = ca.if_else(falls, knot, low), ca.if_else(falls, slope, slope_low)
        rises = ca.logic_and(slope >= 0, knot < high)
        high, slope_high = ca.if_else(rises, knot, high), ca.if_else(rises, slope, slope_high)
    fraction = ca.fmax(ca.fmin(-slope_low / ca.fmax(slope_high - slope_low, 1e-300), 1), 0)
    t = ca.if_else(start >= 0, 0, ca.if_else(end <= 0, 1, low + fraction * (high - low)))
    outside = [_outside(first[axis] + t * along[axis], box[axis]) for axis in range(3)]
    return ca.sqrt(sum(x * x for x in outside))


def _outside(x: Scalar, bounds: tuple[Any, Any]) -> Scalar:
    """Signed distance of a coordinate beyond its bounds: positive above, negative below, 0 inside."""
    import casadi as ca

    low, high = bounds
    beyond = ca.fmax(x - high, 0) if high is not None else ca.SX(0)
    return beyond - ca.fmax(low - x, 0) if low is not None else beyond


def _slope(first: Vec, along: Vec, box: Bounds, t: Scalar) -> Scalar:
    """Half the derivative of the squared distance at t."""
    total: Scalar = 0.0
    for axis in range(3):
        total = total + _outside(first[axis] + t * along[axis], box[axis]) * along[axis]
    return total


def upright_box_separation(centre: Vec, rotation: list[Vec], size: tuple[float, float, float], box: Bounds) -> Scalar:
    """Separation of a cuboid from an axis-aligned box along the best face normal [m]; negative inside.

    Exact for a cuboid whose z axis is vertical and that overlaps the box (its faces' normals and the box's are then all
    the separating axes that there are). A lower bound of the distance where they are apart and, up to terms of the
    order of the depth of penetration times tilt^2, where the cuboid is tilted.

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
