"""Obstacles from point clouds: boxes that contain all points with their radius."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import Array, Mask
from cnpgen.errors import UsageError, counted
from cnpgen.problems.scenes.scene_problem import MAX_SCENE_OBSTACLES
from cnpgen.robots.obstacle import Obstacle
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import check_range, integer, number, numbers
from cnpgen.schema.units import PLAUSIBLE_MAX, suggested_unit

Voxels = NDArray[np.int64]

MAX_POINTS = 1_000_000
MAX_GRID_VOXELS = 1 << 24  # of the grid around all points
VOXEL_GROWTH = 1.25  # of the edge length, until there are few enough boxes
MIN_VOXEL_M = 0.01
MAX_POINT_SIZE_M = 1.0  # radius of points and edge length of voxels


@checked_arguments
def obstacles_of_points(
    points: ArrayLike,
    *,
    radius: float,
    resolution: float = 0.02,
    max_obstacles: int = MAX_SCENE_OBSTACLES,
    name: str = "points",
) -> tuple[Obstacle, ...]:
    """Cover a point cloud by boxes along the world's axes.

    Each point with its radius is inside one box. Boxes are unions of occupied voxels,
    shrunk to their points, so that they exceed the points by at most the edge length of
    a voxel, beside the radius.

    Args:
        points: Points in the frame of the robot's base [m], shape (N, 3), without
            points of the robot itself.
        radius: Radius of every point [m].
        resolution: Edge length of the voxels [m]; it grows where there would be more
            than ``max_obstacles`` boxes.
        max_obstacles: Largest number of boxes.
        name: Name of the boxes, which are numbered.

    Raises:
        UsageError: A point is not finite, or an argument is out of its range.
    """
    cloud = _checked_cloud(points)
    check_range("radius", number("radius", radius), 1e-6, MAX_POINT_SIZE_M, "m")
    size = number("resolution", resolution)
    check_range("resolution", size, MIN_VOXEL_M, MAX_POINT_SIZE_M, "m")
    least = integer("max_obstacles", max_obstacles, least=1)
    # The grid of extent / edge voxels per axis has at most MAX_GRID_VOXELS: edge^3 >=
    # volume / maximum.
    volume = np.prod(np.ptp(cloud, axis=0) + resolution)
    edge = max(resolution, float((volume / MAX_GRID_VOXELS) ** (1 / 3)))
    # The number of boxes is only known once they are built.
    boxes = _boxes(cloud, edge)
    while len(boxes) > least:
        edge *= VOXEL_GROWTH
        boxes = _boxes(cloud, edge)
    return tuple(
        _obstacle(f"{name} {index}", low, high, radius)
        for index, (low, high) in enumerate(boxes, 1)
    )


def _checked_cloud(points: ArrayLike) -> Array:
    """Return points as an array of shape (N, 3); raise UsageError for another shape or values that are not plausible."""
    cloud = numbers("points", points)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not len(cloud):
        raise UsageError(
            f"must have shape (N, 3) with N > 0, got {cloud.shape}", argument="points"
        )
    if len(cloud) > MAX_POINTS:
        raise UsageError(
            f"has {counted(len(cloud), 'point')}, expected at most {MAX_POINTS:,}",
            argument="points",
        )
    limit = PLAUSIBLE_MAX["m"]
    valid = (np.abs(cloud) <= limit).all(axis=1)  # false for nan
    if not valid.all():
        row = int(np.argmin(valid))
        hint = suggested_unit(float(np.abs(cloud[row]).max()), "m", high=limit)
        text = f"must be finite and at most {limit:g} m, got {cloud[row]} in point {row}{hint}"
        raise UsageError(text, argument="points")
    return cloud


def _obstacle(name: str, low: Array, high: Array, radius: float) -> Obstacle:
    x, y, z = ((low + high) / 2).tolist()
    # The box of the centers grows by the radius to all sides.
    a, b, c = (high - low + 2 * radius).tolist()
    return Obstacle(name=name, position=(x, y, z), size=(a, b, c))


def _boxes(points: Array, edge: float) -> list[tuple[Array, Array]]:
    """Return lower and upper corners of boxes that contain all points."""
    voxels = ((points - points.min(axis=0)) / edge).astype(np.int64)
    occupied = np.zeros(voxels.max(axis=0) + 1, bool)
    occupied[tuple(voxels.T)] = True
    # Box of each voxel, from which the box of each point follows.
    owner = np.full(occupied.shape, -1)
    count = 0
    for voxel in np.argwhere(occupied):
        # Voxels of an earlier block are no longer occupied.
        if occupied[tuple(voxel)]:
            block = _grown(occupied, voxel)
            owner[block] = count
            occupied[block] = False
            count += 1
    index = owner[tuple(voxels.T)]
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    # Boxes shrink from the voxels to the points in them.
    np.minimum.at(low, index, points)
    np.maximum.at(high, index, points)
    return list(zip(low, high, strict=True))


def _grown(occupied: Mask, voxel: Voxels) -> tuple[slice, ...]:
    """Return the largest block of occupied voxels that begins at a voxel, grown along one axis after the other."""
    stop = voxel + 1
    # The longest axis of the grid first.
    for axis in np.argsort(occupied.shape)[::-1]:
        while stop[axis] < occupied.shape[axis]:
            layer = [slice(begin, end) for begin, end in zip(voxel, stop, strict=True)]
            layer[axis] = slice(stop[axis], stop[axis] + 1)
            # A block contains occupied voxels only, so that free space stays free.
            if not occupied[tuple(layer)].all():
                break
            stop[axis] += 1
    return tuple(slice(begin, end) for begin, end in zip(voxel, stop, strict=True))
