"""The scene of samples: their obstacles with poses and sizes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.solid import Solid, solids_of

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scene:
    """The obstacles of N samples, created where samples enter and passed along.

    Attributes:
        obstacles: The obstacles, the same for all samples.
        poses: Poses and sizes of the obstacles of each sample (``cnpgen.robots.solid``), shape (N, width).
    """

    obstacles: tuple[Obstacle, ...]
    poses: Array

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int | slice | Sequence[int] | NDArray[Any]) -> "Scene":
        """Select samples; an integer selects one sample and keeps the first axis."""
        rows = slice(index, index + 1 or None) if isinstance(index, int) else index
        return Scene(self.obstacles, self.poses[rows])

    @property
    def lanes(self) -> Array:
        """Poses and sizes as kernels take them, shape (width, N)."""
        return np.ascontiguousarray(self.poses.T)

    def bodies(self, sample: int = 0) -> list[Solid]:
        """Return the obstacles of one sample as convex bodies in the world frame."""
        return solids_of(self.obstacles, self.poses[sample])
