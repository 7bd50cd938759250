"""The batches of a split, epoch by epoch, from any row of an epoch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.loader.batch import Batch
from cnpgen.loader.batch_partition import BatchPartition
from cnpgen.loader.order import Order
from cnpgen.loader.packed import InMemoryRows, make_in_memory_rows
from cnpgen.loader.position import Position, position_from_json, position_to_json
from cnpgen.loader.row_format import RowFormat
from cnpgen.loader.shard_reader import SplitShards
from cnpgen.loader.windows import Windows
from cnpgen.schema.arguments import integer

Observe = Callable[[Batch], Mapping[str, NDArray[Any]]]


class Batches:
    """Iterable over batches: every loop yields the remaining batches of an epoch; then the next epoch begins.

    The order is a function of seed, epoch and shards alone. A split of at most 256 MiB stays in memory after its rows
    have been read; of a larger split, two windows do. It can be forked, and pickled without rows.

    Args:
        source: Shards of the split.
        row_format: Fields, normalization and type of the rows.
        partition: Partition of the rows into batches.
        position: Initial position.
        observe: Function that returns observations of a batch, which are added to it.

    Attributes:
        times_set: Number of times that ``epoch`` or ``load_state`` set the position.
        worker_positions: Shared memory in which workers of other processes store their positions, shape (workers, 2):
            the next epoch and ``times_set``; None without workers.

    Raises:
        UsageError: There are fewer rows than in one batch, or fewer in the last batch than ranks.
    """

    def __init__(
        self,
        source: SplitShards,
        row_format: RowFormat,
        partition: BatchPartition,
        position: Position,
        observe: Observe | None = None,
    ) -> None:
        if partition.drop_last and partition.batch_size > source.rows:
            raise UsageError(
                f"batch_size {partition.batch_size} is more than the {source.rows} rows of split {source.split!r};"
                " drop_last=False returns them as one batch",
                concerns="batch_size",
            )
        partition.check_ranks(source.rows, first=position.row)
        self._source, self._row_format, self._partition, self._position = source, row_format, partition, position
        self._in_memory: InMemoryRows | None = None
        self._observe = observe
        self.times_set = 0
        self.worker_positions: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_in_memory": None, "worker_positions": None}

    def __repr__(self) -> str:
        source, position = self._source, self._position
        place = f"seed {position.seed}, epoch {position.epoch}, row {position.row:,}"
        rows = f"{self._partition.batch_size} of the {source.rows:,} rows of split {source.split!r}"
        return f"<batches of {rows}, at {place}: {self._row_format.layout.summary}>"

    @property
    def epoch(self) -> int:
        """Epoch of the next batch; set it to start another epoch."""
        return self._position.epoch

    @epoch.setter
    def epoch(self, epoch: int) -> None:
        self._position = replace(self._position, epoch=integer("epoch", epoch, least=0), row=0)
        self.times_set += 1

    @property
    def signature(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Field name -> shape in one row and type."""
        types = {"float": self._row_format.dtype, "int64": np.dtype(np.int64)}
        return {field.name: (field.shape(0)[1:], types[field.dtype]) for field in self._row_format.layout.fields}

    def __len__(self) -> int:
        """Return the number of batches per epoch."""
        return self._partition.count(self._source.rows)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the remaining batches of the epoch; the last one moves the position to the next epoch.

        Raises:
            DatasetError: A shard is missing or damaged.
            UsageError: The position was changed between two batches.
        """
        source, partition = self._source, self._partition
        begin = position = self._position = self._forward(self._position)
        windows, end = self._windows(begin), partition.end(source.rows, first=begin.row)
        row = begin.row
        while (first := row + partition.worker * partition.batch_size) < end:
            batch = windows.batch(
                first, min(first + partition.batch_size, end), rank=partition.rank, world=partition.world
            )
            row = min(row + partition.workers * partition.batch_size, end)
            self._position = position = self._forward(Position(begin.seed, begin.shuffle, begin.epoch, row))
            yield batch if self._observe is None else replace(batch, observations=self._observe(batch))
            if self._position is not position:
                raise UsageError("within this loop, another loop over the same batches ran or load_state was called")

    def _windows(self, begin: Position) -> Windows:
        """Return the windows of an epoch."""
        rows = tuple(shard.rows for shard in self._source.shards)
        order = Order(self._source.split, rows, begin.seed, begin.epoch, begin.shuffle)
        self._in_memory = self._in_memory or make_in_memory_rows(self._source, self._row_format)
        return Windows(self._source, self._row_format, order, self._in_memory)

    def _forward(self, position: Position) -> Position:
        """Return the first position of the next epoch if no batch remains in this one, otherwise the position."""
        has_batches = self._partition.end(self._source.rows, first=position.row) > position.row
        return position if has_batches or not position.row else replace(position, epoch=position.epoch + 1, row=0)

    def state(self, *, epoch: int | None = None, batch: int | None = None) -> dict[str, Any]:
        """Return the position as a small JSON-able dict, equal on every rank.

        By default, this is the position after the last returned batch. If workers or a prefetch read batches ahead, the
        user must pass the number of batches that were used.

        Args:
            epoch: The epoch; the current one by default.
            batch: Number of batches of that epoch that were used.

        Raises:
            UsageError: The epoch has fewer batches; or workers read batches and ``batch`` is missing.
        """
        position = self._position
        if epoch is not None or batch is not None:
            used = integer("batch", batch or 0, least=0)
            if used > len(self):
                text = f"must be at most {len(self)}, the number of batches of an epoch, got {used}"
                raise UsageError(text, argument="batch")
            row = min(used * self._partition.batch_size, self._source.rows)
            epoch = position.epoch if epoch is None else integer("epoch", epoch, least=0)
            position = self._forward(replace(position, epoch=epoch, row=row))
        elif self.worker_positions is not None and (self.worker_positions[:, 1] == self.times_set).any():
            raise UsageError(
                "the workers of a DataLoader read batches ahead, so the number of used batches is unknown: pass it with"
                " state(epoch=..., batch=...), or set num_workers=0"
            )
        return position_to_json(position, self._source)

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the position of ``state()``: the next loop continues with the following batch.

        The state contains seed, epoch and shuffling. Batch size, ranks and fields are those of this object: a state
        counts rows, so the batch size and the number of ranks may differ.

        Raises:
            UsageError: The argument is not the state of a loader, or the last batch would have fewer rows than ranks.
            DatasetError: The state is of another dataset, split or format version.
        """
        position = self._forward(position_from_json(state, self._source))
        self._partition.check_ranks(self._source.rows, first=position.row)
        self._position = position
        self.times_set += 1

    def for_worker(self, worker: int, workers: int, *, epoch: int | None = None) -> Batches:
        """Return the batches of one of several workers, which share the remaining batches or those of an epoch."""
        partition = replace(self._partition, worker=worker, workers=workers)
        position = self._position if epoch is None else replace(self._position, epoch=epoch, row=0)
        return Batches(self._source, self._row_format, partition, position, self._observe)
