"""The order of the rows of a split in one epoch, and its windows: shards that are packed and shuffled together.

The order is computed from seed, epoch and shard sizes; nothing is stored. In every
epoch, the shards are permuted and distributed over windows of about 2^18 rows. Within a
window, the rows of all its shards are permuted together. A split of less than 1.5
windows is therefore shuffled uniformly. In larger splits, the rows of a shard stay
within one window per epoch. Small splits stay in memory; otherwise a thread packs one
window ahead.
"""

import hashlib
import math
import os
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cached_property
from threading import Thread
from typing import TypeVar

import numpy as np

from cnpgen.arrays import AnyArray, Array, Columns, Integers
from cnpgen.loader.batch import Batch
from cnpgen.loader.row_format import RowFormat
from cnpgen.loader.shard_reader import ShardReader, SplitShards
from cnpgen.store.checked_shard import Shard

WINDOW_ROWS = 1 << 18
MAX_IN_MEMORY_BYTES = 1 << 28
_CHUNK_VALUES = 1 << 15  # float64 numbers that fit into the L2 cache of a processor
T = TypeVar("T")


@dataclass(frozen=True)
class Window:
    """Shards, by their index in the split, whose rows are shuffled together, from a position in the epoch on."""

    first: int
    rows: int
    shards: tuple[int, ...]


@dataclass(frozen=True)
class Order:
    """The order of one epoch of a split with shards of some rows.

    Splits are shuffled independently.
    """

    split: str
    shard_rows: tuple[int, ...]
    seed: int
    epoch: int
    shuffle: bool = True

    @cached_property
    def windows(self) -> tuple[Window, ...]:
        """The windows of the epoch, in order."""
        shards = self._permuted(len(self.shard_rows), stage=0)
        # Windows of about WINDOW_ROWS rows, at least one shard each.
        count = min(
            max(round(sum(self.shard_rows) / WINDOW_ROWS), 1), max(len(shards), 1)
        )
        windows = []
        first = 0
        for members in np.array_split(shards, count):
            rows = sum(self.shard_rows[shard] for shard in members)
            windows.append(Window(first, rows, tuple(members.tolist())))
            first += rows
        return tuple(windows)

    def rows_of(self, window: int) -> Integers:
        """Return the order of the rows of a window: indices into the concatenated rows of its shards, shape (rows,)."""
        # Stage 0 is the order of the shards.
        return self._permuted(self.windows[window].rows, stage=1 + window)

    def _permuted(self, size: int, *, stage: int) -> Integers:
        if not self.shuffle:
            return np.arange(size)
        # The name of the split as eight words: splits have independent orders.
        words = np.frombuffer(
            hashlib.sha256(self.split.encode()).digest(), "<u4"
        ).tolist()
        return permutation(size, seed=self.seed, key=(*words, self.epoch, stage))


def permutation(size: int, *, seed: int, key: tuple[int, ...]) -> Integers:
    """Return a uniformly random permutation, shape (size,), that does not depend on the version of NumPy.

    NumPy guarantees the raw output of bit generators, but not that of
    ``Generator.permutation``. The rows are sorted by raw random numbers, the last bits
    of which are replaced by the row index. For up to 2^20 rows, 44 bits remain random,
    so ties are negligible. Seed and key are not negative.
    """
    raw = np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)).random_raw(size)
    # As many low bits as the largest index needs.
    mask = np.uint64((1 << max(size - 1, 1).bit_length()) - 1)
    keys = (raw & ~mask) | np.arange(size, dtype=np.uint64)
    keys.sort()
    return (keys & mask).view(np.int64)


@dataclass(frozen=True, eq=False)
class Packed:
    """The concatenated rows of some shards: a table of float fields, shape (rows, D), and integer fields by name."""

    table: AnyArray
    integers: Columns

    def part(self, first: int, last: int) -> "Packed":
        """Return the rows from ``first`` to ``last`` as views."""
        return Packed(
            self.table[first:last],
            {name: values[first:last] for name, values in self.integers.items()},
        )


Loaded = tuple[Packed, Integers]


def row_bytes(row_format: RowFormat) -> int:
    """Return the size of a packed row [bytes]."""
    layout = row_format.layout
    return layout.width * row_format.dtype.itemsize + sum(
        8 * max(field.width, 1) for field in layout.integers
    )


def empty_packed(rows: int, row_format: RowFormat) -> Packed:
    """Allocate memory for rows."""
    layout = row_format.layout
    integers = {
        field.name: np.empty(field.shape(rows), np.int64) for field in layout.integers
    }
    return Packed(np.empty((rows, layout.width), row_format.dtype), integers)


def pack(
    shards: Sequence[Shard], row_format: RowFormat, reader: ShardReader, *, out: Packed
) -> None:
    """Read whole shards into ``out``, one after the other."""
    layout = row_format.layout
    first = 0
    normalization = row_format.normalization
    scaling = (
        None if normalization is None else normalization.side_by_side(layout.floats)
    )
    for shard in shards:
        columns = reader.read(shard, layout.fields)
        part = out.part(first, first + shard.rows)
        if layout.floats:
            _fill(part.table, {name: columns[name] for name in layout.slices}, scaling)
        for name, values in part.integers.items():
            values[:] = columns[name]
        first += shard.rows


def _fill(
    table: AnyArray,
    columns: Mapping[str, AnyArray],
    scaling: tuple[Array, Array] | None,
) -> None:
    """Copy columns side by side in chunks, so that the float64 arithmetic stays in the cache."""
    rows, width = table.shape
    # Rows of a chunk whose float64 values stay in the cache.
    step = min(max(_CHUNK_VALUES // width, 1), rows)
    buffer = np.empty((step, width))
    # Repeated for all rows of a chunk, so that no operation broadcasts.
    scales: Sequence[Array] = (
        () if scaling is None else [np.tile(part, (step, 1)) for part in scaling]
    )
    copies = [
        (target, _opaque_rows(columns[name]))
        for name, target in _targets(buffer, columns).items()
    ]
    for first in range(0, rows, step):
        last = min(first + step, rows)
        # The last chunk is shorter.
        if last - first < step:
            buffer, *scales = (part[: last - first] for part in (buffer, *scales))
            copies = [(target[: last - first], values) for target, values in copies]
        for target, values in copies:
            np.copyto(target, values[first:last])
        if scales:
            # (x - mean) / std
            np.subtract(buffer, scales[0], out=buffer)
            np.multiply(buffer, scales[1], out=buffer)
        table[first:last] = buffer


def _opaque_rows(values: AnyArray) -> AnyArray:
    """View float64 values as one opaque item per row, which NumPy copies twice as fast as rows of six numbers."""
    rows = np.ascontiguousarray(values, np.float64).reshape(len(values), -1)
    return rows.view(f"V{8 * rows.shape[1]}")[:, 0]


def _targets(buffer: Array, columns: Mapping[str, AnyArray]) -> Columns:
    """View the part of the buffer for every column as one opaque item per row."""
    targets = {}
    start = 0
    for name, values in columns.items():
        size = 8 * math.prod(values.shape[1:])
        targets[name] = np.ndarray(
            len(buffer), f"V{size}", buffer, start, buffer.strides[:1]
        )
        start += size
    return targets


class InMemoryRows:
    """All rows of a split, in their stored order; each shard is read when it is needed for the first time.

    Two threads may load at the same time, since both write the same values.
    """

    def __init__(self, source: SplitShards, row_format: RowFormat) -> None:
        self._source = source
        self._row_format = row_format
        self._firsts = np.cumsum([0, *(shard.rows for shard in source.shards)]).tolist()
        self._loaded: set[int] = set()
        self.packed = empty_packed(source.rows, row_format)

    def load(self, shards: Sequence[int]) -> Integers:
        """Load shards, by their indices within the split, that are not in memory yet.

        Return the positions of their rows in ``packed``, in the order of the shards,
        shape (rows,).
        """
        positions = [np.empty(0, np.int64)]
        for index in shards:
            shard = self._source.shards[index]
            first = self._firsts[index]
            if index not in self._loaded:
                out = self.packed.part(first, first + shard.rows)
                pack([shard], self._row_format, self._source.reader, out=out)
                self._loaded.add(index)
            positions.append(np.arange(first, first + shard.rows))
        return np.concatenate(positions)


def make_in_memory_rows(
    source: SplitShards, row_format: RowFormat
) -> InMemoryRows | None:
    """Allocate memory for a whole split if it needs at most 256 MiB.

    Otherwise return None.
    """
    return (
        InMemoryRows(source, row_format)
        if source.rows * row_bytes(row_format) <= MAX_IN_MEMORY_BYTES
        else None
    )


def start(task: Callable[[], T]) -> "Future[T]":
    """Run a task in a new thread.

    Unlike a pool, the thread ends with its task and does not disturb forks or exits.
    """
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(task())
        except BaseException as error:  # noqa: BLE001 - raised again by result()
            future.set_exception(error)

    Thread(target=run, name="cnpgen-loader").start()
    return future


class Windows:
    """Access to the rows of an epoch by position.

    At most two windows are in memory, unless the whole split is.
    """

    def __init__(
        self,
        source: SplitShards,
        row_format: RowFormat,
        order: Order,
        in_memory: InMemoryRows | None,
    ) -> None:
        self._source = source
        self._row_format = row_format
        self._order = order
        self._in_memory = in_memory
        self._firsts = [window.first for window in order.windows]
        self._futures: dict[int, Future[Loaded]] = {}
        # Memory of two windows, reused in turn, because allocating it takes as long as
        # packing.
        self._memory: dict[int, Packed] = {}
        self._process = os.getpid()

    def batch(self, first: int, last: int, *, rank: int = 0, world: int = 1) -> Batch:
        """Return the rows at the positions ``range(first + rank, last, world)``, in new arrays."""
        tables = []
        integers = []
        for packed, rows in self._rows_by_window(first + rank, last, world):
            tables.append(packed.table.take(rows, axis=0))
            integers.append(
                {
                    name: values.take(rows, axis=0)
                    for name, values in packed.integers.items()
                }
            )
        if len(tables) == 1:
            return Batch(
                tables[0],
                self._row_format.layout,
                integers[0],
                self._row_format.normalization,
            )
        joined = {
            name: np.concatenate([part[name] for part in integers])
            for name in integers[0]
        }
        return Batch(
            np.concatenate(tables),
            self._row_format.layout,
            joined,
            self._row_format.normalization,
        )

    def _rows_by_window(self, first: int, last: int, step: int) -> Iterator[Loaded]:
        """Yield every window of the positions ``range(first, last, step)`` with the indices of the rows in it."""
        index = bisect_right(self._firsts, min(first, last - 1)) - 1
        while index < len(self._firsts) and self._firsts[index] < last:
            window = self._order.windows[index]
            packed, rows = self._load(index)
            # Positions in previous windows.
            skipped = max(-((first - window.first) // step), 0) * step
            yield (
                packed,
                rows[first - window.first + skipped : last - window.first : step],
            )
            index += 1

    def _load(self, index: int) -> Loaded:
        """Wait for a window, start loading the next one and release the previous ones."""
        if self._process != os.getpid():
            # Threads do not survive a fork, so their results would never arrive.
            self._process = os.getpid()
            self._futures = {}
            self._memory = {}
        if index + 1 not in self._futures:
            self._futures = {
                other: future
                for other, future in self._futures.items()
                if other == index
            }
            self._start(index).result()
            if index + 1 < len(self._firsts):
                self._start(index + 1)
        return self._futures[index].result()

    def _start(self, index: int) -> "Future[Loaded]":
        if index not in self._futures:
            self._futures[index] = start(lambda: self._pack(index))
        return self._futures[index]

    def _pack(self, index: int) -> Loaded:
        window = self._order.windows[index]
        rows = self._order.rows_of(index)
        if self._in_memory is not None:
            return self._in_memory.packed, self._in_memory.load(window.shards)[rows]
        # Windows alternate between two buffers: one is read while the other is filled.
        if index % 2 not in self._memory:
            self._memory[index % 2] = empty_packed(
                max(other.rows for other in self._order.windows), self._row_format
            )
        packed = self._memory[index % 2]
        pack(
            [self._source.shards[shard] for shard in window.shards],
            self._row_format,
            self._source.reader,
            out=packed,
        )
        return packed, rows
