"""A batch of rows: a mapping from field names to arrays, which are views of one packed table, and its observations."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import DatasetError, counted
from cnpgen.loader.row_format import Columns, Normalization
from cnpgen.loader.shard_reader import problem_obstacles
from cnpgen.problems.scenes.observe import MAX_SEED, Scenes, observe
from cnpgen.robots.observation.observations import Observation
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import Scene
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.scene_table import OBSTACLE_POSES


@dataclass(frozen=True, eq=False)
class Batch(Mapping[str, AnyArray]):
    """B rows. The arrays belong to the batch alone and may be changed.

    ``batch["start_q"]`` has shape (B, width), or (B,) for a scalar field. Float fields
    are views of ``table``. ``dict(batch)`` is a plain dict of all fields and
    observations.

    Attributes:
        table: Float fields side by side, C-contiguous, shape (B, D).
        layout: Fields and their columns in the table.
        integers: Integer fields, int64, shape (B, width) or (B,).
        normalization: Normalization of the float fields; None if they are in their
            units.
        observations: Results of ``observe`` of :meth:`Dataset.batches`, with a first
            axis of length B.
    """

    table: AnyArray
    layout: Columns
    integers: Mapping[str, AnyArray]
    normalization: Normalization | None = None
    observations: Mapping[str, AnyArray] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<batch of {counted(self.rows, 'row')}, {self.table.dtype}: {self.layout.summary}>"

    @property
    def columns(self) -> dict[str, slice]:
        """Field name -> columns of the table."""
        return self.layout.slices

    @property
    def rows(self) -> int:
        """Number of rows B."""
        return len(self.table)

    def __getitem__(self, name: str) -> AnyArray:
        if name in self.observations:
            return self.observations[name]
        if name in self.integers:
            return self.integers[name]
        part = self.layout.slices[name]
        # A column of a scalar field, shape (B,), or the columns of a vector, (B,
        # width).
        return self.table[:, part.start if name in self.layout.scalars else part]

    def __iter__(self) -> Iterator[str]:
        return chain((column.name for column in self.layout.fields), self.observations)

    def __len__(self) -> int:
        return len(self.layout.fields) + len(self.observations)


@dataclass(frozen=True)
class BatchObserver:
    """Observer of the scenes of batches, for ``dataset.batches(256, observe=...)``.

    Attributes:
        kind: See ``cnpgen.scenes.observe``.
        scenes: Function that returns the scenes of the rows of a batch, as ``observe``
            takes them.
        seed: Seed of the points of clouds, which also depend on the rows of the batch.
    """

    kind: str | Observation
    scenes: Callable[[Batch], Scenes]
    seed: int = 0

    def __call__(self, batch: Batch) -> dict[str, AnyArray]:
        """Observe the scenes of a batch."""
        # Points depend on the content of the batch: equal batches are observed equally,
        # others differently.
        seed = ((self.seed << 32) + zlib.crc32(batch.table.tobytes())) % MAX_SEED
        return observe(self.scenes(batch), self.kind, seed=seed)


def observer_of(
    spec: DatasetSpec, kind: str | Observation, *, seed: int
) -> BatchObserver:
    """Return the observer of the scenes of a dataset, for batches with the field ``obstacle_poses``."""
    if not spec.scene_obstacles:
        raise DatasetError(
            f"{spec.name} has no scenes to observe: expected a dataset such as panda-scenes, or a "
            "BatchObserver"
        )
    return BatchObserver(kind, partial(_scenes_of, problem_obstacles(spec)), seed)


def _scenes_of(obstacles: tuple[Obstacle, ...], batch: Batch) -> Scene:
    return Scene(obstacles, batch[OBSTACLE_POSES].astype(np.float64))
