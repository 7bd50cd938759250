"""The scene of samples: their obstacles with poses and sizes.

Scene tables of datasets in the same layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray, Array
from cnpgen.errors import UsageError, counted
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.convex_solid import Solid
from cnpgen.robots.obstacle_shapes.obstacle_shape import shape_class
from cnpgen.robots.shape.hull import MAX_COORDINATE_M
from cnpgen.robots.solid import (
    number_slices,
    place_obstacles,
    pose_width,
    solids_of,
)
from cnpgen.schema.arguments import integer
from cnpgen.schema.html_table import html_table
from cnpgen.store.scene_table import NO_OBSTACLE, OBSTACLE_KINDS, SceneTable

# Of obstacles that a sample with fewer obstacles does not have.
PARKED_POSITION_M = 0.0, 0.0, -100.0


class SampleIndexError(UsageError, IndexError):
    """Index of a sample that does not exist."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The obstacles of N samples.

    Attributes:
        obstacles: The obstacles, the same for all samples.
        poses: Poses and sizes of the obstacles of each sample
            (``cnpgen.robots.solid``), shape (N, width).
    """

    obstacles: tuple[Obstacle, ...]
    poses: Array

    def __post_init__(self) -> None:
        obstacles: Any = self.obstacles
        poses: Any = self.poses
        if not isinstance(obstacles, tuple):
            raise UsageError(
                f"must be a tuple of obstacles, got {obstacles!r:.60}",
                argument="obstacles",
            )
        if poses is None or isinstance(poses, int | float | str):
            # JAX puts other objects in the place of arrays
            raise UsageError(
                f"must be an array of shape (N, width), got {poses!r:.60}",
                argument="poses",
            )

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int | slice | Sequence[int] | AnyArray) -> Scene:
        """Select samples; an integer selects one sample and keeps the first axis."""
        rows: Any = index
        if isinstance(index, int):
            # Ends a loop over the samples, too.
            self._check_sample(index, "index")
            rows = slice(index, index + 1 or None)
        elif isinstance(index, tuple):
            # NumPy reads a tuple as one index of each axis
            rows = list(index)
        try:
            return Scene(self.obstacles, self.poses[rows])
        except IndexError as error:
            raise SampleIndexError(
                f"samples are selected by numbers, a mask or a slice: {error}",
                concerns="index",
            ) from error

    def _repr_html_(self) -> str:
        """Show the obstacles of the first sample."""
        caption = f"{counted(len(self), 'sample')} with {counted(len(self.obstacles), 'obstacle')}"
        bodies = zip(self.obstacles, self.bodies(), strict=True) if len(self) else ()
        rows = (
            (item.name, item.kind, *np.round((body.position, body.low, body.high), 4))
            for item, body in bodies
        )
        head = "obstacle", "kind", "center [m]", "lower corner [m]", "upper corner [m]"
        return html_table(caption, head, rows)

    def with_poses(self, poses: Array) -> Scene:
        """Return the scene with other poses and sizes of the obstacles; values for a constraint are kept.

        Args:
            poses: Poses and sizes of the obstacles of each sample, shape (N,
                ``pose_width(obstacles)``).

        Raises:
            UsageError: The shape is wrong, or a number is not finite or larger than
                ``MAX_COORDINATE_M``.
        """
        expected = len(self), pose_width(self.obstacles)
        if poses.shape != expected:
            raise UsageError(
                f"must have shape {expected} for {len(self.obstacles)} obstacles, got {poses.shape}",
                argument="obstacle_poses",
            )
        if not (np.abs(poses) <= MAX_COORDINATE_M).all():
            # Also false for nan.
            sample, entry = np.argwhere(~(np.abs(poses) <= MAX_COORDINATE_M))[
                0
            ].tolist()
            value = poses[sample, entry]
            raise UsageError(
                f"must be finite and at most {MAX_COORDINATE_M:g}, got {value:g} at sample {sample}",
                argument="obstacle_poses",
            )
        return Scene(
            self.obstacles,
            np.concatenate([poses, self.poses[:, expected[1] :]], axis=1),
        )

    def astype(self, dtype: str) -> Scene:
        """Return the scene in another float type."""
        return Scene(self.obstacles, self.poses.astype(dtype))

    @property
    def lanes(self) -> Array:
        """Poses and sizes as kernels take them, shape (width, N)."""
        return np.ascontiguousarray(self.poses.T)

    def bodies(self, sample: int = 0) -> list[Solid]:
        """Return the obstacles of one sample as convex bodies in the world frame."""
        self._check_sample(sample := integer("sample", sample), "sample")
        return solids_of(self.obstacles, self.poses[sample])

    def _check_sample(self, sample: int, argument: str) -> None:
        if not -len(self) <= sample < len(self):
            raise SampleIndexError(
                f"there is no sample {sample}: {counted(len(self), 'sample')}, numbered from 0",
                concerns=argument,
            )


def sample_obstacles(obstacles: Sequence[Obstacle]) -> dict[str, list[int]]:
    """Return the obstacles that samples place: kind -> indices.

    They are parked far below the robot.
    """
    parked: dict[str, list[int]] = {kind: [] for kind in OBSTACLE_KINDS}
    for index, obstacle in enumerate(obstacles):
        if obstacle.position == PARKED_POSITION_M and obstacle.kind in parked:
            parked[obstacle.kind].append(index)
    return parked


def scene_capacity(obstacles: Sequence[Obstacle]) -> int:
    """Return the number of obstacles that samples place."""
    return sum(map(len, sample_obstacles(obstacles).values()))


def make_scene_table(
    layouts: Sequence[Sequence[Obstacle]], families: Sequence[int], obstacles: int
) -> SceneTable:
    """Return the obstacles of S scenes, at most O each, as arrays; scene IDs are the indices of the scenes.

    No obstacle is upright, below an object, or a mesh.
    """
    count = np.array([len(layout) for layout in layouts], np.int64)
    real = np.arange(obstacles) < count[:, None]
    flat = [obstacle for layout in layouts for obstacle in layout]
    kind = np.full(real.shape, NO_OBSTACLE, np.int64)
    size, position, quaternion = (np.zeros((*real.shape, width)) for width in (3, 3, 4))
    quaternion[..., 0] = 1.0
    kind[real] = [OBSTACLE_KINDS.index(obstacle.kind) for obstacle in flat]
    if flat:
        size[real] = [
            obstacle.size or (obstacle.radius, obstacle.length or 0.0, 0.0)
            for obstacle in flat
        ]
        position[real] = [obstacle.position for obstacle in flat]
        quaternion[real] = _quaternions(
            np.array([obstacle.rotation for obstacle in flat])
        )
    return SceneTable(
        np.arange(len(layouts)),
        np.array(families, np.int64),
        count,
        kind,
        size,
        position,
        quaternion,
    )


def _quaternions(rotation: Array) -> Array:
    """Return the quaternions (w, x, y, z) of roll, pitch and yaw about fixed axes [rad], shape (M, 3) -> (M, 4)."""
    cr, cp, cy = np.cos(rotation.T / 2)
    sr, sp, sy = np.sin(rotation.T / 2)
    w = cr * cp * cy + sr * sp * sy
    x = sr * cp * cy - cr * sp * sy
    y = cr * sp * cy + sr * cp * sy
    z = cr * cp * sy - sr * sp * cy
    return np.stack([w, x, y, z], axis=1)


def rotations_of(table: SceneTable) -> Array:
    """Return the rotation matrices of the obstacles, whose columns are their axes, shape (S, O, 3, 3)."""
    quaternion = table.obstacle_quaternion.astype(np.float64)
    return rotation_matrices(
        quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    )


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

    The obstacles of a scene take the places of the parked obstacles of their kind, in
    order; the others stay parked.
    """
    poses = np.tile(place_obstacles(obstacles), (len(table), 1))
    slices = number_slices(obstacles)
    rotations = rotations_of(table)
    position = table.obstacle_position.astype(np.float64)
    size = table.obstacle_size.astype(np.float64)
    for code, (kind, places) in enumerate(sample_obstacles(obstacles).items()):
        scenes, entries = np.nonzero(table.obstacle_kind == code)
        rank = np.cumsum(table.obstacle_kind == code, axis=1)[scenes, entries] - 1
        if len(rank) and rank.max() >= len(places):
            raise UsageError(
                f"a scene has {rank.max() + 1} obstacles of the kind {kind}, expected {len(places)}"
            )
        if not len(rank):
            continue
        numbers = shape_class(kind).numbers(
            position[scenes, entries],
            size[scenes, entries],
            rotations[scenes, entries],
        )
        first = np.array([slices[place].start for place in places])[rank]
        poses[scenes[:, None], first[:, None] + np.arange(numbers.shape[1])] = numbers
    assert poses.shape[1] == pose_width(obstacles)
    return poses
