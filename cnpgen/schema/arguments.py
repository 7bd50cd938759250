"""What functions are given from Python: whole numbers within bounds, finite numbers, arrays of them, yes or no."""

import math
import operator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError

Array = NDArray[Any]


def integer(name: str, value: Any, *, least: int, most: int | None = None) -> int:
    """Return an argument as an integer; NumPy's integers are some, True is none.

    Args:
        name: The argument's name.
        value: What was given.
        least: The smallest that makes sense.
        most: The largest one.

    Raises:
        UsageError: It is none, or too small or large.
    """
    try:
        found = operator.index(value)
    except TypeError:
        found = least - 1
    if not least <= found or (most is not None and found > most) or isinstance(value, bool):
        bounds = f"from {least} on" if most is None else f"from {least} to {most}"
        raise UsageError(f"{name} must be an integer {bounds}, got {value!r}")
    return found


def number(name: str, value: Any) -> float:
    """Return an argument as a float; any library's real numbers are some, texts, True, arrays and nan are none.

    Raises:
        UsageError: It is none, or not finite.
    """
    try:
        real = not isinstance(value, str | bytes | bool | np.bool_ | np.complexfloating) and np.ndim(value) == 0
        found = float(value) if real else math.nan
    except (TypeError, ValueError):
        found = math.nan
    if not math.isfinite(found):
        raise UsageError(f"{name} must be a finite number, got {value!r:.100}")
    return found


def numbers(name: str, values: ArrayLike, dtype: str = "float64", *, differentiable: bool = False) -> Array:
    """Return an argument as an array of floats, nan and inf included; texts, dates and complex numbers are none.

    Args:
        name: The argument's name.
        values: What was given: numbers, lists of them, arrays, or tensors on the CPU.
        dtype: "float64" or "float32".
        differentiable: Whether a gradient must not be lost: tensors that carry one are then refused, else detached.

    Raises:
        UsageError: These are no real numbers, or rows of different lengths, or not in the memory of this process.
    """
    if type(values) is np.ndarray and values.dtype == dtype:  # as most are
        return values
    wrong = f"{name} must be an array of numbers, got {type(values).__name__}"
    try:
        detached = values.detach() if hasattr(values, "detach") and not differentiable else values
        array = np.asarray(detached)
        if array.dtype == dtype:
            return array
        with np.errstate(over="ignore"):
            real: Array = array.real.astype(dtype, copy=False)
    except (TypeError, ValueError, RuntimeError) as error:  # the last from torch
        uneven = "inhomogeneous" in str(error)
        raise UsageError(f"{wrong}: {'its rows have different lengths' if uneven else error}") from error
    missing = array.dtype.kind == "O" and any(value is None for value in array.flat)
    if array.dtype.kind in "cUSmM" or missing:  # NumPy would drop imaginary parts, and read texts and None
        raise UsageError(f"{wrong}: {array.dtype} is no real type")
    return real


def flag(name: str, value: Any) -> bool:
    """Return an argument that must be True or False; NumPy's are some, 1 and "no" are none.

    Raises:
        UsageError: It is neither.
    """
    if not isinstance(value, bool | np.bool_):
        raise UsageError(f"{name} must be True or False, got {value!r:.100}")
    return bool(value)
