"""Types of arrays, tables and documents; shapes and units are in the docstrings of functions."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers in double precision."""

AnyArray = NDArray[Any]
"""Numbers of a type that the caller chooses, such as float32 of stored rows."""

Vector3 = tuple[float, float, float]
"""Coordinates or lengths along x, y and z, or angles about them."""

Mask = NDArray[np.bool_]
"""Truth values, one for each entry."""

Integers = NDArray[np.int64]
"""Numbers of samples, plans or entries."""

Indices = NDArray[np.intp]
"""Positions in an array."""

Columns = dict[str, AnyArray]
"""The columns of N rows by their names, shape (N, width) or (N,) each."""

JsonObject = dict[str, Any]
"""A table of a JSON or TOML document: name -> text, number, bool, None, list or table."""

JsonMapping = Mapping[str, Any]
"""A table of a JSON or TOML document that is only read."""

TextRows = list[tuple[str, ...]]
"""The cells of the rows of a printed table."""

NamedErrors = Iterator[tuple[str, str]]
"""(name, error) pairs of the keys of a table, or of the arguments of a call."""

Names = tuple[str, ...]
"""Names of joints, columns, links or keys, in their order."""

AnyPath = str | Path
"""A path of a file or folder, as a caller may pass it."""

NamedNumbers = Mapping[str, float]
"""Numbers by the names of joints, links or parameters."""
