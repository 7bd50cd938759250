"""What is delivered of every row: which fields, in which units and type."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.columns import Columns, select_columns
from cnpgen.loader.normalization import Normalization
from cnpgen.store.blueprint import Blueprint

DTYPES = ("float32", "float64")


@dataclass(frozen=True, eq=False)
class Form:
    """What is delivered of every row.

    Attributes:
        layout: The fields and their places in the packed table.
        normalization: How fields of numbers are normalised; None to keep their units.
        dtype: Type of the fields of numbers.
    """

    layout: Columns
    normalization: Normalization | None
    dtype: np.dtype[Any]

    def applied(self, rows: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Bring rows as they are stored into this form.

        Args:
            rows: Field name -> values, shape (k, width) or (k,).
        """
        found = dict(rows)
        if self.normalization is not None:  # in float64, as batches are, whatever the rows are stored as
            found |= {name: found[name].astype(np.float64, copy=False) for name in self.layout.slices}
            found = self.normalization.normalize(found)
        return found | {name: found[name].astype(self.dtype, copy=False) for name in self.layout.slices}


def make_form(
    blueprint: Blueprint,
    own: Normalization | None,
    *,
    fields: Iterable[str] | None,
    normalize: bool | Normalization,
    dtype: DTypeLike | None,
) -> Form:
    """Settle what is delivered.

    Args:
        blueprint: The dataset's blueprint.
        own: The dataset's own normalisation, if it has training rows.
        fields: Names of the fields; by default all fields of numbers that are not diagnostics.
        normalize: Whether to normalise, or what with instead of the dataset's own.
        dtype: Type of the fields of numbers; None for the stored one.

    Raises:
        DatasetError: There is no such field, or nothing to normalise it with.
        UsageError: The names, the normalisation or the type cannot be meant.
    """
    normalization = normalize if isinstance(normalize, Normalization) else _own(blueprint, own, normalize)
    layout = select_columns(blueprint, fields)
    if normalization is not None:
        normalization.side_by_side(layout.floats)  # a missing field is noticed here, not in a thread
    return Form(layout, normalization, _float_dtype(blueprint.dtype if dtype is None else dtype))


def _own(blueprint: Blueprint, own: Normalization | None, normalize: object) -> Normalization | None:
    if not isinstance(normalize, bool | np.bool_):
        raise UsageError(f"normalize must be True, False or the normalization of a dataset, got {normalize!r:.100}")
    if normalize and own is None:
        raise DatasetError(
            f"{blueprint.name} has no training rows to normalise with; pass normalize=False, or the normalization of"
            " the dataset that the model was trained on"
        )
    return own if normalize else None


def _float_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    try:
        found = np.dtype(dtype)
    except TypeError:
        found = None
    if found is None or found.name not in DTYPES:
        raise UsageError(f"dtype must be one of {', '.join(DTYPES)}, got {dtype!r}")
    return found
