"""Random access to rows: many rows of a shard are read, single rows come from its memory map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError, counted
from cnpgen.loader.row_format import Columns, RowFormat
from cnpgen.loader.shard_reader import Rows, SplitShards
from cnpgen.schema.arguments import reject_masked
from cnpgen.store.shard import storage_dtype

Indices = NDArray[np.int64]

MAX_READ_ROWS_PER_ROW = 8  # of a shard whose file is read and not mapped


class RowError(UsageError, IndexError):
    """An index of a row that the split does not have."""


def gather(source: SplitShards, indices: ArrayLike, layout: Columns) -> Rows:
    """Read single rows by their indices, shape (k,), in their order; negative ones count from the end.

    Values are as stored, shape (k, width) or (k,).
    """
    rows = _checked(indices, source)
    columns = {
        f.name: np.empty(f.shape(len(rows)), storage_dtype(f, source.stored))
        for f in layout.fields
    }
    for shard, positions, local in _by_shard(rows, source):
        file = source.shards[shard]
        # The whole file is read if it has few rows per required one.
        dense = MAX_READ_ROWS_PER_ROW * len(local) >= file.rows
        stored = (source.reader.read if dense else source.reader.map)(
            file, layout.fields
        )
        for name, values in columns.items():
            values[positions] = stored[name][local]
    return columns


def _checked(indices: ArrayLike, source: SplitShards) -> Indices:
    """Return non-negative row indices, shape (k,)."""
    reject_masked("indices", indices)
    try:
        rows = np.asarray(indices)
    except ValueError as error:
        raise UsageError(
            f"must be a list of integers, got {error}", argument="indices"
        ) from error
    if rows.size == 0:
        return np.empty(0, np.int64)
    if rows.ndim != 1 or rows.dtype.kind not in "iu":
        raise UsageError(
            f"must be a list of integers, got {rows.dtype} of shape {rows.shape}",
            argument="indices",
        )
    # As of lists, negative indices count from the end.
    wrong = (rows < -source.rows) | (rows >= source.rows)
    if wrong.any():
        raise RowError(
            f"split {source.split!r} has {source.rows} rows, there is no row {rows[wrong][0]}",
            concerns="indices",
        )
    return np.where(rows < 0, rows + source.rows, rows).astype(np.int64)


def _by_shard(
    rows: Indices, source: SplitShards
) -> Iterator[tuple[int, Indices, Indices]]:
    """Yield every required shard: its index, the positions of its rows in the result, and the rows within it."""
    ends = np.cumsum([shard.rows for shard in source.shards])
    # The shard whose end is the first above the row.
    shards = np.searchsorted(ends, rows, side="right")
    # Rows are grouped by shard, so that each file is opened once.
    order = np.argsort(shards, kind="stable")
    for positions in np.split(order, np.flatnonzero(np.diff(shards[order])) + 1):
        if len(positions):
            shard = int(shards[positions[0]])
            yield (
                shard,
                positions,
                rows[positions] - (ends[shard] - source.shards[shard].rows),
            )


@dataclass(frozen=True, eq=False)
class Split:
    """The rows of a split: ``split[i]`` is one row, ``split[a:b]`` and ``split[[i, j]]`` are several rows.

    A row contains all float fields except for diagnostics, in their units and stored
    type.

    Attributes:
        source: Shards of the split.
        row_format: Format of the rows.
    """

    source: SplitShards
    row_format: RowFormat

    def __repr__(self) -> str:
        return f"<{counted(self.source.rows, 'row')} of split {self.source.split!r}: {self.row_format.layout.summary}>"

    def __len__(self) -> int:
        return self.source.rows

    def __iter__(self) -> Iterator[Rows]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, index: slice | ArrayLike) -> Rows:
        if isinstance(index, slice):
            return self.__getitem__(np.arange(*index.indices(len(self))))
        indices = np.asarray(index)
        rows = gather(self.source, np.atleast_1d(indices), self.row_format.layout)
        return (
            {name: values[0] for name, values in rows.items()}
            if indices.ndim == 0
            else rows
        )
