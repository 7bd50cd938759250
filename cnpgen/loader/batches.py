"""The batches of a split, epoch by epoch, from any row of an epoch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.batch import Batch
from cnpgen.loader.row_format import RowFormat
from cnpgen.loader.shard_reader import SplitShards
from cnpgen.loader.windows import InMemoryRows, Order, Windows, make_in_memory_rows
from cnpgen.schema.arguments import flag, integer

LOADER_STATE_FORMAT = "cnpgen-loader-state"
LOADER_STATE_VERSION = 1  # also raised if the computation of the order changes
Observe = Callable[[Batch], Mapping[str, AnyArray]]


@dataclass(frozen=True, kw_only=True)
class BatchPartition:
    """Batches of a fixed number of rows over all ranks; the rows of a batch are distributed over the ranks.

    A rank reads the rows ``rank::world`` of every batch, one of its workers the batches
    ``worker::workers``. An incomplete last batch of an epoch is omitted by default.
    """

    batch_size: int
    rank: int = 0
    world: int = 1
    drop_last: bool = True
    worker: int = 0
    workers: int = 1

    def __post_init__(self) -> None:
        for name, minimum in (
            ("batch_size", 1),
            ("world", 1),
            ("rank", 0),
            ("workers", 1),
            ("worker", 0),
        ):
            object.__setattr__(
                self, name, integer(name, getattr(self, name), least=minimum)
            )
        object.__setattr__(self, "drop_last", flag("drop_last", self.drop_last))
        for name, value, count in (
            ("rank", self.rank, self.world),
            ("worker", self.worker, self.workers),
        ):
            if value >= count:
                raise UsageError(
                    f"must be one of 0 to {count - 1}, got {value}", argument=name
                )
        if self.batch_size % self.world:
            raise UsageError(
                f"batch_size counts the rows of all ranks together and must be a multiple of world ({self.world}),"
                f" got {self.batch_size}",
                concerns="batch_size",
            )

    def end(self, rows: int, *, first: int = 0) -> int:
        """Return the end of the batches that start at position ``first``, of ``rows`` rows."""
        # The remainder of the last batch is dropped, counted from the position where
        # reading begins.
        return rows - (rows - first) % self.batch_size if self.drop_last else rows

    def check_ranks(self, rows: int, *, first: int = 0) -> None:
        """Raise UsageError if the last batch has no row for some ranks, since their mean loss would be nan.

        The batches begin at position ``first``.
        """
        remainder = (self.end(rows, first=first) - first) % self.batch_size
        if 0 < remainder < self.world:
            raise UsageError(
                f"the last batch of {rows} rows has {remainder} for {self.world} ranks: omit it with drop_last=True,"
                " read all of it on every rank (world=1), or choose another batch_size",
                concerns="batch_size",
            )

    def count(self, rows: int) -> int:
        """Return the number of batches of this worker for ``rows`` rows."""
        batches = -(-self.end(rows) // self.batch_size)
        # Worker w has the batches w, w + W, w + 2 W, ...: ceil((batches - w) / W) of
        # them.
        return -(-(batches - self.worker) // self.workers)


@dataclass(frozen=True)
class Position:
    """A position in the order of an epoch: the number of rows that all ranks together have read."""

    seed: int
    shuffle: bool
    epoch: int
    row: int = 0


def checked_position(*, seed: Any, shuffle: Any, epoch: Any, row: Any = 0) -> Position:
    """Make a position of unchecked arguments."""
    numbers = {"seed": seed, "epoch": epoch, "row": row}
    return Position(
        shuffle=flag("shuffle", shuffle),
        **{name: integer(name, value, least=0) for name, value in numbers.items()},
    )


def position_from_json(state: Mapping[str, Any], source: SplitShards) -> Position:
    """Rebuild a position; raise an error if it is not of these rows."""
    if not isinstance(state, Mapping) or state.get("format") != LOADER_STATE_FORMAT:
        raise UsageError(
            f"a loader's state must be what state() returned, got {state!r:.100}"
        )
    if state.get("format_version") != LOADER_STATE_VERSION:
        version = state.get("format_version")
        raise DatasetError(
            f"the loader's state has format version {version!r}, this cnpgen reads "
            f"{LOADER_STATE_VERSION}"
        )
    for name, value in (("fingerprint", source.fingerprint), ("split", source.split)):
        if state.get(name) != value:
            raise DatasetError(
                f"the loader's state is of another dataset: {name} {state.get(name)!r}, here {value!r}"
            )
    try:
        position = checked_position(
            **{name: state[name] for name in Position.__dataclass_fields__}
        )
    except KeyError as error:
        raise UsageError(f"the loader's state lacks {error}") from error
    if position.row > source.rows:
        raise DatasetError(
            f"the loader's state is at row {position.row}; split {source.split!r} has {source.rows}"
        )
    return position


class Batches:
    """Iterable over batches: every loop yields the remaining batches of an epoch; then the next epoch begins.

    The order is a function of seed, epoch and shards alone. A split of at most 256 MiB
    stays in memory after its rows have been read; of a larger split, two windows do. It
    can be forked, and pickled without rows.

    Args:
        source: Shards of the split.
        row_format: Fields, normalization and type of the rows.
        partition: Partition of the rows into batches.
        position: Initial position.
        observe: Function that returns observations of a batch, which are added to it.

    Attributes:
        times_set: Number of times that ``epoch`` or ``load_state`` set the position.
        worker_positions: Shared memory in which workers of other processes store their
            positions, shape (workers, 2): the next epoch and ``times_set``; None
            without workers.

    Raises:
        UsageError: There are fewer rows than in one batch, or fewer in the last batch
            than ranks.
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
        self._source = source
        self._row_format = row_format
        self._partition = partition
        self._position = position
        self._in_memory: InMemoryRows | None = None
        self._observe = observe
        self.times_set = 0
        self.worker_positions: Any = None

    def __getstate__(self) -> dict[str, Any]:
        # Rows are read again in the other process; shared positions belong to this one.
        return self.__dict__ | {"_in_memory": None, "worker_positions": None}

    def __repr__(self) -> str:
        source = self._source
        position = self._position
        place = f"seed {position.seed}, epoch {position.epoch}, row {position.row:,}"
        rows = f"{self._partition.batch_size} of the {source.rows:,} rows of split {source.split!r}"
        return f"<batches of {rows}, at {place}: {self._row_format.layout.summary}>"

    @property
    def epoch(self) -> int:
        """Epoch of the next batch; set it to start another epoch."""
        return self._position.epoch

    @epoch.setter
    def epoch(self, epoch: int) -> None:
        self._position = replace(
            self._position, epoch=integer("epoch", epoch, least=0), row=0
        )
        self.times_set += 1

    @property
    def signature(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Field name -> shape in one row and type."""
        types = {"float": self._row_format.dtype, "int64": np.dtype(np.int64)}
        return {
            field.name: (field.shape(0)[1:], types[field.dtype])
            for field in self._row_format.layout.fields
        }

    def __len__(self) -> int:
        """Return the number of batches per epoch."""
        return self._partition.count(self._source.rows)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the remaining batches of the epoch; the last one moves the position to the next epoch.

        Raises:
            DatasetError: A shard is missing or damaged.
            UsageError: The position was changed between two batches.
        """
        source = self._source
        partition = self._partition
        begin = position = self._position = self._forward(self._position)
        rows = tuple(shard.rows for shard in source.shards)
        order = Order(source.split, rows, begin.seed, begin.epoch, begin.shuffle)
        self._in_memory = self._in_memory or make_in_memory_rows(
            source, self._row_format
        )
        windows = Windows(source, self._row_format, order, self._in_memory)
        row = begin.row
        end = partition.end(source.rows, first=begin.row)
        while (first := row + partition.worker * partition.batch_size) < end:
            batch = windows.batch(
                first,
                min(first + partition.batch_size, end),
                rank=partition.rank,
                world=partition.world,
            )
            row = min(row + partition.workers * partition.batch_size, end)
            # The position moves before the batch is returned: a state that is saved
            # within the loop continues after it.
            self._position = position = self._forward(
                Position(begin.seed, begin.shuffle, begin.epoch, row)
            )
            yield (
                batch
                if self._observe is None
                else replace(batch, observations=self._observe(batch))
            )
            # Another object in its place was set by other code during the yield.
            if self._position is not position:
                raise UsageError(
                    "within this loop, another loop over the same batches ran or load_state was called"
                )

    def _forward(self, position: Position) -> Position:
        """Return the first position of the next epoch if no batch remains in this one, otherwise the position."""
        has_batches = (
            self._partition.end(self._source.rows, first=position.row) > position.row
        )
        return (
            position
            if has_batches or not position.row
            else replace(position, epoch=position.epoch + 1, row=0)
        )

    def state(
        self, *, epoch: int | None = None, batch: int | None = None
    ) -> dict[str, Any]:
        """Return the position as a small JSON-able dict, equal on every rank.

        By default, this is the position after the last returned batch. If workers or a
        prefetch read batches ahead, the user must pass the number of batches that were
        used.

        Args:
            epoch: The epoch; the current one by default.
            batch: Number of batches of that epoch that were used.

        Raises:
            UsageError: The epoch has fewer batches; or workers read batches and
                ``batch`` is missing.
        """
        position = self._position
        if epoch is not None or batch is not None:
            used = integer("batch", batch or 0, least=0)
            if used > len(self):
                raise UsageError(
                    f"must be at most {len(self)}, the number of batches of an epoch, got {used}",
                    argument="batch",
                )
            # The number of used batches determines the position on all ranks.
            row = min(used * self._partition.batch_size, self._source.rows)
            epoch = (
                position.epoch if epoch is None else integer("epoch", epoch, least=0)
            )
            position = self._forward(replace(position, epoch=epoch, row=row))
        elif (
            self.worker_positions is not None
            and (self.worker_positions[:, 1] == self.times_set).any()
        ):
            raise UsageError(
                "the workers of a DataLoader read batches ahead, so the number of used batches is unknown: pass it with"
                " state(epoch=..., batch=...), or set num_workers=0"
            )
        head = {"format": LOADER_STATE_FORMAT, "format_version": LOADER_STATE_VERSION}
        return head | {
            "fingerprint": self._source.fingerprint,
            "split": self._source.split,
            **asdict(position),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the position of ``state()``: the next loop continues with the following batch.

        The state contains seed, epoch and shuffling. Batch size, ranks and fields are
        those of this object: a state counts rows, so the batch size and the number of
        ranks may differ.

        Raises:
            UsageError: The argument is not the state of a loader, or the last batch
                would have fewer rows than ranks.
            DatasetError: The state is of another dataset, split or format version.
        """
        position = self._forward(position_from_json(state, self._source))
        self._partition.check_ranks(self._source.rows, first=position.row)
        self._position = position
        self.times_set += 1

    def for_worker(
        self, worker: int, workers: int, *, epoch: int | None = None
    ) -> Batches:
        """Return the batches of one of several workers, which share the remaining batches or those of an epoch."""
        partition = replace(self._partition, worker=worker, workers=workers)
        position = (
            self._position
            if epoch is None
            else replace(self._position, epoch=epoch, row=0)
        )
        return Batches(
            self._source, self._row_format, partition, position, self._observe
        )
