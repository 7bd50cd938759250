"""Rows as a table of polars or pandas."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError, UsageError
from cnpgen.store.field import Field

LIBRARIES = ("polars", "pandas")


def make_frame(rows: Mapping[str, NDArray[Any]], fields: Sequence[Field], *, library: str | None) -> Any:
    """Lay rows out as a table.

    Args:
        rows: Field name -> values, shape (rows, width) or (rows,).
        fields: The fields, in the order of the table's columns.
        library: "polars" or "pandas"; None for the one that is installed, polars if both are.

    Returns:
        A ``DataFrame``; that of pandas has the units of its columns in ``attrs["units"]``.

    Raises:
        UsageError: There is no such library.
        MachineError: It is not installed.
    """
    name = _installed(library)
    columns = {
        column: np.ascontiguousarray(values)
        for field in fields
        for column, values in zip(field.columns, np.atleast_2d(rows[field.name].T), strict=True)
    }
    frame = import_module(name).DataFrame(columns)
    if name == "pandas":
        frame.attrs["units"] = dict(pair for field in fields for pair in zip(field.columns, field.units, strict=True))
    return frame


def _installed(library: str | None) -> str:
    """Return the library that is meant."""
    if library is not None and library not in LIBRARIES:
        raise UsageError(f"library must be one of {', '.join(LIBRARIES)}, got {library!r}")
    wanted = LIBRARIES if library is None else (library,)
    found = next((name for name in wanted if find_spec(name) is not None), None)
    if found is None:
        raise MachineError(f"a frame needs {' or '.join(wanted)}, not installed here: pip install {wanted[0]}")
    return found
