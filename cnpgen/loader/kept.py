"""A split that is small enough to be kept in memory, packed, once its rows were read."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.form import Form
from cnpgen.loader.packed import Packed, empty_packed, pack, row_bytes
from cnpgen.loader.shards import SplitShards

KEEP_BYTES = 1 << 28


class Kept:
    """All rows of a split, shard by shard as they are first needed.

    Two threads may load at once: what both write is the same.

    Args:
        source: Where rows come from.
        form: What is wanted of them.

    Attributes:
        packed: Room for all rows, in their stored order.
    """

    def __init__(self, source: SplitShards, form: Form) -> None:
        self._source, self._form = source, form
        self._firsts = np.cumsum([0, *(shard.rows for shard in source.shards)]).tolist()
        self._there: set[int] = set()
        self.packed: Packed = empty_packed(source.rows, form)

    def load(self, shards: Sequence[int]) -> NDArray[np.int64]:
        """Make sure that shards are there.

        Args:
            shards: Their numbers within the split.

        Returns:
            Where their rows are, laid end to end, shape (rows,).

        Raises:
            DatasetError: A shard is missing or damaged, or the normalisation lacks a field.
            MachineError: The system would not let us read a shard.
        """
        places = [np.empty(0, np.int64)]
        for number in shards:
            shard, first = self._source.shards[number], self._firsts[number]
            if number not in self._there:
                out = self.packed.part(first, first + shard.rows)
                pack([shard], self._form, self._source.reader, out=out)
                self._there.add(number)
            places.append(np.arange(first, first + shard.rows))
        return np.concatenate(places)


def make_kept(source: SplitShards, form: Form) -> Kept | None:
    """Make room for a whole split, if it takes at most 256 MiB."""
    return Kept(source, form) if source.rows * row_bytes(form) <= KEEP_BYTES else None
