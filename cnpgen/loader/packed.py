"""Packing the rows of shards into one table, with conversion and normalization; small splits stay in memory."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.row_format import RowFormat
from cnpgen.loader.shard_reader import ShardReader, SplitShards
from cnpgen.store.checked_shard import Shard

MAX_IN_MEMORY_BYTES = 1 << 28
_CHUNK_VALUES = 1 << 15  # float64 numbers that fit into the L2 cache of a processor


@dataclass(frozen=True, eq=False)
class Packed:
    """The concatenated rows of some shards: a table of float fields, shape (rows, D), and integer fields by name."""

    table: NDArray[Any]
    integers: dict[str, NDArray[Any]]

    def part(self, first: int, last: int) -> "Packed":
        """Return the rows from ``first`` to ``last`` as views."""
        return Packed(self.table[first:last], {name: values[first:last] for name, values in self.integers.items()})


def row_bytes(row_format: RowFormat) -> int:
    """Return the size of a packed row [bytes]."""
    layout = row_format.layout
    return layout.width * row_format.dtype.itemsize + sum(8 * max(field.width, 1) for field in layout.integers)


def empty_packed(rows: int, row_format: RowFormat) -> Packed:
    """Allocate memory for rows."""
    layout = row_format.layout
    integers = {field.name: np.empty(field.shape(rows), np.int64) for field in layout.integers}
    return Packed(np.empty((rows, layout.width), row_format.dtype), integers)


def pack(shards: Sequence[Shard], row_format: RowFormat, reader: ShardReader, *, out: Packed) -> None:
    """Read whole shards into ``out``, one after the other.

    Raises:
        DatasetError: A shard is missing or damaged, or the normalization has no statistics of a field.
        MachineError: A shard cannot be read.
    """
    layout, first, normalization = row_format.layout, 0, row_format.normalization
    scaling = None if normalization is None else normalization.side_by_side(layout.floats)
    for shard in shards:
        columns, part = reader.read(shard, layout.fields), out.part(first, first + shard.rows)
        if layout.floats:
            _fill(part.table, {name: columns[name] for name in layout.slices}, scaling)
        for name, values in part.integers.items():
            values[:] = columns[name]
        first += shard.rows


def _fill(
    table: NDArray[Any],
    columns: Mapping[str, NDArray[Any]],
    scaling: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
) -> None:
    """Copy columns side by side in chunks, so that the float64 arithmetic stays in the cache."""
    rows, width = table.shape
    step = min(max(_CHUNK_VALUES // width, 1), rows)
    buffer = np.empty((step, width))
    scales: Sequence[NDArray[np.float64]] = () if scaling is None else [np.tile(part, (step, 1)) for part in scaling]
    copies = [(target, _opaque_rows(columns[name])) for name, target in _targets(buffer, columns).items()]
    for first in range(0, rows, step):
        last = min(first + step, rows)
        if last - first < step:
            buffer, *scales = (part[: last - first] for part in (buffer, *scales))
            copies = [(target[: last - first], values) for target, values in copies]
        for target, values in copies:
            np.copyto(target, values[first:last])
        if scales:
            np.subtract(buffer, scales[0], out=buffer)
            np.multiply(buffer, scales[1], out=buffer)
        table[first:last] = buffer


def _opaque_rows(values: NDArray[Any]) -> NDArray[Any]:
    """View float64 values as one opaque item per row, which NumPy copies twice as fast as rows of six numbers."""
    rows = np.ascontiguousarray(values, np.float64).reshape(len(values), -1)
    return rows.view(f"V{8 * rows.shape[1]}")[:, 0]


def _targets(buffer: NDArray[np.float64], columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """View the part of the buffer for every column as one opaque item per row."""
    targets, start = {}, 0
    for name, values in columns.items():
        size = 8 * math.prod(values.shape[1:])
        targets[name] = np.ndarray(len(buffer), f"V{size}", buffer, start, buffer.strides[:1])
        start += size
    return targets


class InMemoryRows:
    """All rows of a split, in their stored order; each shard is read when it is needed for the first time.

    Two threads may load at the same time, since both write the same values.
    """

    def __init__(self, source: SplitShards, row_format: RowFormat) -> None:
        self._source, self._row_format = source, row_format
        self._firsts = np.cumsum([0, *(shard.rows for shard in source.shards)]).tolist()
        self._loaded: set[int] = set()
        self.packed = empty_packed(source.rows, row_format)

    def load(self, shards: Sequence[int]) -> NDArray[np.int64]:
        """Load shards, by their indices within the split, that are not in memory yet.

        Returns:
            Positions of their rows in ``packed``, in the order of the shards, shape (rows,).

        Raises:
            DatasetError: A shard is missing or damaged, or the normalization has no statistics of a field.
            MachineError: A shard cannot be read.
        """
        positions = [np.empty(0, np.int64)]
        for index in shards:
            shard, first = self._source.shards[index], self._firsts[index]
            if index not in self._loaded:
                out = self.packed.part(first, first + shard.rows)
                pack([shard], self._row_format, self._source.reader, out=out)
                self._loaded.add(index)
            positions.append(np.arange(first, first + shard.rows))
        return np.concatenate(positions)


def make_in_memory_rows(source: SplitShards, row_format: RowFormat) -> InMemoryRows | None:
    """Allocate memory for a whole split if it needs at most 256 MiB; otherwise return None."""
    return InMemoryRows(source, row_format) if source.rows * row_bytes(row_format) <= MAX_IN_MEMORY_BYTES else None
