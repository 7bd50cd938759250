"""Packed rows of a small split, which stay in memory after they have been read."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.packed import Packed, empty_packed, pack, row_bytes
from cnpgen.loader.row_format import RowFormat
from cnpgen.loader.shard_reader import SplitShards

MAX_IN_MEMORY_BYTES = 1 << 28


class InMemoryRows:
    """All rows of a split, in their stored order; each shard is read when it is needed for the first time.

    Two threads may load at the same time, since both write the same values.
    """

    def __init__(self, source: SplitShards, row_format: RowFormat) -> None:
        self._source, self._row_format = source, row_format
        self._firsts = np.cumsum([0, *(shard.rows for shard in source.shards)]).tolist()
        self._loaded: set[int] = set()
        self.packed: Packed = empty_packed(source.rows, row_format)

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
