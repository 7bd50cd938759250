"""A split of a dataset as a sequence of rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.loader.gather import Rows, gather
from cnpgen.loader.row_format import RowFormat
from cnpgen.loader.shard_reader import SplitShards


@dataclass(frozen=True, eq=False)
class Split:
    """The rows of a split: ``split[i]`` is one row, ``split[a:b]`` and ``split[[i, j]]`` are several rows.

    A row contains all float fields except for diagnostics, in their units and stored type.

    Attributes:
        source: Shards of the split.
        row_format: Format of the rows.
    """

    source: SplitShards
    row_format: RowFormat

    def __repr__(self) -> str:
        return f"<{self.source.rows:,} rows of split {self.source.split!r}: {self.row_format.layout.summary}>"

    def __len__(self) -> int:
        return self.source.rows

    def __iter__(self) -> Iterator[Rows]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, index: slice | ArrayLike) -> Rows:
        if isinstance(index, slice):
            return self.__getitem__(np.arange(*index.indices(len(self))))
        indices = np.asarray(index)
        rows = gather(self.source, np.atleast_1d(indices), self.row_format.layout)
        return {name: values[0] for name, values in rows.items()} if indices.ndim == 0 else rows
