"""Single rows as tensors, for torch's own samplers."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import DTypeLike
from torch.utils import data

from cnpgen.loader.dataset import Dataset
from cnpgen.loader.normalization import Normalization

Tensors = dict[str, torch.Tensor]


class RowDataset(data.Dataset[Tensors]):  # type: ignore[misc]
    """Rows at random, for torch's samplers; slower than :class:`BatchDataset`.

    ``DataLoader(rows, batch_size=1024, shuffle=True, collate_fn=rows.collate)`` takes a batch as it was read; without
    ``collate_fn`` torch takes it apart and puts it together again, to the same end.

    Args:
        dataset: The dataset.
        split: Name of the split.
        fields: Which fields; by default all fields of numbers that are not diagnostics.
        normalize: Whether to normalise, or what with instead of the dataset's own normalisation.
        dtype: Type of the fields of numbers.
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
        self._dataset, self._split = dataset, split
        self._length = len(dataset[split])
        self._fields = None if fields is None else list(fields)
        self._normalize, self._dtype = normalize, dtype

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> Tensors:
        return {name: values[0] for name, values in self.__getitems__([index]).together.items()}

    def __getitems__(self, indices: Sequence[int]) -> "ReadRows":
        rows = self._dataset.rows(
            self._split, indices, fields=self._fields, normalize=self._normalize, dtype=self._dtype
        )
        return ReadRows({name: torch.from_numpy(values) for name, values in rows.items()}, len(indices))

    @staticmethod
    def collate(rows: Sequence[Tensors]) -> Tensors:
        """Put rows together: those that were read at once are."""
        return rows.together if isinstance(rows, ReadRows) else data.default_collate(rows)


@dataclass(frozen=True, eq=False)
class ReadRows(Sequence[Tensors]):
    """Rows that were read at once, as a sequence of single ones.

    Attributes:
        together: Field name -> values, shape (rows, width) or (rows,).
        rows: Number of rows.
    """

    together: Tensors
    rows: int

    def __len__(self) -> int:
        return self.rows

    def __getitem__(self, row: Any) -> Any:
        return {name: values[row] for name, values in self.together.items()}  # torch's IndexError ends iteration
