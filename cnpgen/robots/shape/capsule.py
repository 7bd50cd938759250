"""Covering capsules of links, used by solvers since their distances are cheap and smooth.

A capsule is convex: if it contains the corners of a link's convex parts, with their
radius, it contains the link. The search minimizes the overhang of the capsule over the
link.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.shape.convex_part import ConvexPart
from cnpgen.robots.shape.hull import half_sphere, hull_corners

SEARCH_DIRECTIONS = 3  # initial directions of the search
# Corners and facets with the largest violations that are added per round.
POINTS_PER_ROUND = 25
MAX_CAPSULE_ROUNDS = 6  # rounds of the search
BALL_POINTS = 200  # points that approximate a ball in the computation of facets
# Ends and radius are multiples of it, so that capsules are equal on all machines.
ROUNDING_STEP_M = 1e-5


@dataclass(frozen=True)
class Capsule:
    """All points within ``radius`` of a segment, in the frame of the joint that moves the link.

    Attributes:
        link: Covered link.
        first: First end of the segment [m], shape (3,).
        second: Second end of the segment [m], shape (3,).
        radius: Radius [m].
        overhang: Maximum distance of the capsule from the convex hull of the link [m].
    """

    link: str
    first: Array
    second: Array
    radius: float
    overhang: float


def covering_capsule(convex_parts: Sequence[ConvexPart]) -> Capsule:
    """Find a capsule of small overhang that covers all convex parts of one link, which are in one frame.

    The initial guess is the best of 30 directions, each with the minimum enclosing
    circle of the link's projection. Sequential quadratic programming then minimizes the
    radius plus the maximum excess of an end over a facet, which is the overhang for
    ends inside the hull. The final radius covers every corner.
    """
    corners = np.concatenate([part.vertices for part in convex_parts])
    thickness = np.concatenate(
        [np.full(len(part.vertices), part.radius) for part in convex_parts]
    )
    normals, offsets = _facets(corners, thickness)

    def finished(ends: Array) -> Capsule:
        # Rounded ends and a radius rounded up: the capsule still covers every corner.
        first, second = np.round(ends / ROUNDING_STEP_M) * ROUNDING_STEP_M
        radius = ROUNDING_STEP_M * np.ceil(
            (_distances(corners, first, second)[0] + thickness).max() / ROUNDING_STEP_M
            + 1e-9
        )
        # Radius plus the excess of an end over a facet bounds the distance from the
        # hull.
        excess = (np.array([first, second]) @ normals.T - offsets).max()
        return Capsule(
            convex_parts[0].link, first, second, float(radius), float(radius + excess)
        )

    starts = sorted(
        (finished(_along(axis, corners, thickness)) for axis in _axes(corners)),
        key=attrgetter("overhang"),
    )
    improved = [
        finished(_improved(start, corners, thickness, normals, offsets))
        for start in starts[:SEARCH_DIRECTIONS]
    ]
    return min([*starts[:1], *improved], key=attrgetter("overhang"))


def covers(capsule: Capsule, convex_parts: Sequence[ConvexPart]) -> bool:
    """Return whether a capsule contains all corners, and therefore all convex parts, of its link."""
    reach = [
        _distances(each.vertices, capsule.first, capsule.second)[0].max() + each.radius
        for each in convex_parts
    ]
    return bool(reach) and max(reach) <= capsule.radius


def _facets(corners: Array, thickness: Array) -> tuple[Array, Array]:
    """Return normals, shape (F, 3), and offsets [m] of the facets of a hull of balls around the corners."""
    from scipy.spatial import ConvexHull

    # Balls around corners as points: their hull is that of the thick part, up to the
    # grid.
    half = half_sphere(BALL_POINTS // 2)
    directions = np.concatenate([half, -half])
    balls = [
        corner + size * directions
        for corner, size in zip(corners, thickness, strict=True)
        if size > 0
    ]
    equations = ConvexHull(hull_corners(np.concatenate([corners, *balls]))).equations
    return equations[:, :3], -equations[:, 3]


def _axes(corners: Array) -> Array:
    """Return the initial directions: principal axes, coordinate axes and 24 more, shape (30, 3)."""
    offsets = corners - corners.mean(axis=0)
    return np.concatenate(
        [np.linalg.eigh(offsets.T @ offsets)[1].T, np.eye(3), half_sphere(24)]
    )


def _along(axis: Array, corners: Array, thickness: Array) -> Array:
    """Return the ends of the minimum capsule along an axis, shape (2, 3), by a circle (Badoiu and Clarkson 2003)."""
    # Right singular vectors of a row: the first is the axis, the others are across it.
    across = np.linalg.svd(axis[None])[2][1:]
    projection = corners @ across.T
    center = projection.mean(axis=0)
    for step in range(1, 100):
        away = projection - center
        # Towards the farthest point by 1 / (k + 1): converges to the center of the
        # smallest circle.
        center = center + away[np.argmax(np.hypot(*away.T) + thickness)] / (step + 1)
    along = corners @ axis
    off = np.hypot(*(projection - center).T)
    # A ball at height h is covered by a cap whose end is within sqrt(R^2 - off^2) of
    # it, with R the radius that is left for its center.
    reach = np.sqrt(np.maximum(((off + thickness).max() - thickness) ** 2 - off**2, 0))
    low = (along + reach).min()
    high = (along - reach).max()
    low, high = (low, high) if low < high else ((low + high) / 2,) * 2
    return np.asarray(center @ across + np.outer([low, high], axis))


def _distances(
    points: Array, first: Array, second: Array
) -> tuple[Array, Array, Array]:
    """Return distances of points from a segment [m], unit vectors away from it, and phases of the closest points."""
    along = second - first
    # A segment without length is a point; the floor then gives phase 0.
    where = np.clip((points - first) @ along / max(float(along @ along), 1e-18), 0, 1)
    away = points - first - np.outer(where, along)
    distance = np.linalg.norm(away, axis=1)
    return distance, away / np.maximum(distance, 1e-12)[:, None], where


def _improved(
    start: Capsule, corners: Array, thickness: Array, normals: Array, offsets: Array
) -> Array:
    """Reduce the overhang of a capsule by sequential quadratic programming.

    Return its ends [m], shape (2, 3).
    """
    ends = np.array([start.first, start.second])
    near = np.zeros(0, np.intp)
    facets = np.zeros(0, np.intp)
    for _ in range(MAX_CAPSULE_ROUNDS):
        covered = _distances(corners, *ends)[0] + thickness
        excess = (ends @ normals.T - offsets).max(axis=0)
        # Cutting set: only corners and facets that were violated most so far are
        # constraints.
        near = np.union1d(near, np.argsort(-covered, kind="stable")[:POINTS_PER_ROUND])
        facets = np.union1d(
            facets, np.argsort(-excess, kind="stable")[:POINTS_PER_ROUND]
        )
        ends = _solved(
            ends, corners[near], thickness[near], normals[facets], offsets[facets]
        )
    return ends


def _solved(
    ends: Array, corners: Array, thickness: Array, normals: Array, offsets: Array
) -> Array:
    """Minimize r + t such that corners are within r of the segment and its ends at most t outside the facets."""
    from scipy.optimize import minimize

    facets = len(normals)
    zeros = np.zeros_like(normals)
    linear = np.block([[-normals, zeros], [zeros, -normals]])
    # Unknowns: both ends (6), radius r, excess t; constraints of facets are linear.
    zero = np.zeros((2 * facets, 1))
    one = np.ones((2 * facets, 1))
    facet_gradients = np.concatenate([linear, zero, one], axis=1)

    def margins(x: Array) -> Array:
        # r - thickness - distance from the segment >= 0, with the gradient of the
        # closest point.
        near = x[6] - thickness - _distances(corners, x[:3], x[3:6])[0]
        return np.concatenate([near, x[7] + np.tile(offsets, 2) + linear @ x[:6]])

    def gradients(x: Array) -> Array:
        _, away, where = _distances(corners, x[:3], x[3:6])
        of_ends = (1 - where)[:, None] * away, where[:, None] * away
        constants = np.ones((len(away), 1)), np.zeros((len(away), 1))
        near = np.concatenate([*of_ends, *constants], axis=1)
        return np.concatenate([near, facet_gradients])

    radius = (_distances(corners, *ends)[0] + thickness).max()
    excess = (ends @ normals.T - offsets).max()
    start = np.append(ends.ravel(), [radius, excess])
    solved = minimize(
        lambda x: x[6] + x[7],
        start,
        jac=lambda _: np.array([0, 0, 0, 0, 0, 0, 1.0, 1.0]),
        constraints={"type": "ineq", "fun": margins, "jac": gradients},
        method="SLSQP",
        options={"maxiter": 60, "ftol": 1e-7},
    )
    is_finite = np.isfinite(solved.x).all()
    return np.asarray(solved.x[:6].reshape(2, 3) if is_finite else ends)
