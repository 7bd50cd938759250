"""A batch of rows: a mapping from field names to arrays, which are views of one packed table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

from numpy.typing import NDArray

from cnpgen.loader.columns import Columns
from cnpgen.loader.normalization import Normalization


@dataclass(frozen=True, eq=False)
class Batch(Mapping[str, NDArray[Any]]):
    """B rows. The arrays belong to the batch alone and may be changed.

    ``batch["start_q"]`` has shape (B, width), or (B,) for a scalar field. Float fields are views of ``table``.
    ``dict(batch)`` is a plain dict of all fields and observations.

    Attributes:
        table: Float fields side by side, C-contiguous, shape (B, D).
        layout: Fields and their columns in the table.
        integers: Integer fields, int64, shape (B, width) or (B,).
        normalization: Normalization of the float fields; None if they are in their units.
        observations: Results of ``observe`` of :meth:`Dataset.batches`, with a first axis of length B.
    """

    table: NDArray[Any]
    layout: Columns
    integers: Mapping[str, NDArray[Any]]
    normalization: Normalization | None = None
    observations: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<batch of {self.rows} rows, {self.table.dtype}: {self.layout.summary}>"

    @property
    def columns(self) -> dict[str, slice]:
        """Field name -> columns of the table."""
        return self.layout.slices

    @property
    def rows(self) -> int:
        """Number of rows B."""
        return len(self.table)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name in self.observations:
            return self.observations[name]
        if name in self.integers:
            return self.integers[name]
        part = self.layout.slices[name]
        return self.table[:, part.start if name in self.layout.scalars else part]

    def __iter__(self) -> Iterator[str]:
        return chain((column.name for column in self.layout.fields), self.observations)

    def __len__(self) -> int:
        return len(self.layout.fields) + len(self.observations)
