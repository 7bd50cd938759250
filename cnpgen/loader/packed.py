"""Rows of whole shards packed into one table, converted and normalised as they are copied."""

import math
from collections.abc import Iterable, Mapping, Sequence
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


def pack(shards: Sequence[Shard], form: Form, reader: ShardReader, *, memory: NDArray[Any] | None = None) -> Packed:
    """Read shards whole.

    Args:
        shards: The shards.
        form: What is wanted of their rows.
        reader: Reads them.
        memory: A table of the form's width and type with at least as many rows, to be used instead of a new one.

    Raises:
        DatasetError: A shard is missing or damaged, or the normalisation lacks a field.
        MachineError: The system would not let us read a shard.
    """
    rows = sum(shard.rows for shard in shards)
    layout = form.layout
    table = np.empty((rows, layout.width), form.dtype) if memory is None else memory[:rows]
    integers = {field.name: np.empty((rows, *tail(field)), np.int64) for field in layout.integers}
    scaling = None if form.normalization is None else form.normalization.side_by_side(layout.floats)
    first = 0
    for shard in shards:
        columns, last = reader.read(shard, layout.fields), first + shard.rows
        if layout.floats:
            _fill(table[first:last], {name: columns[name] for name in layout.slices}, scaling)
        for name, values in integers.items():
            values[first:last] = columns[name]
        first = last
    return Packed(table, integers)


def _fill(
    table: NDArray[Any],
    columns: Mapping[str, NDArray[Any]],
    scaling: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
) -> None:
    """Put columns side by side, chunk by chunk: the arithmetic is in float64 and stays in the cache."""
    rows, width = table.shape
    step = max(_CHUNK // width, 1)
    mean, scale = (None, None) if scaling is None else (np.tile(part, (step, 1)) for part in scaling)
    buffer = np.empty((step, width))
    places = list(zip(_places(buffer, columns.values()), columns.values(), strict=True))
    for first in range(0, rows, step):
        chunk = buffer[: min(step, rows - first)]
        for place, values in places:
            place[: len(chunk)] = _whole_rows(values[first : first + step])
        if mean is not None and scale is not None:
            np.subtract(chunk, mean[: len(chunk)], out=chunk)
            np.multiply(chunk, scale[: len(chunk)], out=chunk)
        table[first : first + step] = chunk


def _whole_rows(values: NDArray[Any]) -> NDArray[Any]:
    """View float64 values as one opaque item per row: NumPy copies those twice as fast as rows of six numbers.

    Args:
        values: Values of a field, shape (rows, width) or (rows,).
    """
    rows = np.ascontiguousarray(values, np.float64).reshape(len(values), -1)
    return rows.view(f"V{8 * rows.shape[1]}")[:, 0]


def _places(buffer: NDArray[np.float64], columns: Iterable[NDArray[Any]]) -> list[NDArray[Any]]:
    """View the parts of a buffer that columns go to, side by side, as one opaque item per row."""
    places, start = [], 0
    for values in columns:
        size = 8 * math.prod(values.shape[1:])
        places.append(np.ndarray(len(buffer), f"V{size}", buffer, start, buffer.strides[:1]))
        start += size
    return places
