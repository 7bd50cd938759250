"""What functions are given from Python: numbers that must be whole, within bounds."""

import operator
from typing import Any

from cnpgen.errors import UsageError


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
