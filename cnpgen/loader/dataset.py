"""A dataset opened for training: its rows as batches, arrays, tables or one by one.

Its fields and statistics.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from cnpgen.arrays import AnyArray
from cnpgen.errors import DatasetError, MissingExtraError, UsageError, lacks
from cnpgen.loader.batch import observer_of
from cnpgen.loader.batch_options import BatchOptions
from cnpgen.loader.batches import Batches, BatchPartition, Observe, checked_position
from cnpgen.loader.gather import Split, gather
from cnpgen.loader.row_format import (
    Normalization,
    RowFormat,
    make_normalization,
    make_row_format,
    select_columns,
)
from cnpgen.loader.shard_reader import (
    Rows,
    ShardReader,
    SplitShards,
    problem_obstacles,
    scene_fields,
)
from cnpgen.robots.observation.observations import Observation
from cnpgen.robots.scene import Scene
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.html_table import html_table
from cnpgen.schema.old_keywords import with_old_keywords
from cnpgen.store.checked_shard import Shard
from cnpgen.store.dataset_spec import DatasetSpec, StoredProblem
from cnpgen.store.field import Field
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.store.statistics import FieldStatistics

LIBRARIES = ("polars", "pandas")  # of frames


@dataclass(frozen=True, eq=False)
class Dataset:
    """The rows of a dataset. It can be pickled, forked and used by several threads.

    In all methods, ``fields`` are field names in the requested order; by default, all
    float fields except for diagnostics. Fields of scenes, such as ``obstacle_poses``,
    have to be named. ``normalize`` may be the :class:`Normalization` of another
    dataset. ``dtype`` is the type of float fields, "float32" or "float64". Integer
    fields are int64; they and those of scenes are never normalized.

    Attributes:
        folder: Folder of the dataset.
        spec: Specification of the dataset: recipe, seed, robot, versions.
        fingerprint: Fingerprint of the existing rows; equal rows have equal
            fingerprints.
        shards: Split -> existing shards.
        statistics: Split -> field -> statistics of its columns, in the unit of the
            field.
        reader: Reader of the shards.
    """

    folder: Path
    spec: DatasetSpec
    fingerprint: str
    shards: Mapping[str, tuple[Shard, ...]]
    statistics: Mapping[str, Mapping[str, FieldStatistics]]
    reader: ShardReader

    def __repr__(self) -> str:
        rows = ", ".join(f"{rows:,} {split}" for split, rows in self.splits.items())
        return f"<{self.spec.name} {self.spec.version} in {self.folder}: {rows}>"

    def _repr_html_(self) -> str:
        head = ("field", "unit", "columns", "description", "role")
        rows = (
            (
                field.name,
                field.unit,
                ", ".join(field.names),
                field.long_name,
                field.role,
            )
            for field in self.fields.values()
        )
        return html_table(repr(self), head, rows)

    @cached_property
    def splits(self) -> dict[str, int]:
        """Split -> number of existing rows."""
        return {
            split: sum(shard.rows for shard in shards)
            for split, shards in self.shards.items()
        }

    @cached_property
    def fields(self) -> dict[str, Field]:
        """Name -> field, with unit, role, and names and limits of its columns.

        Those of scenes last.
        """
        return {
            field.name: field for field in (*self.spec.fields, *scene_fields(self.spec))
        }

    @property
    def problem(self) -> StoredProblem:
        """The problem of the dataset, for example for ``PlanLoss(dataset.problem)``.

        Raises:
            DatasetError: The specification does not contain its problem.
        """
        return self.spec.problem

    @cached_property
    def normalization(self) -> Normalization | None:
        """Means and standard deviations of the training rows.

        None if there are none.
        """
        statistics = self.statistics.get("train")
        return make_normalization(statistics, self.spec.fields) if statistics else None

    @checked_arguments
    def __getitem__(self, split: str) -> Split:
        return Split(self._source(split), self._row_format())

    def __contains__(self, split: object) -> bool:
        return split in self.shards

    def __iter__(self) -> Iterator[str]:
        return iter(self.shards)

    def __len__(self) -> int:
        return len(self.shards)

    @checked_arguments
    def batches(
        self,
        batch_size: int,
        *,
        split: str = "train",
        seed: int = 0,
        epoch: int = 0,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = True,
        dtype: DTypeLike = "float32",
        observe: Observe | Observation | str | None = None,
        options: BatchOptions | None = None,
        **old_keywords: Any,
    ) -> Batches:
        """Return the batches of a split, in an order that depends on seed and epoch only.

        Args:
            batch_size: Rows of a batch over all ranks; a multiple of ``world``.
            split: Name of the split.
            seed: Seed of the order of all epochs.
            epoch: First epoch.
            fields: Names of the fields.
            normalize: Whether to normalize every split with the statistics of the
                training rows.
            dtype: Type of float fields.
            observe: Kind of observation of the scenes of the rows, such as "cloud"
                (``cnpgen.scenes.observe``), or a function that returns observations of
                a batch, name -> array with a first axis of length B. They are added to
                the batch.
            options: Rank, incomplete batches and the stored order.
            old_keywords: Fields of the options, as keywords of version 1.0.

        Raises:
            UsageError: An argument is invalid, or there are fewer rows than in one
                batch, or fewer in the last batch than ranks.
            DatasetError: There is no such split or field, there are no training rows
                for the normalization, or no scenes to observe.
        """
        if isinstance(observe, str | Observation):
            observe = observer_of(self.spec, observe, seed=seed)
            selected = [
                field.name for field in select_columns(self.spec, fields).fields
            ]
            fields = list(dict.fromkeys([*selected, OBSTACLE_POSES]))
        chosen = with_old_keywords("batches", options, BatchOptions(), old_keywords)
        partition = BatchPartition(
            batch_size=batch_size,
            rank=chosen.rank,
            world=chosen.world,
            drop_last=chosen.drop_last,
        )
        position = checked_position(seed=seed, shuffle=chosen.shuffle, epoch=epoch)
        row_format = self._row_format(fields=fields, normalize=normalize, dtype=dtype)
        return Batches(self._source(split), row_format, partition, position, observe)

    @checked_arguments
    def rows(
        self,
        split: str,
        indices: ArrayLike,
        *,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = False,
        dtype: DTypeLike | None = None,
    ) -> Rows:
        """Read rows by index; of an unfinished dataset, indices count the existing rows.

        Args:
            split: Name of the split.
            indices: Indices of rows, shape (k,); negative ones count from the end.
            fields: Names of the fields.
            normalize: Whether to normalize; by default values are in the units of the
                fields.
            dtype: Type of float fields; the stored type by default.

        Returns:
            Field name -> values, C-contiguous, shape (k, width) or (k,).

        Raises:
            RowError: There is no such row; this is also an IndexError.
            DatasetError: There is no such split or field, or a shard is damaged.
        """
        row_format = self._row_format(fields=fields, normalize=normalize, dtype=dtype)
        return row_format.convert(
            gather(self._source(split), indices, row_format.layout)
        )

    @checked_arguments
    def arrays(
        self,
        split: str = "train",
        *,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = False,
        dtype: DTypeLike | None = None,
    ) -> Rows:
        """Read all rows of a split in their stored order, as :meth:`rows` does.

        Returns:
            Field name -> values, C-contiguous, shape (rows, width) or (rows,).

        Raises:
            DatasetError: There is no such split or field, or a shard is damaged.
        """
        indices = np.arange(self._source(split).rows)
        return self.rows(
            split, indices, fields=fields, normalize=normalize, dtype=dtype
        )

    @checked_arguments
    def scenes(self, split: str, indices: ArrayLike) -> Scene:
        """Return the scenes of rows, for example for ``PlanLoss`` or the planner.

        Args:
            split: Name of the split.
            indices: Indices of rows, shape (k,); see :meth:`rows`.

        Raises:
            RowError: There is no such row; this is also an IndexError.
            DatasetError: The dataset has no scenes, there is no such split, or a shard
                is damaged.
        """
        if not self.spec.scene_obstacles:
            raise DatasetError(
                f"{self.folder} has no scenes: the obstacles of all samples are those of its problem"
            )
        poses = self.rows(split, indices, fields=[OBSTACLE_POSES])[OBSTACLE_POSES]
        return Scene(problem_obstacles(self.spec), poses.astype(np.float64))

    @checked_arguments
    def frame(
        self,
        split: str = "train",
        *,
        fields: Iterable[str] | None = None,
        library: str | None = None,
    ) -> Any:
        """Read all rows of a split as a table of polars or pandas, one column per joint or axis: ``start_q.joint_1``.

        Args:
            split: Name of the split.
            fields: Names of the fields.
            library: "polars" or "pandas"; by default the installed one, polars if both
                are.

        Returns:
            A ``DataFrame``, in the units of the fields. With pandas,
            ``frame.attrs["units"]`` maps columns to units.

        Raises:
            DatasetError: There is no such split or field, or a shard is damaged.
            UsageError: The library is not supported.
            MachineError: The library is not installed.
        """
        rows = self.arrays(split, fields=fields)
        return make_frame(rows, [self.fields[name] for name in rows], library=library)

    def _source(self, split: str) -> SplitShards:
        if split not in self.shards:
            raise DatasetError(
                f"{self.folder} {lacks('split', str(split), self.shards)}",
                concerns="split",
            )
        return SplitShards(
            split, self.shards[split], self.reader, self.fingerprint, self.spec.dtype
        )

    def _row_format(
        self,
        *,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = False,
        dtype: DTypeLike | None = None,
    ) -> RowFormat:
        return make_row_format(
            self.spec,
            self.normalization,
            fields=fields,
            normalize=normalize,
            dtype=dtype,
        )


def make_frame(
    rows: Mapping[str, AnyArray], fields: Sequence[Field], *, library: str | None
) -> Any:
    """Convert rows, of shape (rows, width) or (rows,) each, to a ``DataFrame`` with columns in the order of the fields.

    The library is "polars" or "pandas"; by default the installed one, polars if both
    are. With pandas, ``attrs["units"]`` contains the units of the columns.
    """
    name = _installed(library)
    columns = {
        column: np.ascontiguousarray(values)
        for field in fields
        for column, values in zip(
            field.columns, np.atleast_2d(rows[field.name].T), strict=True
        )
    }
    frame = import_module(name).DataFrame(columns)
    if name == "pandas":
        frame.attrs["units"] = dict(
            pair
            for field in fields
            for pair in zip(field.columns, field.units, strict=True)
        )
    return frame


def _installed(library: str | None) -> str:
    """Return the requested library, or the installed one."""
    if library is not None and library not in LIBRARIES:
        raise UsageError(
            f"must be one of {', '.join(LIBRARIES)}, got {library!r}",
            argument="library",
        )
    candidates = LIBRARIES if library is None else (library,)
    installed = next((name for name in candidates if find_spec(name) is not None), None)
    if installed is None:
        raise MissingExtraError(
            f"a frame needs {' or '.join(candidates)}, not installed here: pip install "
            f"'cnpgen[{candidates[0]}]'"
        )
    return installed
