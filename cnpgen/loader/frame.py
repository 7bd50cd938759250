"""Rows as a table of polars or pandas."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MissingExtraError, UsageError
from cnpgen.store.field import Field

LIBRARIES = ("polars", "pandas")


def make_frame(rows: Mapping[str, NDArray[Any]], fields: Sequence[Field], *, library: str | None) -> Any:
    """Convert rows, of shape (rows, width) or (rows,) each, to a table with columns in the order of the fields.

    The library is "polars" or "pandas"; by default the installed one, polars if both are.

    Returns:
        A ``DataFrame``; with pandas, ``attrs["units"]`` contains the units of the columns.

    Raises:
        UsageError: The library is not supported.
        MissingExtraError: The library is not installed.
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
    """Return the requested library, or the installed one."""
    if library is not None and library not in LIBRARIES:
        raise UsageError(f"must be one of {', '.join(LIBRARIES)}, got {library!r}", argument="library")
    candidates = LIBRARIES if library is None else (library,)
    installed = next((name for name in candidates if find_spec(name) is not None), None)
    if installed is None:
        text = f"a frame needs {' or '.join(candidates)}, not installed here: pip install 'cnpgen[{candidates[0]}]'"
        raise MissingExtraError(text)
    return installed
