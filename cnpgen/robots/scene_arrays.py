"""Scene tables of datasets as obstacles, and as poses and sizes in the layout of a problem."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cnpgen.errors import UsageError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import PARKED_POSITION_M
from cnpgen.robots.shape.convex_part import PRISM_SIDES
from cnpgen.robots.shape.hull import Array
from cnpgen.robots.solid import number_slices, place_obstacles, pose_width
from cnpgen.store.scene_table import NO_OBSTACLE, OBSTACLE_KINDS, SceneTable


def sample_obstacles(obstacles: Sequence[Obstacle]) -> dict[str, list[int]]:
    """Return the obstacles that samples place: kind -> indices; they are parked far below the robot."""
    parked: dict[str, list[int]] = {kind: [] for kind in OBSTACLE_KINDS}
    for index, obstacle in enumerate(obstacles):
        if obstacle.position == PARKED_POSITION_M and obstacle.kind in parked:
            parked[obstacle.kind].append(index)
    return parked


def scene_capacity(obstacles: Sequence[Obstacle]) -> int:
    """Return the number of obstacles that samples place."""
    return sum(map(len, sample_obstacles(obstacles).values()))


def make_scene_table(layouts: Sequence[Sequence[Obstacle]], families: Sequence[int], obstacles: int) -> SceneTable:
    """Return the obstacles of S scenes as arrays; scene IDs are the indices of the scenes.

    Args:
        layouts: Obstacles of each scene, none upright, below an object, or a mesh.
        families: Family of each scene.
        obstacles: Largest number of obstacles O, at least that of every scene.
    """
    count = np.array([len(layout) for layout in layouts], np.int64)
    real = np.arange(obstacles) < count[:, None]
    flat = [obstacle for layout in layouts for obstacle in layout]
    kind = np.full(real.shape, NO_OBSTACLE, np.int64)
    size, position, quaternion = (np.zeros((*real.shape, width)) for width in (3, 3, 4))
    quaternion[..., 0] = 1.0
    kind[real] = [OBSTACLE_KINDS.index(obstacle.kind) for obstacle in flat]
    if flat:
        size[real] = [obstacle.size or (obstacle.radius, obstacle.length or 0.0, 0.0) for obstacle in flat]
        position[real] = [obstacle.position for obstacle in flat]
        quaternion[real] = _quaternions(np.array([obstacle.rotation for obstacle in flat]))
    return SceneTable(np.arange(len(layouts)), np.array(families, np.int64), count, kind, size, position, quaternion)


def _quaternions(rotation: Array) -> Array:
    """Return the quaternions (w, x, y, z) of roll, pitch and yaw about fixed axes [rad], shape (M, 3) -> (M, 4)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rotation.T / 2), np.sin(rotation.T / 2)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return np.stack([w, x, y, z], axis=1)


def rotations_of(table: SceneTable) -> Array:
    """Return the rotation matrices of the obstacles, whose columns are their axes, shape (S, O, 3, 3)."""
    quaternion = table.obstacle_quaternion.astype(np.float64)
    return rotation_matrices(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True))


def rotation_matrices(wxyz: Array) -> Array:
    """Return the rotation matrices of unit quaternions (w, x, y, z), shape (..., 4) -> (..., 3, 3)."""
    w, x, y, z = np.moveaxis(wxyz, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def scene_poses(obstacles: Sequence[Obstacle], table: SceneTable) -> Array:
    """Return the poses and sizes of a problem's obstacles in every scene (``cnpgen.robots.solid``), shape (S, width).

    The obstacles of a scene take the places of the parked obstacles of their kind, in order; the others stay parked.
    """
    poses = np.tile(place_obstacles(obstacles), (len(table), 1))
    slices, rotations = number_slices(obstacles), rotations_of(table)
    position, size = table.obstacle_position.astype(np.float64), table.obstacle_size.astype(np.float64)
    for code, (kind, places) in enumerate(sample_obstacles(obstacles).items()):
        scenes, entries = np.nonzero(table.obstacle_kind == code)
        rank = np.cumsum(table.obstacle_kind == code, axis=1)[scenes, entries] - 1
        if len(rank) and rank.max() >= len(places):
            raise UsageError(f"a scene has {rank.max() + 1} obstacles of the kind {kind}, expected {len(places)}")
        if not len(rank):
            continue
        numbers = _numbers(kind, position[scenes, entries], size[scenes, entries], rotations[scenes, entries])
        first = np.array([slices[place].start for place in places])[rank]
        poses[scenes[:, None], first[:, None] + np.arange(numbers.shape[1])] = numbers
    assert poses.shape[1] == pose_width(obstacles)
    return poses


def _numbers(kind: str, position: Array, size: Array, rotation: Array) -> Array:
    """Return the poses and sizes of M obstacles of one kind, shape (M, width)."""
    if kind == "box":
        return np.concatenate([position, size / 2, rotation.reshape(-1, 9)], axis=1)
    radius = size[:, :1]
    if kind == "sphere":
        return np.concatenate([position, radius], axis=1)
    outer = radius / math.cos(math.pi / PRISM_SIDES) if kind == "cylinder" else radius
    return np.concatenate([position, size[:, 1:2] / 2 * rotation[..., 2], outer], axis=1)
