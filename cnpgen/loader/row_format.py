"""The format of loaded rows: fields, normalization and type."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.columns import Columns, select_columns
from cnpgen.loader.normalization import Normalization
from cnpgen.store.dataset_spec import DatasetSpec

DTYPES = ("float32", "float64")


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

    Raises:
        DatasetError: There is no such field, or there are no statistics for its normalization.
        UsageError: The names, the normalization or the type are invalid.
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
