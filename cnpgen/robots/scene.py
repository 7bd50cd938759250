"""The scene of samples: their obstacles with poses and sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.hull import MAX_COORDINATE_M, Array
from cnpgen.robots.solid import Solid, pose_width, solids_of
from cnpgen.schema.arguments import integer

PARKED_POSITION_M = (0.0, 0.0, -100.0)  # of obstacles that a sample with fewer obstacles does not have


class SampleIndexError(UsageError, IndexError):
    """Index of a sample that does not exist."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The obstacles of N samples, created where samples enter and passed along.

    Attributes:
        obstacles: The obstacles, the same for all samples.
        poses: Poses and sizes of the obstacles of each sample (``cnpgen.robots.solid``), shape (N, width).
    """

    obstacles: tuple[Obstacle, ...]
    poses: Array

    def __post_init__(self) -> None:
        obstacles: Any = self.obstacles
        poses: Any = self.poses
        if not isinstance(obstacles, tuple):
            raise UsageError(f"must be a tuple of obstacles, got {obstacles!r:.60}", argument="obstacles")
        if poses is None or isinstance(poses, int | float | str):  # JAX puts other objects in the place of arrays
            raise UsageError(f"must be an array of shape (N, width), got {poses!r:.60}", argument="poses")

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int | slice | Sequence[int] | NDArray[Any]) -> Scene:
        """Select samples; an integer selects one sample and keeps the first axis."""
        rows = slice(index, index + 1 or None) if isinstance(index, int) else index
        if isinstance(index, int):  # ends a loop over the samples, too
            self._check_sample(index, "index")
        try:
            return Scene(self.obstacles, self.poses[rows])
        except IndexError as error:
            raise SampleIndexError(
                f"samples are selected by numbers, a mask or a slice: {error}", concerns="index"
            ) from error

    def with_poses(self, poses: Array) -> Scene:
        """Return the scene with other poses and sizes of the obstacles; values for a constraint are kept.

        Args:
            poses: Poses and sizes of the obstacles of each sample, shape (N, ``pose_width(obstacles)``).

        Raises:
            UsageError: The shape is wrong, or a number is not finite or larger than ``MAX_COORDINATE_M``.
        """
        expected = len(self), pose_width(self.obstacles)
        if poses.shape != expected:
            raise UsageError(
                f"must have shape {expected} for {len(self.obstacles)} obstacles, got {poses.shape}",
                argument="obstacle_poses",
            )
        if not (np.abs(poses) <= MAX_COORDINATE_M).all():  # also false for nan
            sample, entry = np.argwhere(~(np.abs(poses) <= MAX_COORDINATE_M))[0].tolist()
            value = poses[sample, entry]
            raise UsageError(
                f"must be finite and at most {MAX_COORDINATE_M:g}, got {value:g} at sample {sample}",
                argument="obstacle_poses",
            )
        return Scene(self.obstacles, np.concatenate([poses, self.poses[:, expected[1] :]], axis=1))

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
            text = f"there is no sample {sample}: {len(self)} samples are numbered from 0"
            raise SampleIndexError(text, concerns=argument)
