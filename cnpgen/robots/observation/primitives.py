"""Obstacles of samples or scenes as arrays of boxes, spheres, cylinders and capsules, padded to equal numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import PARKED_POSITION_M, Scene
from cnpgen.robots.shape.convex_part import PRISM_SIDES
from cnpgen.robots.shape.hull import frames_along
from cnpgen.robots.solid import UNBOUNDED_OBSTACLE_HEIGHT_M, number_slices, place_obstacles, pose_width
from cnpgen.schema.keys import Range

Array = NDArray[np.float64]

KINDS = ("box", "sphere", "cylinder", "capsule")  # index: the code of a kind
NO_BODY = -1  # kind of the padding


@dataclass(frozen=True, eq=False)
class Primitives:
    """M bodies of simple shapes in the world frame; or those of N scenes, with a first axis of length N.

    Attributes:
        kinds: Index of each shape in ``KINDS``, shape (M,); -1 where a scene has fewer bodies.
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

    def __getitem__(self, which: int | slice | NDArray[Any]) -> Primitives:
        return Primitives(self.kinds[which], self.centers[which], self.rotations[which], self.sizes[which])


def primitives_of(obstacles: Sequence[Obstacle], numbers: Array) -> Primitives:
    """Return obstacles as primitives.

    Poses and sizes (``cnpgen.robots.solid``) have shape (pose_width,), or of N samples (N, pose_width), which gives
    arrays with a first axis of length N.

    Raises:
        UsageError: An obstacle is a mesh.
    """
    shape, rows, count = numbers.shape[:-1], np.atleast_2d(numbers), len(obstacles)
    kinds, centers = np.empty((len(rows), count), np.int64), np.empty((len(rows), count, 3))
    rotations, sizes = np.tile(np.eye(3), (len(rows), count, 1, 1)), np.zeros((len(rows), count, 3))
    for index, (obstacle, part) in enumerate(zip(obstacles, number_slices(obstacles), strict=True)):
        if obstacle.kind not in KINDS:
            raise UsageError(f"obstacle {obstacle.name!r} is a {obstacle.kind}, expected one of {', '.join(KINDS)}")
        kinds[:, index] = KINDS.index(obstacle.kind)
        _fill(obstacle, rows[:, part], centers[:, index], rotations[:, index], sizes[:, index])
    arrays = (array.reshape(*shape, *array.shape[1:]) for array in (kinds, centers, rotations, sizes))
    return Primitives(*arrays)  # type: ignore[arg-type]


def _fill(obstacle: Obstacle, numbers: Array, center: Array, rotation: Array, size: Array) -> None:
    """Fill in centers (N, 3), rotations (N, 3, 3), which are units, and sizes (N, 3), which are 0, of an obstacle."""
    if obstacle.upright:
        x, y = obstacle.x or Range(0, 0), obstacle.y or Range(0, 0)
        height = obstacle.height or UNBOUNDED_OBSTACLE_HEIGHT_M
        center[:, :2] = (x.low + x.high) / 2, (y.low + y.high) / 2
        center[:, 2] = numbers[:, 0] - height / 2
        size[:] = (x.high - x.low) / 2, (y.high - y.low) / 2, height / 2
        return
    center[:], rest = numbers[:, :3], numbers[:, 3:]
    if obstacle.kind == "box":
        size[:] = rest[:, :3]
        if obstacle.is_turned:
            rotation[:] = rest[:, 3:].reshape(-1, 3, 3)
    elif obstacle.kind == "sphere":
        size[:, 0] = rest[:, 0]
    else:
        half = np.linalg.norm(rest[:, :3], axis=1)
        rotation[:] = frames_along(rest[:, :3], half)
        size[:, 0] = rest[:, 3] * (math.cos(math.pi / PRISM_SIDES) if obstacle.kind == "cylinder" else 1.0)
        size[:, 1] = half


def scene_primitives(scenes: Scene | Sequence[Sequence[Obstacle]]) -> Primitives:
    """Return the bodies of N scenes, arrays with a first axis of length N; without obstacles parked below the robot.

    Raises:
        UsageError: An obstacle is a mesh.
    """
    if isinstance(scenes, Scene):
        bodies = primitives_of(scenes.obstacles, scenes.poses[:, : pose_width(scenes.obstacles)])
        bodies.kinds[bodies.centers[:, :, 2] <= PARKED_POSITION_M[2]] = NO_BODY
        return bodies
    known: dict[int, Primitives] = {}  # problems of one scene share its obstacles
    for obstacles in scenes:
        if id(obstacles) not in known:
            known[id(obstacles)] = primitives_of(obstacles, place_obstacles(obstacles))
    return padded([known[id(obstacles)] for obstacles in scenes])


def padded(scenes: Sequence[Primitives]) -> Primitives:
    """Return the bodies of N scenes as arrays with a first axis of length N, padded with bodies of kind -1."""
    shape = len(scenes), max(map(len, scenes), default=0)
    kinds, centers = np.full(shape, NO_BODY, np.int64), np.zeros((*shape, 3))
    rotations, sizes = np.tile(np.eye(3), (*shape, 1, 1)), np.zeros((*shape, 3))
    for index, scene in enumerate(scenes):
        count = len(scene)
        kinds[index, :count], centers[index, :count] = scene.kinds, scene.centers
        rotations[index, :count], sizes[index, :count] = scene.rotations, scene.sizes
    return Primitives(kinds, centers, rotations, sizes)


def bodies_of(scenes: Primitives, index: int) -> Primitives:
    """Return the bodies of one of N scenes, without padding."""
    scene = scenes[index]
    return scene[scene.kinds >= 0]
