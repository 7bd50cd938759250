"""Convex hulls: the corners of one, and one as Coal takes it."""

import math
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import coal

Array = NDArray[np.float64]

CUBE = np.array(list(product((-0.5, 0.5), repeat=3)))  # the corners of a cube of edge length 1 round the origin
MOST_PLANES = 24  # that stand for the faces of a hull
NEAR = math.cos(math.radians(3))  # of the angle between planes that are as good as one
THINNEST = 1e-6  # m: points in a plane are taken for this much thicker on both sides, so that they have a hull
MOST_CORNERS = 10_000  # of a body; what is finer takes minutes and proves nothing more
FARTHEST = 1e4  # m: whatever is further off is no part of a robot


def check_solid(corners: Array) -> None:
    """Refuse corners that are in a plane or too few: ``hull_corners`` returns none such, but strangers may write them.

    Args:
        corners: The corners [m], shape (V, 3).

    Raises:
        ValueError: There is no body between them, or they are too many.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(corners) > MOST_CORNERS:
        raise ValueError(f"it has {len(corners):,} corners, expected at most {MOST_CORNERS:,}")

    try:
        ConvexHull(corners)
    except (QhullError, ValueError) as error:
        raise ValueError(f"its {len(corners)} corners are not those of a body") from error


def hull_corners(points: Array) -> Array:
    """Return the corners of the convex hull of points; it is made ``THINNEST`` thick where it is thinner.

    Args:
        points: The points [m], shape (N, 3).

    Returns:
        Shape (V, 3), in an order that depends on the coordinates only.
    """
    from scipy.spatial import ConvexHull

    points = np.unique(points, axis=0)
    offsets = points - points.mean(axis=0)
    for axis in np.linalg.eigh(offsets.T @ offsets)[1].T:
        if np.ptp(offsets @ axis) < THINNEST:
            points = np.concatenate([points - THINNEST * axis, points + THINNEST * axis])
    corners: Array = points[np.sort(ConvexHull(points).vertices)]
    return corners


def supporting_planes(corners: Array) -> Array:
    """Return planes that a convex hull is behind, few but looking to all sides, shape (P, 4).

    They are the hull's own faces, each time the one that looks furthest away from those taken before and from the axes.

    Args:
        corners: The corners of the hull [m], shape (V, 3).

    Returns:
        Outer unit normals and offsets [m]: ``normal @ x <= offset`` for all points of the hull.
    """
    from scipy.spatial import ConvexHull

    normals: Array = ConvexHull(corners).equations[:, :3]
    nearest = np.abs(normals).max(axis=1)  # cosine of the angle to the nearest axis
    taken: list[Array] = []
    while len(taken) < MOST_PLANES and nearest.min() < NEAR:
        taken.append(normals[np.argmin(nearest)])
        nearest = np.maximum(nearest, normals @ taken[-1])
    found = np.array(taken).reshape(-1, 3)
    return np.column_stack([found, (found @ corners.T).max(axis=1)])


def ball_round(corners: Array, radius: float) -> tuple[Array, float]:
    """Return the centre of a ball that holds a convex body [m], shape (3,), and its radius [m].

    Args:
        corners: Corners of the body's hull [m], shape (V, 3).
        radius: How thick the hull is wrapped [m].
    """
    centre: Array = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return centre, float(np.linalg.norm(corners - centre, axis=1).max()) + radius


def coal_hull(corners: Array) -> "coal.Convex":
    """Return a convex hull as a Coal shape.

    Args:
        corners: Its corners [m], shape (V, 3); up to three are a point, a segment, a triangle.
    """
    import coal
    from scipy.spatial import ConvexHull

    triangles = ConvexHull(corners).simplices if len(corners) > 3 else [np.arange(3) % len(corners)]
    points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for corner in corners:
        points.append(corner)
    for triangle in triangles:
        faces.append(coal.Triangle(*map(int, triangle)))
    return coal.Convex(points, faces)


def frame_along(vector: Sequence[float], length: float) -> Array:
    """Return a rotation matrix whose third column is a vector's direction (Duff et al. 2017, JCGT 6(1))."""
    if length == 0.0:
        return np.eye(3)
    x, y, z = vector[0] / length, vector[1] / length, vector[2] / length
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, b, x], [sign * b, sign + y * y * a, y], [-sign * x, -y, z]])
