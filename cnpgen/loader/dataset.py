"""A dataset opened for training: rows in batches, as whole arrays, at random; its fields and statistics."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from cnpgen.errors import DatasetError, lacks
from cnpgen.loader.batches import Batches
from cnpgen.loader.cut import Cut
from cnpgen.loader.form import Form, make_form
from cnpgen.loader.frame import make_frame
from cnpgen.loader.gather import Rows, gather
from cnpgen.loader.normalization import Normalization, make_normalization
from cnpgen.loader.position import checked_position
from cnpgen.loader.shards import Shard, ShardReader, SplitShards
from cnpgen.loader.split import Split
from cnpgen.store.blueprint import Blueprint, StoredProblem
from cnpgen.store.field import Field
from cnpgen.store.statistics import FieldStatistics


@dataclass(frozen=True, eq=False)
class Dataset:
    """The rows of a dataset; it can be pickled, forked and used by several threads.

    In all methods ``fields`` are names in the order they are wanted in, by default all fields of numbers that are not
    diagnostics; ``normalize`` may be the :class:`Normalization` of another dataset; ``dtype`` is that of the fields of
    numbers, "float32" or "float64". Integers stay int64 and are never normalised.

    Attributes:
        folder: Its folder.
        blueprint: Its blueprint: recipe, seed, robot, versions.
        fingerprint: Fingerprint of the rows that are there; equal fingerprints, equal rows.
        shards: Split -> its shards that are there.
        statistics: Split -> field -> statistics of its columns, in the field's unit.
        reader: Reads the shards.
    """

    folder: Path
    blueprint: Blueprint
    fingerprint: str
    shards: Mapping[str, tuple[Shard, ...]]
    statistics: Mapping[str, Mapping[str, FieldStatistics]]
    reader: ShardReader

    def __repr__(self) -> str:
        rows = ", ".join(f"{rows:,} {split}" for split, rows in self.splits.items())
        return f"<{self.blueprint.name} {self.blueprint.version} in {self.folder}: {rows}>"

    @cached_property
    def splits(self) -> dict[str, int]:
        """Split -> number of its rows that are there."""
        return {split: sum(shard.rows for shard in shards) for split, shards in self.shards.items()}

    @cached_property
    def fields(self) -> dict[str, Field]:
        """Name -> what a field is: unit, names and limits of its columns, role."""
        return {field.name: field for field in self.blueprint.fields}

    @property
    def problem(self) -> StoredProblem:
        """The problem whose motions the rows are the ends of, for ``PlanLoss(dataset.problem)`` and the like.

        Raises:
            DatasetError: The dataset does not say.
        """
        return self.blueprint.problem

    @cached_property
    def normalization(self) -> Normalization | None:
        """Means and deviations of the training rows; None if there are none."""
        found = self.statistics.get("train")
        return make_normalization(found, self.blueprint.fields) if found else None

    def __getitem__(self, split: str) -> Split:
        return Split(self._source(split), self._form())

    def __contains__(self, split: object) -> bool:
        return split in self.shards

    def __iter__(self) -> Iterator[str]:
        return iter(self.shards)

    def __len__(self) -> int:
        return len(self.shards)

    def batches(
        self,
        batch_size: int,
        *,
        split: str = "train",
        seed: int = 0,
        epoch: int = 0,
        rank: int = 0,
        world: int = 1,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = True,
        dtype: DTypeLike = "float32",
        drop_last: bool = True,
        shuffle: bool = True,
    ) -> Batches:
        """Give the rows of a split in batches, in an order that depends on seed and epoch alone.

        Args:
            batch_size: Rows of a batch, of all ranks together; a multiple of ``world``.
            split: Name of the split.
            seed: Seed of the order of all epochs.
            epoch: The epoch to begin with.
            rank: Which of the ranks this process is: it gets the rows ``rank::world`` of every batch.
            world: Number of ranks.
            fields: Which fields.
            normalize: Whether to normalise with the statistics of the training rows, whatever the split.
            dtype: Type of the fields of numbers.
            drop_last: Leave out the rows at the end of an epoch that fill no batch.
            shuffle: Whether to shuffle; else rows come in their stored order.

        Raises:
            UsageError: An argument cannot be meant, or there are fewer rows than one batch needs, or in the last batch
                than there are ranks.
            DatasetError: There is no such split or field, or nothing to normalise with.
        """
        cut = Cut(batch_size=batch_size, rank=rank, world=world, drop_last=drop_last)
        position = checked_position(seed=seed, shuffle=shuffle, epoch=epoch)
        form = self._form(fields=fields, normalize=normalize, dtype=dtype)
        return Batches(self._source(split), form, cut, position)

    def rows(
        self,
        split: str,
        indices: ArrayLike,
        *,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = False,
        dtype: DTypeLike | None = None,
    ) -> Rows:
        """Read rows by their numbers; of an unfinished dataset, numbers count the rows that are there.

        Args:
            split: Name of the split.
            indices: Numbers of rows, shape (k,); negative ones count from the end.
            fields: Which fields.
            normalize: Whether to normalise; by default values are in the fields' units.
            dtype: Type of the fields of numbers; as stored by default.

        Returns:
            Field name -> values, C-contiguous, shape (k, width) or (k,).

        Raises:
            RowError: There is no such row; it is an IndexError, too.
            DatasetError: There is no such split or field, or a shard is damaged.
        """
        form = self._form(fields=fields, normalize=normalize, dtype=dtype)
        return form.applied(gather(self._source(split), indices, form.layout))

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
        everything = np.arange(self._source(split).rows)
        return self.rows(split, everything, fields=fields, normalize=normalize, dtype=dtype)

    def frame(self, split: str = "train", *, fields: Iterable[str] | None = None, library: str | None = None) -> Any:
        """Read all rows of a split as a table of polars or pandas, a column per joint or axis: ``start_q.joint_1``.

        Args:
            split: Name of the split.
            fields: Which fields.
            library: "polars" or "pandas"; by default the one that is installed, polars if both are.

        Returns:
            A ``DataFrame``, in the fields' units. ``frame.attrs["units"]`` of pandas says column -> unit.

        Raises:
            DatasetError: There is no such split or field, or a shard is damaged.
            UsageError: There is no such library.
            MachineError: It is not installed.
        """
        rows = self.arrays(split, fields=fields)
        return make_frame(rows, [self.fields[name] for name in rows], library=library)

    def _source(self, split: str) -> SplitShards:
        if split not in self.shards:
            raise DatasetError(f"{self.folder} {lacks('split', str(split), self.shards)}")
        return SplitShards(split, self.shards[split], self.reader, self.fingerprint, self.blueprint.dtype)

    def _form(
        self,
        *,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = False,
        dtype: DTypeLike | None = None,
    ) -> Form:
        return make_form(self.blueprint, self.normalization, fields=fields, normalize=normalize, dtype=dtype)
