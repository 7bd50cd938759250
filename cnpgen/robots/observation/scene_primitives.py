"""Scenes as arrays of primitives, padded to the largest number of bodies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cnpgen.robots.observation.primitives import Primitives, primitives_of
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import PARKED_POSITION_M, Scene
from cnpgen.robots.solid import place_obstacles, pose_width

NO_BODY = -1  # kind of the padding


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
