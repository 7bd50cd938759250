"""Capsules that cover links: what solvers take for them, since its distances are cheap and easy to descend.

A capsule is convex: one that holds the corners of a link's pieces, with their thickness, holds the link. Of those that
do, the one that sticks out of the link least is looked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.shape.hull import hull_corners
from cnpgen.robots.shape.piece import Piece

Array = NDArray[np.float64]

STARTS = 3  # directions from which the search begins
WORST = 25  # corners, and facets, that the search looks at first
ROUNDS = 6  # of adding those that are worst then
BALL = 200  # points that stand for a ball where facets are asked for
STEP = 1e-5  # m: ends and radius are multiples of it, so that rounding on another machine gives the same capsule


@dataclass(frozen=True)
class Capsule:
    """All points within ``radius`` of a segment, in the frame of the joint that moves the link.

    Attributes:
        link: The link that it covers.
        first: One end of the segment [m], shape (3,).
        second: Its other end.
        radius: The radius [m].
        overhang: How far it sticks out of the convex hull of the link [m].
    """

    link: str
    first: Array
    second: Array
    radius: float
    overhang: float


def covering_capsule(pieces: Sequence[Piece]) -> Capsule:
    """Find a capsule of small overhang that covers all pieces of one link.

    From the best of 30 directions, each with the smallest circle round the link's shadow, sequential quadratic
    programming lessens radius + greatest excess of an end over a facet, which is the overhang while ends are inside
    the hull. The radius is then set to what covers every corner.

    Args:
        pieces: The pieces of the link, in one frame.
    """
    corners = np.concatenate([piece.vertices for piece in pieces])
    thickness = np.concatenate([np.full(len(piece.vertices), piece.radius) for piece in pieces])
    normals, offsets = _facets(corners, thickness)

    def finished(ends: Array) -> Capsule:
        first, second = np.round(ends / STEP) * STEP
        radius = STEP * np.ceil((_distances(corners, first, second)[0] + thickness).max() / STEP + 1e-9)
        beyond = (np.array([first, second]) @ normals.T - offsets).max()
        return Capsule(pieces[0].link, first, second, float(radius), float(radius + beyond))

    starts = sorted((finished(_along(axis, corners, thickness)) for axis in _axes(corners)), key=_by_overhang)
    found = [finished(_improved(start, corners, thickness, normals, offsets)) for start in starts[:STARTS]]
    return min([*starts[:1], *found], key=_by_overhang)


def covers(capsule: Capsule, pieces: Sequence[Piece]) -> bool:
    """Whether a capsule holds all pieces of its link: being convex it does if it holds their corners."""
    reach = [_distances(each.vertices, capsule.first, capsule.second)[0].max() + each.radius for each in pieces]
    return bool(reach) and max(reach) <= capsule.radius


def _by_overhang(capsule: Capsule) -> float:
    return capsule.overhang


def _facets(corners: Array, thickness: Array) -> tuple[Array, Array]:
    """Return normals, shape (F, 3), and offsets [m] of the facets of a hull whose corners may be thick."""
    from scipy.spatial import ConvexHull

    half = _half_sphere(BALL // 2)
    directions = np.concatenate([half, -half])
    balls = [corner + size * directions for corner, size in zip(corners, thickness, strict=True) if size > 0]
    equations = ConvexHull(hull_corners(np.concatenate([corners, *balls]))).equations
    return equations[:, :3], -equations[:, 3]


def _axes(corners: Array) -> Array:
    """Directions to try: principal axes, coordinate axes, 24 more, shape (30, 3)."""
    offsets = corners - corners.mean(axis=0)
    return np.concatenate([np.linalg.eigh(offsets.T @ offsets)[1].T, np.eye(3), _half_sphere(24)])


def _half_sphere(count: int) -> Array:
    """Unit vectors spread evenly over the upper half of the sphere, on a Fibonacci lattice, shape (count, 3)."""
    z = (np.arange(count) + 0.5) / count
    angle, level = np.arange(count) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z**2)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=1)


def _along(axis: Array, corners: Array, thickness: Array) -> Array:
    """Return the ends of the shortest capsule along an axis whose radius is that of the link's shadow, shape (2, 3)."""
    across = np.linalg.svd(axis[None])[2][1:]  # two unit vectors at right angles to the axis
    shadow = corners @ across.T
    middle = shadow.mean(axis=0)
    for step in range(1, 100):  # towards the furthest corner, less and less (Badoiu and Clarkson 2003)
        away = shadow - middle
        middle = middle + away[np.argmax(np.hypot(*away.T) + thickness)] / (step + 1)
    along, off = corners @ axis, np.hypot(*(shadow - middle).T)
    room = np.sqrt(np.maximum(((off + thickness).max() - thickness) ** 2 - off**2, 0))
    low, high = (along + room).min(), (along - room).max()
    low, high = (low, high) if low < high else ((low + high) / 2,) * 2
    return np.asarray(middle @ across + np.outer([low, high], axis))


def _distances(points: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Distances of points from a segment [m], unit vectors away from it, and where on it they are nearest, 0 to 1."""
    along = second - first
    where = np.clip((points - first) @ along / max(float(along @ along), 1e-18), 0, 1)
    away = points - first - np.outer(where, along)
    distance = np.linalg.norm(away, axis=1)
    return distance, away / np.maximum(distance, 1e-12)[:, None], where


def _improved(start: Capsule, corners: Array, thickness: Array, normals: Array, offsets: Array) -> Array:
    """Lessen the overhang of a capsule by sequential quadratic programming; return its ends [m], shape (2, 3)."""
    ends = np.array([start.first, start.second])
    near, facets = np.zeros(0, np.intp), np.zeros(0, np.intp)
    for _ in range(ROUNDS):
        covered = _distances(corners, *ends)[0] + thickness
        beyond = (ends @ normals.T - offsets).max(axis=0)
        near = np.union1d(near, np.argsort(-covered, kind="stable")[:WORST])
        facets = np.union1d(facets, np.argsort(-beyond, kind="stable")[:WORST])
        ends = _solved(ends, corners[near], thickness[near], normals[facets], offsets[facets])
    return ends


def _solved(ends: Array, corners: Array, thickness: Array, normals: Array, offsets: Array) -> Array:
    """Minimise r + t such that the corners are within r of the segment and its ends no more than t beyond facets."""
    from scipy.optimize import minimize

    facets, zeros = len(normals), np.zeros_like(normals)
    linear = np.block([[-normals, zeros], [zeros, -normals]])
    beyond = np.concatenate([linear, np.zeros((2 * facets, 1)), np.ones((2 * facets, 1))], axis=1)

    def room(x: Array) -> Array:
        near = x[6] - thickness - _distances(corners, x[:3], x[3:6])[0]
        return np.concatenate([near, x[7] + np.tile(offsets, 2) + linear @ x[:6]])

    def slopes(x: Array) -> Array:
        _, away, where = _distances(corners, x[:3], x[3:6])
        columns = (1 - where)[:, None] * away, where[:, None] * away, np.ones((len(away), 1)), np.zeros((len(away), 1))
        return np.concatenate([np.concatenate(columns, axis=1), beyond])

    start = np.concatenate([ends.ravel(), [(_distances(corners, *ends)[0] + thickness).max()]])
    start = np.append(start, (ends @ normals.T - offsets).max())
    solved = minimize(
        lambda x: x[6] + x[7],
        start,
        jac=lambda _: np.array([0, 0, 0, 0, 0, 0, 1.0, 1.0]),
        constraints={"type": "ineq", "fun": room, "jac": slopes},
        method="SLSQP",
        options={"maxiter": 60, "ftol": 1e-7},
    )
    return np.asarray(solved.x[:6].reshape(2, 3) if np.isfinite(solved.x).all() else ends)
