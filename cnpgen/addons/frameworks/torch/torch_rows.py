"""Single rows as tensors, for the samplers of torch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import DTypeLike
from torch.utils import data

from cnpgen.loader.dataset import Dataset
from cnpgen.loader.row_format import Normalization

Tensors = dict[str, torch.Tensor]


class RowDataset(data.Dataset[Tensors]):  # type: ignore[misc]
    """Rows with random access, for the samplers of torch; slower than :class:`BatchDataset`.

    ``DataLoader(rows, batch_size=1024, shuffle=True, collate_fn=rows.collate)`` uses a
    batch as it was read. Without ``collate_fn`` torch splits it into rows and stacks
    them again, with the same result.

    Args:
        dataset: The dataset.
        split: Name of the split.
        fields: Names of the fields; by default all fields of real numbers that are not
            diagnostics.
        normalize: Whether to normalize, or a normalization other than that of the
            dataset.
        dtype: Type of the fields of real numbers.
    """

    def __init__(
        self,
        dataset: Dataset,
        split: str = "train",
        *,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = True,
        dtype: DTypeLike = "float32",
    ) -> None:
        self._dataset = dataset
        self._split = split
        self._length = len(dataset[split])
        self._fields = None if fields is None else list(fields)
        self._normalize = normalize
        self._dtype = dtype

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> Tensors:
        return {
            name: values[0]
            for name, values in self.__getitems__([index]).fields.items()
        }

    def __getitems__(self, indices: Sequence[int]) -> ReadRows:
        rows = self._dataset.rows(
            self._split,
            indices,
            fields=self._fields,
            normalize=self._normalize,
            dtype=self._dtype,
        )
        return ReadRows(
            {name: torch.from_numpy(values) for name, values in rows.items()},
            len(indices),
        )

    @staticmethod
    def collate(rows: Sequence[Tensors]) -> Tensors:
        """Stack rows to a batch; rows that were read at once are already stacked."""
        return rows.fields if isinstance(rows, ReadRows) else data.default_collate(rows)


@dataclass(frozen=True, eq=False)
class ReadRows(Sequence[Tensors]):
    """Rows that were read at once, as a sequence of single rows.

    Attributes:
        fields: Field name -> values, shape (rows, width) or (rows,).
        rows: Number of rows.
    """

    fields: Tensors
    rows: int

    def __len__(self) -> int:
        return self.rows

    def __getitem__(self, row: Any) -> Any:
        # torch's IndexError ends iteration
        return {name: values[row] for name, values in self.fields.items()}
