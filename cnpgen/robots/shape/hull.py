"""Convex hulls: corners, bounding planes and balls, and shapes of Coal."""

import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.errors import UsageError

if TYPE_CHECKING:
    import coal

# Corners of the unit cube centered at the origin.
CUBE = np.array(list(product((-0.5, 0.5), repeat=3)))
MAX_PLANES = 24  # that approximate the faces of a hull
# Of the angle below which planes are equivalent.
SIMILAR_PLANES_COSINE = math.cos(math.radians(3))
# Coplanar points are extended by this on both sides, so that they have a hull.
MIN_THICKNESS_M = 1e-6
MAX_CORNERS = 10_000  # of a body; finer meshes take minutes without benefit
# Of the body that replaces a finer one; it is about 0.1 % larger.
ENCLOSING_PLANES = 2_000
BALL_DIRECTIONS = 1200  # in which round bodies have corners
MAX_EDGES = 255  # at a corner of a body of Coal
MAX_COORDINATE_M = 1e4  # larger coordinates are treated as errors of units


def check_solid(corners: Array) -> None:
    """Raise ValueError for coplanar, too few or too many corners or edges, shape (V, 3), of untrusted input."""
    from scipy.spatial import ConvexHull, QhullError

    if len(corners) > MAX_CORNERS:
        raise ValueError(
            f"it has {len(corners):,} corners, expected at most {MAX_CORNERS:,}"
        )

    try:
        hull = ConvexHull(corners)
    except (QhullError, ValueError) as error:
        raise ValueError(
            f"its {len(corners)} corners are not those of a body"
        ) from error
    _triangles_of(hull)


def hull_corners(points: Array) -> Array:
    """Return the corners of the convex hull of points [m], shape (V, 3), at least ``MIN_THICKNESS_M`` thick.

    Their order depends on the coordinates only.
    """
    from scipy.spatial import ConvexHull

    # Sorted and without repetitions, so the order of the input does not matter.
    points = np.unique(points, axis=0)
    offsets = points - points.mean(axis=0)
    # Qhull needs a volume: thicken along every principal axis that has no extent.
    for axis in np.linalg.eigh(offsets.T @ offsets)[1].T:
        if np.ptp(offsets @ axis) < MIN_THICKNESS_M:
            points = np.concatenate(
                [points - MIN_THICKNESS_M * axis, points + MIN_THICKNESS_M * axis]
            )
    corners: Array = points[np.sort(ConvexHull(points).vertices)]
    return corners


def inflated(corners: Array, radius: float) -> Array:
    """Return points whose hull is that of corners [m], shape (V, 3), inflated by a radius [m]: balls of corners."""
    if not radius:
        return corners
    half = half_sphere(BALL_DIRECTIONS // 2)
    ball = np.concatenate([half, -half])
    points: Array = (corners[:, None] + radius * ball).reshape(-1, 3)
    return points


def outward_triangles(points: Array) -> Integers:
    """Return the triangles of the hull of points, shape (V, 3), counterclockwise from outside: indices (T, 3)."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    triangles: Integers = hull.simplices.astype(np.int64)
    a, b, c = (points[triangles[:, i]] for i in range(3))
    # Qhull's triangles have either orientation; its facet normals point outwards.
    inwards = np.einsum("fi,fi->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    return triangles


def enclosing_hull(corners: Array) -> tuple[Array, float]:
    """Return a body with fewer corners that contains a convex hull, and their maximum distance from it [m].

    Supporting planes in ``ENCLOSING_PLANES`` directions bound it, spread evenly after
    scaling all extents to one.
    """
    import coal
    from scipy.spatial import HalfspaceIntersection

    center = corners.mean(axis=0)
    extent = np.ptp(corners, axis=0)
    scaled = (corners - center) / extent
    half = half_sphere(ENCLOSING_PLANES // 2)
    normals = np.concatenate([half, -half])
    # Slightly outside, so that rounding does not cut a corner off.
    offsets = (normals @ scaled.T).max(axis=1) + 1e-9
    found = HalfspaceIntersection(
        np.column_stack([normals, -offsets]), np.zeros(3)
    ).intersections
    body = hull_corners(found * extent + center)
    hull = coal_hull(corners)
    point = coal.Sphere(0.0)
    place = coal.Transform3s()
    request = coal.DistanceRequest()
    distances = []
    for corner in body:
        place.setTranslation(corner)
        distances.append(
            coal.distance(
                hull, coal.Transform3s(), point, place, request, coal.DistanceResult()
            )
        )
    return body, max(0.0, *distances)


def half_sphere(count: int) -> Array:
    """Return unit vectors on a Fibonacci lattice over the upper half of the sphere, shape (count, 3)."""
    # Equal areas: heights are equidistant and longitudes differ by the golden angle.
    z = (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - z**2)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=1)


def supporting_planes(corners: Array) -> Array:
    """Return a few bounding planes of a convex hull in all directions, shape (P, 4).

    They are faces of the hull: outer unit normals and offsets [m], ``normal @ x <=
    offset`` for all of its points. Each next face has the normal most distant from the
    previous normals and the axes.
    """
    from scipy.spatial import ConvexHull

    normals: Array = ConvexHull(corners).equations[:, :3]
    # Bounding boxes have the planes along the axes already.
    # Cosine of the angle to the nearest axis.
    nearest = np.abs(normals).max(axis=1)
    taken: list[Array] = []
    while len(taken) < MAX_PLANES and nearest.min() < SIMILAR_PLANES_COSINE:
        taken.append(normals[np.argmin(nearest)])
        # Farthest-point sampling of the normals.
        nearest = np.maximum(nearest, normals @ taken[-1])
    found = np.array(taken).reshape(-1, 3)
    return np.column_stack([found, (found @ corners.T).max(axis=1)])


def ball_round(corners: Array, radius: float) -> tuple[Array, float]:
    """Return center, shape (3,), and radius of a ball around a hull of corners, shape (V, 3), with a radius [m]."""
    centre: Array = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return centre, float(np.linalg.norm(corners - centre, axis=1).max()) + radius


def coal_hull(corners: Array) -> "coal.Convex":
    """Return a convex hull of corners [m], shape (V, 3), as a Coal shape.

    Three are a triangle, two a segment. UsageError for a corner with too many edges.
    """
    import coal
    from scipy.spatial import ConvexHull, QhullError

    try:
        triangles = (
            _triangles_of(ConvexHull(corners))
            if len(corners) > 3
            else [np.arange(3) % len(corners)]
        )
    except (QhullError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise UsageError(
            f"corners from {corners.min(axis=0)} to {corners.max(axis=0)} m have no convex hull: {reason}"
        ) from error
    return coal.Convex(*coal_vectors(corners, triangles))


def _triangles_of(hull: Any) -> Integers:
    """Return triangles of Qhull's hull with at most ``MAX_EDGES`` at a corner, shape (T, 3); ValueError if it has more."""
    triangles: Integers = hull.simplices
    if np.bincount(triangles.ravel()).max() <= MAX_EDGES:
        return triangles
    # Qhull divides a flat face into a fan, whose first corner has an edge to all
    # others. In a strip that goes from side to side, each corner has at most four.
    _, face_of = np.unique(hull.equations.round(9), axis=0, return_inverse=True)
    strips = []
    for face in range(face_of.max() + 1):
        own = face_of.ravel() == face
        around = np.unique(triangles[own])
        axes = frame_along(hull.equations[own][0, :3].tolist(), 1.0)[:, :2]
        points = hull.points[around]
        x, y = ((points - points.mean(axis=0)) @ axes).T
        order = around[np.argsort(np.arctan2(y, x))]
        # 0, 1, -1, 2, -2, ...
        sides = [(i + 1) // 2 * (1 if i % 2 else -1) for i in range(len(order))]
        strip = order[sides]
        strips.append(np.column_stack([strip[:-2], strip[1:-1], strip[2:]]))
    triangles = np.concatenate(strips)
    if (most := int(np.bincount(triangles.ravel()).max())) > MAX_EDGES:
        raise ValueError(
            f"it has a corner with {most} edges, expected at most {MAX_EDGES}: give fewer corners"
        )
    return triangles


def coal_vectors(points: Array, triangles: Iterable[Any]) -> tuple[Any, Any]:
    """Return points [m], shape (V, 3), and triangles, indices of points, as vectors of Coal."""
    import coal

    corners = coal.StdVec_Vec3s()
    sides = coal.StdVec_Triangle()
    for point in points:
        corners.append(point)
    for triangle in triangles:
        sides.append(coal.Triangle(*map(int, triangle)))
    return corners, sides


def frame_along(vector: Sequence[float], length: float) -> Array:
    """Return a rotation matrix whose third column is a vector's direction (Duff et al. 2017, JCGT 6(1))."""
    if length == 0.0:
        return np.eye(3)
    x = vector[0] / length
    y = vector[1] / length
    z = vector[2] / length
    # Without a branch at z = -1: the sign of z selects one of two charts.
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array(
        [
            [1.0 + sign * x * x * a, b, x],
            [sign * b, sign + y * y * a, y],
            [-sign * x, -y, z],
        ]
    )


def frames_along(vectors: Array, lengths: Array) -> Array:
    """Return the matrices of ``frame_along`` for vectors, shape (N, 3), with their lengths, shape (N,): (N, 3, 3)."""
    x, y, z = (vectors / np.where(lengths > 0, lengths, 1.0)[:, None]).T
    z = np.where(lengths > 0, z, 1.0)
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows = [
        1.0 + sign * x * x * a,
        b,
        x,
        sign * b,
        sign + y * y * a,
        y,
        -sign * x,
        -y,
        z,
    ]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)
