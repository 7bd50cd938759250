"""The windows of an epoch: groups of shards that are packed and shuffled together, one ahead in a thread."""

import os
from bisect import bisect_right
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.batch import Batch
from cnpgen.loader.order import Order
from cnpgen.loader.packed import InMemoryRows, Packed, empty_packed, pack
from cnpgen.loader.row_format import RowFormat
from cnpgen.loader.shard_reader import SplitShards

Loaded = tuple[Packed, NDArray[np.int64]]
T = TypeVar("T")


def start(task: Callable[[], T]) -> "Future[T]":
    """Run a task in a new thread. Unlike a pool, the thread ends with its task and does not disturb forks or exits."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(task())
        except BaseException as error:  # noqa: BLE001 - raised again by result()
            future.set_exception(error)

    Thread(target=run, name="cnpgen-loader").start()
    return future


class Windows:
    """Access to the rows of an epoch by position. At most two windows are in memory, unless the whole split is."""

    def __init__(
        self, source: SplitShards, row_format: RowFormat, order: Order, in_memory: InMemoryRows | None
    ) -> None:
        self._source, self._row_format, self._order, self._in_memory = source, row_format, order, in_memory
        self._firsts = [window.first for window in order.windows]
        self._futures: dict[int, Future[Loaded]] = {}
        # Memory of two windows, reused in turn, because allocating it takes as long as packing.
        self._memory: dict[int, Packed] = {}
        self._process = os.getpid()

    def batch(self, first: int, last: int, *, rank: int = 0, world: int = 1) -> Batch:
        """Return the rows at the positions ``range(first + rank, last, world)``, in new arrays.

        Raises:
            DatasetError: A shard is missing or damaged, or the normalization has no statistics of a field.
            MachineError: A shard cannot be read.
        """
        tables, integers = [], []
        for packed, rows in self._rows_by_window(first + rank, last, world):
            tables.append(packed.table.take(rows, axis=0))
            integers.append({name: values.take(rows, axis=0) for name, values in packed.integers.items()})
        if len(tables) == 1:
            return Batch(tables[0], self._row_format.layout, integers[0], self._row_format.normalization)
        joined = {name: np.concatenate([part[name] for part in integers]) for name in integers[0]}
        return Batch(np.concatenate(tables), self._row_format.layout, joined, self._row_format.normalization)

    def _rows_by_window(self, first: int, last: int, step: int) -> Iterator[Loaded]:
        """Yield every window of the positions ``range(first, last, step)`` with the indices of the rows in it."""
        index = bisect_right(self._firsts, min(first, last - 1)) - 1
        while index < len(self._firsts) and self._firsts[index] < last:
            window = self._order.windows[index]
            packed, rows = self._load(index)
            skipped = max(-((first - window.first) // step), 0) * step  # positions in previous windows
            yield packed, rows[first - window.first + skipped : last - window.first : step]
            index += 1

    def _load(self, index: int) -> Loaded:
        """Wait for a window, start loading the next one and release the previous ones."""
        if self._process != os.getpid():  # threads do not survive a fork, so their results would never arrive
            self._process, self._futures, self._memory = os.getpid(), {}, {}
        if index + 1 not in self._futures:
            self._futures = {other: future for other, future in self._futures.items() if other == index}
            self._start(index).result()
            if index + 1 < len(self._firsts):
                self._start(index + 1)
        return self._futures[index].result()

    def _start(self, index: int) -> "Future[Loaded]":
        if index not in self._futures:
            self._futures[index] = start(lambda: self._pack(index))
        return self._futures[index]

    def _pack(self, index: int) -> Loaded:
        window, rows = self._order.windows[index], self._order.rows_of(index)
        if self._in_memory is not None:
            return self._in_memory.packed, self._in_memory.load(window.shards)[rows]
        if index % 2 not in self._memory:
            self._memory[index % 2] = empty_packed(max(other.rows for other in self._order.windows), self._row_format)
        packed = self._memory[index % 2]
        pack([self._source.shards[shard] for shard in window.shards], self._row_format, self._source.reader, out=packed)
        return packed, rows
