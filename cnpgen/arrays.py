"""Types of arrays; shapes and units are in the docstrings of functions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers in double precision."""

AnyArray = NDArray[Any]
"""Numbers of a type that the caller chooses, such as float32 of stored rows."""
