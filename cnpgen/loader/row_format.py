"""The format of loaded rows: fields and their columns in the packed table, normalization and type."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cnpgen.arrays import AnyArray
from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.shard_reader import scene_fields
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.field import Field, Fields
from cnpgen.store.scene_table import OBSTACLE_POSES, SCENE_ARRAYS
from cnpgen.store.statistics import FieldStatistics

Floats = NDArray[np.float64]
DTYPES = ("float32", "float64")


@dataclass(frozen=True, eq=False)
class Normalization:
    """Means and standard deviations of the columns of fields.

    Attributes:
        mean: Field name -> mean of its c columns, in the unit of the field, shape (c,);
            c is 1 for a scalar field.
        std: Field name -> standard deviation of its c columns, in the unit of the
            field, shape (c,). It is 0 for a constant column, which is normalized to 0.
    """

    mean: Mapping[str, Floats]
    std: Mapping[str, Floats]

    def __repr__(self) -> str:
        return f"<means and deviations of {', '.join(self.mean)}>"

    @cached_property
    def scale(self) -> dict[str, Floats]:
        """Field name -> 1 / std, 0 for constant columns, shape (c,)."""
        return {
            # A constant column becomes 0 instead of 0 / 0.
            name: np.divide(1.0, std, out=np.zeros_like(std), where=std > 0)
            for name, std in self.std.items()
        }

    def normalize(self, rows: Mapping[str, Any]) -> dict[str, Any]:
        """Return (x - mean) / std of the fields with statistics; other fields are unchanged.

        Args:
            rows: Field name -> values in the unit of the field, shape (..., width), or
                (...) for a scalar field. They may be arrays of NumPy or JAX or tensors
                of torch; gradients are propagated.
        """
        return {
            name: self._scaled(name, values) if name in self.mean else values
            for name, values in rows.items()
        }

    def denormalize(self, rows: Mapping[str, Any]) -> dict[str, Any]:
        """Return mean + std x, the inverse of :meth:`normalize`; a constant column returns to its value.

        Args:
            rows: Field name -> normalized values, otherwise as for :meth:`normalize`.
        """
        return {
            name: self._unscaled(name, values) if name in self.mean else values
            for name, values in rows.items()
        }

    def _scaled(self, name: str, values: Any) -> Any:
        mean = _as_type_of(values, self.mean[name])
        scale = _as_type_of(values, self.scale[name])
        return _with_type_of(values, (values - mean) * scale)

    def _unscaled(self, name: str, values: Any) -> Any:
        mean = _as_type_of(values, self.mean[name])
        std = _as_type_of(values, self.std[name])
        return _with_type_of(values, values * std + mean)

    def side_by_side(self, fields: Sequence[Field]) -> tuple[Floats, Floats]:
        """Return mean and scale of the columns of fields in the packed table, shape (columns,) each.

        Raises:
            DatasetError: A field has no statistics here.
        """
        # Never normalized.
        of_scenes = {
            OBSTACLE_POSES,
            *(item.name for item in SCENE_ARRAYS),
        }
        missing = [
            field.name for field in fields if field.name not in {*self.mean, *of_scenes}
        ]
        if missing:
            raise DatasetError(
                f"there are no statistics to normalize {', '.join(missing)} with, only those of {', '.join(self.mean)}"
            )
        empty = np.empty(0)
        width = {field.name: max(field.width, 1) for field in fields}
        # Fields of scenes have mean 0 and scale 1, which leaves them as they are.
        mean = [self.mean.get(name, np.zeros(count)) for name, count in width.items()]
        scale = [self.scale.get(name, np.ones(count)) for name, count in width.items()]
        return np.concatenate([empty, *mean]), np.concatenate([empty, *scale])


def _as_type_of(values: Any, numbers: Floats) -> Any:
    """Return numbers in the array type of ``values``, since torch does not mix its tensors with arrays."""
    return values.new_tensor(numbers) if hasattr(values, "new_tensor") else numbers


def _with_type_of(values: Any, result: Any) -> Any:
    """Return a result with the shape and dtype of ``values``."""
    return (
        result if result.dtype == values.dtype else result.astype(values.dtype)
    ).reshape(values.shape)


def make_normalization(
    statistics: Mapping[str, FieldStatistics], fields: Sequence[Field]
) -> Normalization:
    """Make the normalization of the float fields from statistics of the training rows.

    A column counts as constant if its standard deviation is below the float32
    resolution of its largest value. Otherwise its rounding errors would be scaled to
    size 1, such as those of the height of a tip on a table.
    """
    mean = {}
    std = {}
    for field in fields:
        if field.dtype == "float" and field.name in statistics:
            item = statistics[field.name]
            largest = np.maximum(np.abs(item.minimum), np.abs(item.maximum))
            mean[field.name] = item.mean
            std[field.name] = np.where(
                item.std > np.finfo(np.float32).eps * largest, item.std, 0.0
            )
    return Normalization(mean, std)


@dataclass(frozen=True)
class Columns:
    """The fields to load, in order. Float fields share a table.

    Integer fields are separate arrays.
    """

    fields: Fields

    @cached_property
    def floats(self) -> Fields:
        """The float fields, which are in the table."""
        return tuple(field for field in self.fields if field.dtype == "float")

    @cached_property
    def integers(self) -> Fields:
        """The integer fields, which are neither in the table nor normalized."""
        return tuple(field for field in self.fields if field.dtype != "float")

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Field name -> columns of the table."""
        slices = {}
        start = 0
        for field in self.floats:
            slices[field.name] = slice(start, start + max(field.width, 1))
            start += max(field.width, 1)
        return slices

    @cached_property
    def scalars(self) -> frozenset[str]:
        """Names of the fields with one value per row: shape (rows,), not (rows, 1)."""
        return frozenset(field.name for field in self.fields if not field.width)

    @property
    def summary(self) -> str:
        """The fields with their widths: ``"start_q[6], hit_speed"``."""
        return ", ".join(
            f"{field.name}[{field.width}]" if field.width else field.name
            for field in self.fields
        )

    @property
    def width(self) -> int:
        """Number of columns of the table."""
        return sum(max(field.width, 1) for field in self.floats)


def select_columns(spec: DatasetSpec, names: Iterable[str] | None) -> Columns:
    """Select fields by name, in the requested order.

    By default these are all float fields except for diagnostics, in the order of the
    specification. Fields of scenes have to be named.
    """
    if names is None:
        return Columns(
            tuple(
                field
                for field in spec.fields
                # By default those that a model uses: diagnostics describe how a sample
                # was made.
                if field.dtype == "float" and field.role != "diagnostic"
            )
        )
    if isinstance(names, str):
        raise UsageError(
            f"must be a list of names, got the text {names!r}: write [{names!r}]",
            argument="fields",
        )
    given: Any = names
    if isinstance(given, bytes) or getattr(given, "ndim", 1) != 1:
        raise UsageError(
            f"must be a list of names, got {names!r:.100}", argument="fields"
        )
    selected: Sequence[str] = tuple(names)
    texts = all(isinstance(name, str) for name in selected)
    if not selected or not texts or len(set(selected)) != len(selected):
        raise UsageError(
            f"must be one or more different names, got {list(selected)!s:.200}",
            argument="fields",
        )
    of_scenes = {field.name: field for field in scene_fields(spec)}
    return Columns(
        tuple(of_scenes.get(name) or spec.field_named(name) for name in selected)
    )


@dataclass(frozen=True, eq=False)
class RowFormat:
    """The format of loaded rows.

    Without a normalization, float fields keep their units.
    """

    layout: Columns
    normalization: Normalization | None
    dtype: np.dtype[Any]

    def convert(self, rows: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
        """Convert stored rows, of shape (k, width) or (k,) each, to this format."""
        values = dict(rows)
        if self.normalization is not None:
            # In float64, as for batches.
            values |= {
                name: values[name].astype(np.float64, copy=False)
                for name in self.layout.slices
            }
            values = self.normalization.normalize(values)
        return values | {
            name: values[name].astype(self.dtype, copy=False)
            for name in self.layout.slices
        }


def make_row_format(
    spec: DatasetSpec,
    own: Normalization | None,
    *,
    fields: Iterable[str] | None,
    normalize: bool | Normalization,
    dtype: DTypeLike | None,
) -> RowFormat:
    """Make the format of loaded rows from the options of a user.

    ``own`` is the normalization of the dataset, None without training rows. By default,
    rows have all float fields except for diagnostics, in the stored type.
    """
    normalization = (
        normalize
        if isinstance(normalize, Normalization)
        else _own(spec, own, normalize)
    )
    layout = select_columns(spec, fields)
    if normalization is not None:
        # Raises the error for a missing field here, and not in a thread.
        normalization.side_by_side(layout.floats)
    return RowFormat(
        layout, normalization, _float_dtype(spec.dtype if dtype is None else dtype)
    )


def _own(
    spec: DatasetSpec, own: Normalization | None, normalize: object
) -> Normalization | None:
    if not isinstance(normalize, bool | np.bool_):
        raise UsageError(
            f"must be True, False or the normalization of a dataset, got {normalize!r:.100}",
            argument="normalize",
        )
    if normalize and own is None:
        raise DatasetError(
            f"{spec.name} has no training rows for the normalization; pass normalize=False, or the normalization of"
            " the dataset that the model was trained on"
        )
    return own if normalize else None


def _float_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    try:
        float_type = np.dtype(dtype)
    except TypeError:
        float_type = None
    if float_type is None or float_type.name not in DTYPES:
        raise UsageError(
            f"must be one of {', '.join(DTYPES)}, got {dtype!r}", argument="dtype"
        )
    return float_type
