"""Obstacles as convex bodies, and the vectors of their poses and sizes.

Kernels and judges receive poses and sizes of obstacles per sample. The entries of one
obstacle are, all in m,

* of an upright box given by ``x`` and ``y``: the height of its upper face;
* of any other: its position, then
  box: half its edge lengths, and the rows of its rotation matrix if it is rotated;
  sphere: its radius; capsule, cylinder: the vector from its centre to the end of its
  axis, and its radius (of a cylinder that of the corners of the prism round it); mesh:
  the rows of its rotation matrix.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.convex_part import PRISM_SIDES, prism, turned
from cnpgen.robots.shape.hull import CUBE, frame_along
from cnpgen.robots.shape.inline import corners_of
from cnpgen.schema.keys import Range

# Height of the box that represents an obstacle without a lower end.

UNBOUNDED_OBSTACLE_HEIGHT_M = 10.0
_NOTHING = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Solid:
    """Convex body in the world: all points within ``radius`` of the hull of ``corners``, translated by ``position``.

    Attributes:
        position: Position [m], shape (3,).
        corners: Corners of the hull relative to the position, in world axes [m], shape
            (V, 3).
        low: Lower corner of the bounding box [m], shape (3,).
        high: Upper corner of the bounding box [m], shape (3,).
        radius: Radius around the hull [m].
    """

    position: Array
    corners: Array
    low: Array
    high: Array
    radius: float = 0.0

    def furthest(self, direction: Array) -> float:
        """Return its extent along a unit vector of shape (3,), from the world's origin [m]."""
        return float(
            self.position @ direction + (self.corners @ direction).max() + self.radius
        )


class Box(Solid):
    """Box aligned with the world axes."""

    def furthest(self, direction: Array) -> float:
        """Return its extent along a unit vector; see ``Solid``."""
        # Support of a box: the corner in the direction, coordinate by coordinate.
        return float(np.where(direction > 0, self.high, self.low) @ direction)


def same_shape(a: Solid, b: Solid) -> bool:
    """Return whether two bodies differ at most in their position."""
    return a is b or (
        type(a) is type(b)
        and a.radius == b.radius
        and np.array_equal(a.corners, b.corners)
    )


def pose_width(obstacles: Sequence[Obstacle]) -> int:
    """Return the number of entries of the poses and sizes of obstacles."""
    return sum(map(_count, obstacles))


def number_slices(obstacles: Sequence[Obstacle]) -> list[slice]:
    """Return the slice of entries of each obstacle."""
    ends = accumulate(map(_count, obstacles), initial=0)
    return [slice(*pair) for pair in pairwise(ends)]


def height_places(obstacles: Sequence[Obstacle]) -> list[int]:
    """Return the index of the height entry of each obstacle."""
    parts = number_slices(obstacles)
    return [
        part.start + (0 if each.upright else 2)
        for each, part in zip(obstacles, parts, strict=True)
    ]


def _count(obstacle: Obstacle) -> int:
    if obstacle.upright:
        return 1
    turn = 9 if obstacle.is_turned else 0
    return (
        3
        + {"box": 3 + turn, "sphere": 1, "capsule": 4, "cylinder": 4, "mesh": 9}[
            obstacle.kind
        ]
    )


def place_obstacles(
    obstacles: Sequence[Obstacle], bottoms: Mapping[str, Array] | None = None
) -> Array:
    """Compute poses and sizes of obstacles, shape (..., pose_width).

    The bottom of the object is at these heights [m] at "start" and "goal", arrays of
    shape (...); by default 0.
    """
    bottoms = bottoms or {"start": np.zeros(()), "goal": np.zeros(())}
    numbers = np.empty((*bottoms["start"].shape, pose_width(obstacles)))
    for obstacle, part in zip(obstacles, number_slices(obstacles), strict=True):
        if obstacle.upright:
            numbers[..., part.start] = (
                bottoms[obstacle.below] if obstacle.top is None else obstacle.top
            )
            continue
        still = _posed_numbers(obstacle)
        numbers[..., part] = still
        if obstacle.below:
            # The obstacle is below the held object: lower it until its top meets the
            # object's bottom.
            numbers[..., part.start + 2] += bottoms[obstacle.below] - (
                _solid(obstacle, still).high[2] - still[2]
            )
    return numbers


def _posed_numbers(obstacle: Obstacle) -> Array:
    """Return the pose and size entries of an obstacle with a pose."""
    size = obstacle.size or (obstacle.radius or 0.0, obstacle.length or 0.0, 0.0)
    poses = (
        np.array([values])
        for values in (obstacle.position or _NOTHING, size, turned(*obstacle.rotation))
    )
    # Without the rotation of a box that has none.
    return posed_numbers(obstacle.kind, *poses)[0, : _count(obstacle)]


def posed_numbers(kind: str, position: Array, size: Array, rotation: Array) -> Array:
    """Return the pose and size entries of M rotated obstacles of a kind, shape (M, width).

    Positions and sizes (edge lengths, or radius and length) [m] have shape (M, 3),
    rotations (M, 3, 3).
    """
    turn = rotation.reshape(-1, 9)
    radius = size[:, :1]
    if kind == "box":
        return np.concatenate([position, size / 2, turn], axis=1)
    if kind == "mesh":
        return np.concatenate([position, turn], axis=1)
    if kind == "sphere":
        return np.concatenate([position, radius], axis=1)
    # Circumscribed prism: its corners are farther out than the cylinder.
    outer = radius / math.cos(math.pi / PRISM_SIDES) if kind == "cylinder" else radius
    return np.concatenate(
        [position, size[:, 1:2] / 2 * rotation[..., 2], outer], axis=1
    )


def solids_of(obstacles: Sequence[Obstacle], numbers: Array) -> list[Solid]:
    """Return the convex bodies of obstacles with these poses and sizes, shape (pose_width,)."""
    return [
        _solid(each, numbers[part])
        for each, part in zip(obstacles, number_slices(obstacles), strict=True)
    ]


def _solid(obstacle: Obstacle, numbers: Array) -> Solid:
    """Return the convex body of an obstacle.

    A cylinder becomes a prism of ``PRISM_SIDES`` sides that contains it.
    """
    if obstacle.upright:
        return _upright_box(obstacle, float(numbers[0]))
    position = numbers[:3]
    rest = numbers[3:]
    if obstacle.kind == "box":
        corners = 2 * CUBE * rest[:3]
        return _wrapped(
            position,
            corners @ rest[3:].reshape(3, 3).T if obstacle.is_turned else corners,
        )
    if obstacle.kind == "sphere":
        return _wrapped(position, np.zeros((1, 3)), float(rest[0]))
    if obstacle.kind == "capsule":
        return _wrapped(position, np.array([-rest[:3], rest[:3]]), float(rest[3]))
    if obstacle.kind == "mesh":
        return _wrapped(position, corners_of(obstacle.mesh) @ rest.reshape(3, 3).T)
    half = float(np.linalg.norm(rest[:3]))
    return _wrapped(
        position, prism(float(rest[3]), half) @ frame_along(rest[:3].tolist(), half).T
    )


def _wrapped(position: Array, corners: Array, radius: float = 0.0) -> Solid:
    low = position + corners.min(axis=0) - radius
    high = position + corners.max(axis=0) + radius
    return Solid(position, corners, low, high, radius)


def _upright_box(obstacle: Obstacle, top: float) -> Box:
    x = obstacle.x or Range(0, 0)
    y = obstacle.y or Range(0, 0)
    height = obstacle.height or UNBOUNDED_OBSTACLE_HEIGHT_M
    center = np.array([(x.low + x.high) / 2, (y.low + y.high) / 2, top - height / 2])
    corners = CUBE * np.array([x.high - x.low, y.high - y.low, height])
    return Box(
        center,
        corners,
        np.array([x.low, y.low, top - height]),
        np.array([x.high, y.high, top]),
    )
