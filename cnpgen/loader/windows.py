"""The windows of an epoch, packed one after the other, the next one in a thread of its own."""

import os
from bisect import bisect_right
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.batch import Batch
from cnpgen.loader.form import Form
from cnpgen.loader.kept import Kept
from cnpgen.loader.order import Order
from cnpgen.loader.packed import Packed, empty_packed, pack
from cnpgen.loader.shards import SplitShards

Loaded = tuple[Packed, NDArray[np.int64]]


T = TypeVar("T")


def start(task: Callable[[], T]) -> "Future[T]":
    """Run a task in a new thread, which ends with it: no pool is left for a fork or an exit to stumble over.

    Returns:
        Its future; what the task raises, ``result()`` raises.
    """
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(task())
        except BaseException as error:  # noqa: BLE001 - not swallowed: handed over to whoever asks for the result
            future.set_exception(error)

    Thread(target=run, name="cnpgen-loader").start()
    return future


class Windows:
    """Rows of an epoch by their positions; at most two windows are in memory, but for what is kept.

    Args:
        source: Where rows come from.
        form: What is wanted of them.
        order: Their order.
        kept: The split's rows that are in memory already; None to keep none.
    """

    def __init__(self, source: SplitShards, form: Form, order: Order, kept: Kept | None) -> None:
        self._source, self._form, self._order, self._kept = source, form, order, kept
        self._firsts = [window.first for window in order.windows]
        self._futures: dict[int, Future[Loaded]] = {}
        self._memory: dict[int, Packed] = {}  # of two windows, used in turn: fresh memory costs as much as packing
        self._process = os.getpid()

    def batch(self, first: int, last: int, *, rank: int = 0, world: int = 1) -> Batch:
        """Return the rows at the positions ``range(first + rank, last, world)``, in fresh arrays.

        Raises:
            DatasetError: A shard is missing or damaged, or the normalisation lacks a field.
            MachineError: The system would not let us read a shard.
        """
        tables, integers = [], []
        for packed, rows in self._pieces(first + rank, last, world):
            tables.append(packed.table.take(rows, axis=0))
            integers.append({name: values.take(rows, axis=0) for name, values in packed.integers.items()})
        if len(tables) == 1:
            return Batch(tables[0], self._form.layout, integers[0], self._form.normalization)
        joined = {name: np.concatenate([part[name] for part in integers]) for name in integers[0]}
        return Batch(np.concatenate(tables), self._form.layout, joined, self._form.normalization)

    def _pieces(self, first: int, last: int, step: int) -> Iterator[Loaded]:
        """Give the positions ``range(first, last, step)`` window by window: the window and numbers of rows in it."""
        index = bisect_right(self._firsts, min(first, last - 1)) - 1
        while index < len(self._firsts) and self._firsts[index] < last:
            window = self._order.windows[index]
            packed, rows = self._load(index)
            skipped = max(-((first - window.first) // step), 0) * step  # of the positions, those in earlier windows
            yield packed, rows[first - window.first + skipped : last - window.first : step]
            index += 1

    def _load(self, index: int) -> Loaded:
        """Wait for a window, start on the one after it, forget those before it."""
        if self._process != os.getpid():  # a fork has no threads: what was being loaded would never be there
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
        if self._kept is not None:
            return self._kept.packed, self._kept.load(window.shards)[rows]
        if index % 2 not in self._memory:
            self._memory[index % 2] = empty_packed(max(other.rows for other in self._order.windows), self._form)
        packed = self._memory[index % 2]
        pack([self._source.shards[shard] for shard in window.shards], self._form, self._source.reader, out=packed)
        return packed, rows
