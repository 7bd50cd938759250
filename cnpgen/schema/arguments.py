"""Validation of Python arguments: bounded integers, finite numbers, arrays that fit into memory, and flags."""

import functools
import math
import operator
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import AnyArray
from cnpgen.errors import RecipeError, UsageError, nearest
from cnpgen.schema.units import suggested_unit

BYTES_PER_FLOAT = 8
MIN_CHECKED_SIZE = 10_000_000  # floats from which on the available memory is measured


class UnexpectedValueError(UsageError):
    """An argument of another type or value than expected.

    Args:
        expected: Noun of the accepted values: "an integer".
        got: The value, or its type.
        argument: Name of the argument.
    """

    def __init__(self, expected: str, got: str, *, argument: str) -> None:
        super().__init__(f"must be {expected}, got {got}", argument=argument)
        self.expected = expected
        self.got = got

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle for worker processes."""
        create = functools.partial(type(self), argument=self.argument or "")
        return create, (self.expected, self.got), vars(self)


def integer(
    name: str, value: Any, *, least: int | None = None, most: int | None = None
) -> int:
    """Return an argument as an integer.

    Accept NumPy integers, raise UsageError for bool and values out of range.
    """
    try:
        # In Python a bool is an integer; operator.index refuses floats.
        found = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        found = None
    if (
        found is None
        or (least is not None and found < least)
        or (most is not None and found > most)
    ):
        bounds = (
            ""
            if least is None
            else f" from {least} on"
            if most is None
            else f" from {least} to {most}"
        )
        raise UnexpectedValueError(
            f"an integer{bounds}", f"{value!r:.100}", argument=name
        )
    return found


def number(name: str, value: Any) -> float:
    """Return an argument as a float; accept real scalars of all libraries.

    Raises:
        UsageError: The value is a text, a bool, an array, or not finite.
    """
    try:
        real = (
            not isinstance(value, str | bytes | bool | np.bool_ | np.complexfloating)
            and np.ndim(value) == 0
        )
        found = float(value) if real else math.nan
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise UnexpectedValueError("a finite number", f"{value!r:.100}", argument=name)
    return found


def positive(name: str, value: Any, unit: str = "") -> float:
    """Return an argument [unit] as a float; raise UsageError if it is not finite and above 0."""
    found = number(name, value)
    if found <= 0:
        raise UsageError(
            f"must be above 0{unit and ' '}{unit}, got {value}", argument=name
        )
    return found


def not_negative(name: str, value: Any) -> float:
    """Return an argument as a float; raise UsageError if it is not finite, or negative."""
    found = number(name, value)
    if found < 0:
        raise UsageError(f"must not be negative, got {value}", argument=name)
    return found


def numbers(
    name: str,
    values: ArrayLike,
    dtype: str = "float64",
    *,
    differentiable: bool = False,
) -> AnyArray:
    """Return an argument as an array of "float64" or "float32"; accept nan and inf, and tensors on the CPU.

    Tensors with gradients are detached or, with ``differentiable``, raise an error.

    Raises:
        UsageError: The values are texts, dates or complex numbers, have uneven rows, or
            are not in CPU memory.
    """
    if type(values) is np.ndarray and values.dtype == dtype:  # the usual case
        return _fitting(name, values)
    reject_masked(name, values)
    wrong = f"must be an array of numbers, got {type(values).__name__}"
    try:
        # Tensors with gradients refuse the conversion to NumPy.
        detached = (
            values.detach()
            if hasattr(values, "detach") and not differentiable
            else values
        )
        array = _fitting(name, np.asarray(detached))
        if array.dtype == dtype:
            return array
        with np.errstate(over="ignore"):
            real: AnyArray = array.real.astype(dtype, copy=False)
    except (TypeError, ValueError, RuntimeError) as error:
        # The last from torch.
        uneven = "inhomogeneous" in str(error)
        raise UsageError(
            f"{wrong}: {'its rows have different lengths' if uneven else error}",
            argument=name,
        ) from error
    missing = array.dtype.kind == "O" and any(value is None for value in array.flat)
    if array.dtype.kind in "cUSmM" or missing:
        # NumPy would drop imaginary parts and convert texts and None
        raise UsageError(f"{wrong}: {array.dtype} is no real type", argument=name)
    return real


def _fitting(name: str, array: AnyArray) -> AnyArray:
    """Return an array if a copy of it fits into memory: views that repeat values may be of any size."""
    if array.size > MIN_CHECKED_SIZE:
        check_memory(name, len(array), array.size)
    return array


def check_range(
    name: str, values: ArrayLike, low: float, high: float, unit: str
) -> None:
    """Raise UsageError for values [unit] outside of their range or nan, with the unit that was probably meant."""
    array = np.asarray(values, np.float64)
    # Negated, so that nan is outside.
    outside = ~((low <= array) & (array <= high))
    if outside.any():
        value = float(array[outside].flat[0])
        first, last, got = distinct(low, high, value)
        text = f"must be from {first} to {last} {unit}, got {got} {unit}"
        raise UsageError(text + suggested_unit(value, unit, low, high), argument=name)


def distinct(*values: float, digits: int = 6) -> tuple[str, ...]:
    """Write numbers with as few significant digits as distinguish different ones, at least ``digits``."""
    different = len({float(value) for value in values if not math.isnan(value)})
    different += any(math.isnan(value) for value in values)
    texts = tuple(f"{value:.{digits}g}" for value in values)
    while len(set(texts)) < different:
        # 17 digits distinguish all floats
        digits += 1
        texts = tuple(f"{value:.{digits}g}" for value in values)
    return texts


def reject_masked(name: str, values: Any) -> Any:
    """Return an argument; raise UsageError for masked arrays and lists of them, whose masks NumPy's functions drop."""
    parts = values if isinstance(values, list | tuple) else [values]
    if any(isinstance(part, np.ma.MaskedArray) for part in parts):
        raise UsageError(
            "must not be a masked array: pass filled values, such as values.filled(0.0)",
            argument=name,
        )
    return values


@contextmanager
def concerning(argument: str) -> Iterator[None]:
    """Attribute errors about arguments of a function that is called in the block to an argument of the caller."""
    try:
        yield
    except RecipeError as error:
        if error.argument is not None:
            error.argument = argument
        raise
    except UsageError as error:
        raise UsageError(str(error), concerns=argument) from error


def flag(name: str, value: Any) -> bool:
    """Return an argument as a bool.

    Accept NumPy's bool, raise UsageError for other types such as 1 and "no".
    """
    if not isinstance(value, bool | np.bool_):
        raise UnexpectedValueError("True or False", f"{value!r:.100}", argument=name)
    return bool(value)


def check_choice(argument: str, value: object, known: Collection[str]) -> None:
    """Refuse a value that is none of the known ones, with the nearest of them."""
    if value not in known:
        raise UsageError(
            f"must be one of {', '.join(known)}, got {value!r}{nearest(str(value), known)}",
            argument=argument,
        )


def check_memory(argument: str, value: int, n_floats: int) -> None:
    """Refuse a request whose arrays need more than the available memory.

    Args:
        argument: Name of the argument that determines the size.
        value: Its value, for the error.
        n_floats: Lower bound of the number of floats in memory at a time.
    """
    needed = n_floats * BYTES_PER_FLOAT
    if n_floats > MIN_CHECKED_SIZE and needed > (available := available_bytes()):
        text = (
            f"{needed / 1e9:,.3g} GB of memory, {available / 1e9:,.3g} GB are available"
        )
        raise UsageError(
            f"must be smaller: {value:,} needs at least {text}", argument=argument
        )


def check_memory_of_rows(counts: Mapping[str, int], n_floats: int) -> None:
    """Refuse arguments, name -> number of rows, of at least so many floats.

    Name the one with most rows.
    """
    argument = max(counts, key=lambda name: counts[name])
    check_memory(argument, counts[argument], counts[argument] * n_floats)


def available_bytes() -> int:
    """Return the memory that new arrays can use without swapping."""
    import psutil

    return int(psutil.virtual_memory().available)
