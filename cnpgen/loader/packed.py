"""Rows of whole shards packed into one table, converted and normalised as they are copied."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.columns import tail
from cnpgen.loader.form import Form
from cnpgen.loader.shards import Shard, ShardReader

_CHUNK = 1 << 15  # numbers in float64 that fit into a processor's second cache


@dataclass(frozen=True, eq=False)
class Packed:
    """The rows of some shards, end to end.

    Attributes:
        table: The fields of numbers side by side, shape (rows, D).
        integers: Field name -> values, shape (rows, width) or (rows,).
    """

    table: NDArray[Any]
    integers: dict[str, NDArray[Any]]

    def part(self, first: int, last: int) -> "Packed":
        """Return the rows from ``first`` to ``last`` as views."""
        return Packed(self.table[first:last], {name: values[first:last] for name, values in self.integers.items()})


def row_bytes(form: Form) -> int:
    """Return how much memory a packed row takes [bytes]."""
    return form.layout.width * form.dtype.itemsize + sum(8 * max(field.width, 1) for field in form.layout.integers)


def empty_packed(rows: int, form: Form) -> Packed:
    """Make room for rows."""
    integers = {field.name: np.empty((rows, *tail(field)), np.int64) for field in form.layout.integers}
    return Packed(np.empty((rows, form.layout.width), form.dtype), integers)


def pack(shards: Sequence[Shard], form: Form, reader: ShardReader, *, out: Packed) -> None:
    """Read whole shards into ``out``, end to end.

    Raises:
        DatasetError: A shard is missing or damaged, or the normalisation lacks a field.
        MachineError: The system would not let us read a shard.
    """
    layout, first = form.layout, 0
    scaling = None if form.normalization is None else form.normalization.side_by_side(layout.floats)
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
    """Put columns side by side, chunk by chunk: the arithmetic is in float64 and stays in the cache."""
    rows, width = table.shape
    step = min(max(_CHUNK // width, 1), rows)
    buffer = np.empty((step, width))
    scales: Sequence[NDArray[np.float64]] = () if scaling is None else [np.tile(part, (step, 1)) for part in scaling]
    moves = [(place, _whole_rows(columns[name])) for name, place in _places(buffer, columns).items()]
    for first in range(0, rows, step):
        last = min(first + step, rows)
        if last - first < step:
            buffer, *scales = (part[: last - first] for part in (buffer, *scales))
            moves = [(place[: last - first], values) for place, values in moves]
        for place, values in moves:
            np.copyto(place, values[first:last])
        if scales:
            np.subtract(buffer, scales[0], out=buffer)
            np.multiply(buffer, scales[1], out=buffer)
        table[first:last] = buffer


def _whole_rows(values: NDArray[Any]) -> NDArray[Any]:
    """View float64 values as one opaque item per row: NumPy copies those twice as fast as rows of six numbers.

    Args:
        values: Values of a field, shape (rows, width) or (rows,).
    """
    rows = np.ascontiguousarray(values, np.float64).reshape(len(values), -1)
    return rows.view(f"V{8 * rows.shape[1]}")[:, 0]


def _places(buffer: NDArray[np.float64], columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """View the parts of a buffer that columns go to, side by side, as one opaque item per row."""
    places, start = {}, 0
    for name, values in columns.items():
        size = 8 * math.prod(values.shape[1:])
        places[name] = np.ndarray(len(buffer), f"V{size}", buffer, start, buffer.strides[:1])
        start += size
    return places
