"""One split of a dataset as a sequence of rows."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.loader.form import Form
from cnpgen.loader.gather import Rows, gather
from cnpgen.loader.shards import SplitShards


@dataclass(frozen=True, eq=False)
class Split:
    """The rows of a split: ``len`` is their number, ``split[i]`` a row, ``split[a:b]`` and ``split[[i, j]]`` several.

    A row has all fields of numbers that are not diagnostics, in their units and as they are stored.

    Attributes:
        source: Where the rows come from.
        form: Which fields.
    """

    source: SplitShards
    form: Form

    def __repr__(self) -> str:
        return f"<{self.source.rows:,} rows of split {self.source.split!r}: {self.form.layout.summary}>"

    def __len__(self) -> int:
        return self.source.rows

    def __iter__(self) -> Iterator[Rows]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, which: slice | ArrayLike) -> Rows:
        if isinstance(which, slice):
            return self.__getitem__(np.arange(*which.indices(len(self))))
        indices = np.asarray(which)
        rows = gather(self.source, np.atleast_1d(indices), self.form.layout)
        return {name: values[0] for name, values in rows.items()} if indices.ndim == 0 else rows
