"""Normalisation: every column with mean 0 and deviation 1 over the training rows, by their stored statistics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.store.field import Field
from cnpgen.store.statistics import FieldStatistics

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Normalization:
    """Means and deviations of the columns of fields.

    Attributes:
        mean: Field name -> mean of its c columns, in the field's unit, shape (c,); c is 1 for a scalar field.
        std: Field name -> standard deviation, likewise; 0 for a constant column, which normalisation maps to 0.
    """

    mean: Mapping[str, Floats]
    std: Mapping[str, Floats]

    def __repr__(self) -> str:
        return f"<means and deviations of {', '.join(self.mean)}>"

    @cached_property
    def scale(self) -> dict[str, Floats]:
        """Field name -> 1 / std, 0 for constant columns, shape (c,)."""
        return {name: np.divide(1.0, std, out=np.zeros_like(std), where=std > 0) for name, std in self.std.items()}

    def normalize(self, rows: Mapping[str, Any]) -> dict[str, Any]:
        """Return (x - mean) / std of the fields that have statistics, and others as they are.

        Args:
            rows: Field name -> values in the field's unit, shape (..., width), or (...) of a scalar field; arrays of
                NumPy or JAX or tensors of torch, which stay what they are, and gradients go through.
        """
        return {name: self._scaled(name, values) for name, values in rows.items()}

    def denormalize(self, rows: Mapping[str, Any]) -> dict[str, Any]:
        """Return mean + std x, which undoes :meth:`normalize`; a constant column gets its one value back.

        Args:
            rows: Field name -> normalised values, otherwise as for :meth:`normalize`.
        """
        return {name: self._unscaled(name, values) for name, values in rows.items()}

    def _scaled(self, name: str, values: Any) -> Any:
        if name not in self.mean:
            return values
        return _keeping(values, (values - _beside(values, self.mean[name])) * _beside(values, self.scale[name]))

    def _unscaled(self, name: str, values: Any) -> Any:
        if name not in self.mean:
            return values
        return _keeping(values, values * _beside(values, self.std[name]) + _beside(values, self.mean[name]))

    def side_by_side(self, fields: Sequence[Field]) -> tuple[Floats, Floats]:
        """Return mean and scale of the columns of fields in the packed table, shape (columns,) each.

        Raises:
            DatasetError: A field has no statistics here.
        """
        missing = [field.name for field in fields if field.name not in self.mean]
        if missing:
            raise DatasetError(
                f"there are no statistics to normalise {', '.join(missing)} with, only those of {', '.join(self.mean)}"
            )
        nothing = np.empty(0)
        mean = np.concatenate([nothing, *(self.mean[field.name] for field in fields)])
        return mean, np.concatenate([nothing, *(self.scale[field.name] for field in fields)])


def _beside(values: Any, numbers: Floats) -> Any:
    """Return numbers as what can be computed with beside values: tensors of torch take only their like."""
    return values.new_tensor(numbers) if hasattr(values, "new_tensor") else numbers


def _keeping(values: Any, result: Any) -> Any:
    """Give a result the shape and type of the values that it was made of."""
    return (result if result.dtype == values.dtype else result.astype(values.dtype)).reshape(values.shape)


def make_normalization(statistics: Mapping[str, FieldStatistics], fields: Sequence[Field]) -> Normalization:
    """Take the means and deviations of the fields of numbers out of statistics.

    A column whose deviation is below the resolution of float32 at its largest value counts as constant: normalised, it
    would be nothing but rounding errors of size 1 (the height of a tip that stays on a table).

    Args:
        statistics: Field name -> statistics of the training rows.
        fields: The dataset's fields.
    """
    mean, std = {}, {}
    for field in fields:
        if field.dtype == "float" and field.name in statistics:
            found = statistics[field.name]
            largest = np.maximum(np.abs(found.minimum), np.abs(found.maximum))
            mean[field.name] = found.mean
            std[field.name] = np.where(found.std > np.finfo(np.float32).eps * largest, found.std, 0.0)
    return Normalization(mean, std)
