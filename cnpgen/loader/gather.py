"""Rows at random: each is looked up in the memory map of its shard."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.loader.columns import Columns, tail
from cnpgen.loader.shards import SplitShards
from cnpgen.store.shard import storage_dtype

Rows = dict[str, NDArray[Any]]
Indices = NDArray[np.int64]


class RowError(UsageError, IndexError):
    """A row that the split does not have."""


def gather(source: SplitShards, indices: ArrayLike, layout: Columns) -> Rows:
    """Read single rows.

    Args:
        source: Where rows come from.
        indices: Their numbers, shape (k,); negative ones count from the end.
        layout: Which fields.

    Returns:
        Field name -> values as stored, shape (k, width) or (k,), in the order of the indices.

    Raises:
        RowError: The split has no such row.
        UsageError: The indices are not integers.
        DatasetError: A shard is missing or damaged.
    """
    rows = _checked(indices, source)
    found = {f.name: np.empty((len(rows), *tail(f)), storage_dtype(f, source.stored)) for f in layout.fields}
    for shard, places, local in _by_shard(rows, source):
        columns = source.reader.read(source.shards[shard], layout.fields)
        for name, values in found.items():
            values[places] = columns[name][local]
    return found


def _checked(indices: ArrayLike, source: SplitShards) -> Indices:
    """Return row numbers, counted from the beginning, shape (k,)."""
    rows = np.asarray(indices)
    if rows.size == 0:
        return np.empty(0, np.int64)
    if rows.ndim != 1 or rows.dtype.kind not in "iu":
        raise UsageError(f"rows must be a list of integers, got {rows.dtype} of shape {rows.shape}")
    wrong = (rows < -source.rows) | (rows >= source.rows)
    if wrong.any():
        raise RowError(f"split {source.split!r} has {source.rows} rows, there is no row {rows[wrong][0]}")
    return np.where(rows < 0, rows + source.rows, rows).astype(np.int64)


def _by_shard(rows: Indices, source: SplitShards) -> Iterator[tuple[int, Indices, Indices]]:
    """Give the number of every shard that is needed, the places of its rows in the result, and the rows within it."""
    ends = np.cumsum([shard.rows for shard in source.shards])
    shards = np.searchsorted(ends, rows, side="right")
    order = np.argsort(shards, kind="stable")
    for places in np.split(order, np.flatnonzero(np.diff(shards[order])) + 1):
        if len(places):
            shard = int(shards[places[0]])
            yield shard, places, rows[places] - (ends[shard] - source.shards[shard].rows)
