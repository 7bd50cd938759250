"""Obstacles as convex bodies, and the vectors of their poses and sizes.

Kernels and judges receive poses and sizes of obstacles per sample, in m. The entries of
one obstacle are, of an upright box given by ``x`` and ``y``, the height of its upper
face; of any other its position, and what its shape appends (``obstacle_shapes``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.convex_solid import Solid
from cnpgen.robots.shape.convex_part import turned

_NOTHING = (0.0, 0.0, 0.0)


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
        part.start + each.form.height_place
        for each, part in zip(obstacles, parts, strict=True)
    ]


def _count(obstacle: Obstacle) -> int:
    return obstacle.form.widths[obstacle.is_turned]


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
                obstacle.form.solid(still).high[2] - still[2]
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
    return obstacle.form.numbers(*poses)[0, : _count(obstacle)]


def solids_of(obstacles: Sequence[Obstacle], numbers: Array) -> list[Solid]:
    """Return the convex bodies of obstacles with these poses and sizes, shape (pose_width,)."""
    return [
        each.form.solid(numbers[part])
        for each, part in zip(obstacles, number_slices(obstacles), strict=True)
    ]
