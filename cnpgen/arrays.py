"""Types of arrays; shapes and units are in the docstrings of functions."""

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
