"""Normalization of every column to mean 0 and standard deviation 1 over the training rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.loader.shard_reader import OBSTACLE_POSES
from cnpgen.store.field import Field
from cnpgen.store.scene_table import SCENE_ARRAYS
from cnpgen.store.statistics import FieldStatistics

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Normalization:
    """Means and standard deviations of the columns of fields.

    Attributes:
        mean: Field name -> mean of its c columns, in the unit of the field, shape (c,); c is 1 for a scalar field.
        std: Field name -> standard deviation of its c columns, in the unit of the field, shape (c,). It is 0 for a
            constant column, which is normalized to 0.
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
        """Return (x - mean) / std of the fields with statistics; other fields are unchanged.

        Args:
            rows: Field name -> values in the unit of the field, shape (..., width), or (...) for a scalar field. They
                may be arrays of NumPy or JAX or tensors of torch; gradients are propagated.
        """
        return {name: self._scaled(name, values) if name in self.mean else values for name, values in rows.items()}

    def denormalize(self, rows: Mapping[str, Any]) -> dict[str, Any]:
        """Return mean + std x, the inverse of :meth:`normalize`; a constant column returns to its value.

        Args:
            rows: Field name -> normalized values, otherwise as for :meth:`normalize`.
        """
        return {name: self._unscaled(name, values) if name in self.mean else values for name, values in rows.items()}

    def _scaled(self, name: str, values: Any) -> Any:
        mean, scale = _as_type_of(values, self.mean[name]), _as_type_of(values, self.scale[name])
        return _with_type_of(values, (values - mean) * scale)

    def _unscaled(self, name: str, values: Any) -> Any:
        mean, std = _as_type_of(values, self.mean[name]), _as_type_of(values, self.std[name])
        return _with_type_of(values, values * std + mean)

    def side_by_side(self, fields: Sequence[Field]) -> tuple[Floats, Floats]:
        """Return mean and scale of the columns of fields in the packed table, shape (columns,) each."""
        of_scenes = {OBSTACLE_POSES, *(item.name for item in SCENE_ARRAYS)}  # never normalized
        missing = [field.name for field in fields if field.name not in {*self.mean, *of_scenes}]
        if missing:
            raise DatasetError(
                f"there are no statistics to normalize {', '.join(missing)} with, only those of {', '.join(self.mean)}"
            )
        empty, width = np.empty(0), {field.name: max(field.width, 1) for field in fields}
        mean = [self.mean.get(name, np.zeros(count)) for name, count in width.items()]
        scale = [self.scale.get(name, np.ones(count)) for name, count in width.items()]
        return np.concatenate([empty, *mean]), np.concatenate([empty, *scale])


def _as_type_of(values: Any, numbers: Floats) -> Any:
    """Return numbers in the array type of ``values``, since torch does not mix its tensors with arrays."""
    return values.new_tensor(numbers) if hasattr(values, "new_tensor") else numbers


def _with_type_of(values: Any, result: Any) -> Any:
    """Return a result with the shape and dtype of ``values``."""
    return (result if result.dtype == values.dtype else result.astype(values.dtype)).reshape(values.shape)


def make_normalization(statistics: Mapping[str, FieldStatistics], fields: Sequence[Field]) -> Normalization:
    """Make the normalization of the float fields from statistics of the training rows.

    A column counts as constant if its standard deviation is below the float32 resolution of its largest value.
    Otherwise its rounding errors would be scaled to size 1, such as those of the height of a tip on a table.
    """
    mean, std = {}, {}
    for field in fields:
        if field.dtype == "float" and field.name in statistics:
            item = statistics[field.name]
            largest = np.maximum(np.abs(item.minimum), np.abs(item.maximum))
            mean[field.name] = item.mean
            std[field.name] = np.where(item.std > np.finfo(np.float32).eps * largest, item.std, 0.0)
    return Normalization(mean, std)
