"""Obstacles of one sample as arrays of boxes, spheres, cylinders and capsules with poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.convex_part import PRISM_SIDES
from cnpgen.robots.shape.hull import frame_along
from cnpgen.robots.solid import UNBOUNDED_OBSTACLE_HEIGHT_M, number_slices
from cnpgen.schema.keys import Range

Array = NDArray[np.float64]

KINDS = ("box", "sphere", "cylinder", "capsule")  # index: the code of a kind


@dataclass(frozen=True, eq=False)
class Primitives:
    """M bodies of simple shapes in the world frame.

    Attributes:
        kinds: Index of each shape in ``KINDS``, shape (M,).
        centers: Centers [m], shape (M, 3).
        rotations: Rotation matrices; columns are the axes of a body, shape (M, 3, 3).
        sizes: Sizes [m], shape (M, 3): half the edge lengths of a box; otherwise the radius, half the length along z
            (of a capsule without its round ends; 0 for a sphere), and 0.
    """

    kinds: NDArray[np.int64]
    centers: Array
    rotations: Array
    sizes: Array

    def __len__(self) -> int:
        return len(self.kinds)

    def __getitem__(self, which: NDArray[Any]) -> Primitives:
        return Primitives(self.kinds[which], self.centers[which], self.rotations[which], self.sizes[which])

    def areas(self) -> Array:
        """Return the areas of the surfaces [m^2], shape (M,)."""
        a, b, c = self.sizes.T
        by_kind = [
            8 * (a * b + b * c + c * a),
            4 * np.pi * a**2,
            2 * np.pi * a * (a + 2 * b),
            4 * np.pi * a * (a + b),
        ]
        return np.choose(self.kinds, by_kind)


def primitives_of(obstacles: Sequence[Obstacle], numbers: Array) -> Primitives:
    """Return obstacles as primitives.

    Args:
        obstacles: The obstacles.
        numbers: Their poses and sizes (``cnpgen.robots.solid``), shape (pose_width,).

    Raises:
        UsageError: An obstacle is a mesh.
    """
    rows = [_row(obstacle, numbers[part]) for obstacle, part in zip(obstacles, number_slices(obstacles), strict=True)]
    kinds, centers, rotations, sizes = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Primitives(
        np.array(kinds, np.int64),
        np.array(centers).reshape(-1, 3),
        np.array(rotations).reshape(-1, 3, 3),
        np.array(sizes).reshape(-1, 3),
    )


def _row(obstacle: Obstacle, numbers: Array) -> tuple[int, Array, Array, Any]:
    """Return kind, center, rotation and size of an obstacle."""
    if obstacle.kind not in KINDS:
        raise UsageError(f"obstacle {obstacle.name!r} is a {obstacle.kind}, expected one of {', '.join(KINDS)}")
    kind = KINDS.index(obstacle.kind)
    if obstacle.upright:
        x, y = obstacle.x or Range(0, 0), obstacle.y or Range(0, 0)
        height = obstacle.height or UNBOUNDED_OBSTACLE_HEIGHT_M
        low, high = np.array([x.low, y.low, numbers[0] - height]), np.array([x.high, y.high, numbers[0]])
        return kind, (low + high) / 2, np.eye(3), (high - low) / 2
    center, rest = numbers[:3], numbers[3:]
    if obstacle.kind == "box":
        return kind, center, rest[3:].reshape(3, 3) if obstacle.is_turned else np.eye(3), rest[:3]
    if obstacle.kind == "sphere":
        return kind, center, np.eye(3), (rest[0], 0.0, 0.0)
    half = float(np.linalg.norm(rest[:3]))
    radius = rest[3] * (math.cos(math.pi / PRISM_SIDES) if obstacle.kind == "cylinder" else 1.0)
    return kind, center, frame_along(rest[:3].tolist(), half), (radius, half, 0.0)
