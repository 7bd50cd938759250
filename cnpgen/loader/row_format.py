"""The format of loaded rows: fields and their columns in the packed table, normalization and type."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.normalization import Normalization
from cnpgen.loader.shard_reader import scene_fields
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.field import Field

DTYPES = ("float32", "float64")


@dataclass(frozen=True)
class Columns:
    """The fields to load, in order. Float fields share a table; integer fields are separate arrays."""

    fields: tuple[Field, ...]

    @cached_property
    def floats(self) -> tuple[Field, ...]:
        """The float fields, which are in the table."""
        return tuple(field for field in self.fields if field.dtype == "float")

    @cached_property
    def integers(self) -> tuple[Field, ...]:
        """The integer fields, which are neither in the table nor normalized."""
        return tuple(field for field in self.fields if field.dtype != "float")

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Field name -> columns of the table."""
        slices, start = {}, 0
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
        return ", ".join(f"{field.name}[{field.width}]" if field.width else field.name for field in self.fields)

    @property
    def width(self) -> int:
        """Number of columns of the table."""
        return sum(max(field.width, 1) for field in self.floats)


def select_columns(spec: DatasetSpec, names: Iterable[str] | None) -> Columns:
    """Select fields by name, in the requested order.

    By default these are all float fields except for diagnostics, in the order of the specification. Fields of scenes
    have to be named.
    """
    if names is None:
        return Columns(tuple(field for field in spec.fields if field.dtype == "float" and field.role != "diagnostic"))
    if isinstance(names, str):
        raise UsageError(f"must be a list of names, got the text {names!r}: write [{names!r}]", argument="fields")
    given: Any = names
    if isinstance(given, bytes) or getattr(given, "ndim", 1) != 1:
        raise UsageError(f"must be a list of names, got {names!r:.100}", argument="fields")
    selected: Sequence[str] = tuple(names)
    texts = all(isinstance(name, str) for name in selected)
    if not selected or not texts or len(set(selected)) != len(selected):
        raise UsageError(f"must be one or more different names, got {list(selected)!s:.200}", argument="fields")
    of_scenes = {field.name: field for field in scene_fields(spec)}
    return Columns(tuple(of_scenes.get(name) or spec.field_named(name) for name in selected))


@dataclass(frozen=True, eq=False)
class RowFormat:
    """The format of loaded rows; without a normalization, float fields keep their units."""

    layout: Columns
    normalization: Normalization | None
    dtype: np.dtype[Any]

    def convert(self, rows: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Convert stored rows, of shape (k, width) or (k,) each, to this format."""
        values = dict(rows)
        if self.normalization is not None:  # in float64, as for batches
            values |= {name: values[name].astype(np.float64, copy=False) for name in self.layout.slices}
            values = self.normalization.normalize(values)
        return values | {name: values[name].astype(self.dtype, copy=False) for name in self.layout.slices}


def make_row_format(
    spec: DatasetSpec,
    own: Normalization | None,
    *,
    fields: Iterable[str] | None,
    normalize: bool | Normalization,
    dtype: DTypeLike | None,
) -> RowFormat:
    """Make the format of loaded rows from the options of a user.

    ``own`` is the normalization of the dataset, None without training rows. By default, rows have all float fields
    except for diagnostics, in the stored type.
    """
    normalization = normalize if isinstance(normalize, Normalization) else _own(spec, own, normalize)
    layout = select_columns(spec, fields)
    if normalization is not None:
        normalization.side_by_side(layout.floats)  # raises the error for a missing field here, and not in a thread
    return RowFormat(layout, normalization, _float_dtype(spec.dtype if dtype is None else dtype))


def _own(spec: DatasetSpec, own: Normalization | None, normalize: object) -> Normalization | None:
    if not isinstance(normalize, bool | np.bool_):
        text = f"must be True, False or the normalization of a dataset, got {normalize!r:.100}"
        raise UsageError(text, argument="normalize")
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
        raise UsageError(f"must be one of {', '.join(DTYPES)}, got {dtype!r}", argument="dtype")
    return float_type
