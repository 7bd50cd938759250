"""Observations of the scenes of batches."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.loader.batch import Batch
from cnpgen.loader.scene_columns import OBSTACLE_POSES, problem_obstacles
from cnpgen.problems.scenes.observe import MAX_SEED, Scenes, observe
from cnpgen.robots.observation.observations import Observation
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import Scene
from cnpgen.store.dataset_spec import DatasetSpec


@dataclass(frozen=True)
class BatchObserver:
    """Observer of the scenes of batches, for ``dataset.batches(256, observe=...)``.

    Attributes:
        kind: See ``cnpgen.scenes.observe``.
        scenes: Function that returns the scenes of the rows of a batch, as ``observe`` takes them.
        seed: Seed of the points of clouds, which also depend on the rows of the batch.
    """

    kind: str | Observation
    scenes: Callable[[Batch], Scenes]
    seed: int = 0

    def __call__(self, batch: Batch) -> dict[str, NDArray[Any]]:
        """Observe the scenes of a batch."""
        seed = ((self.seed << 32) + zlib.crc32(batch.table.tobytes())) % MAX_SEED
        return observe(self.scenes(batch), self.kind, seed=seed)


def observer_of(spec: DatasetSpec, kind: str | Observation, *, seed: int) -> BatchObserver:
    """Return the observer of the scenes of a dataset, for batches with the field ``obstacle_poses``.

    Raises:
        DatasetError: The dataset has no scenes.
    """
    if not spec.scene_obstacles:
        text = f"{spec.name} has no scenes to observe: expected a dataset such as panda-scenes, or a BatchObserver"
        raise DatasetError(text)
    return BatchObserver(kind, partial(_scenes_of, problem_obstacles(spec)), seed)


def _scenes_of(obstacles: tuple[Obstacle, ...], batch: Batch) -> Scene:
    return Scene(obstacles, batch[OBSTACLE_POSES].astype(np.float64))
