"""Estimates of memory: requests that exceed the available memory are refused before they start."""

from collections.abc import Mapping

from cnpgen.errors import UsageError

BYTES_PER_FLOAT = 8
MIN_CHECKED_SIZE = 10_000_000  # floats from which on the available memory is measured


def check_memory(argument: str, value: int, n_floats: int) -> None:
    """Refuse a request whose arrays do not fit into the available memory.

    Args:
        argument: Name of the argument that determines the size.
        value: Its value, for the error.
        n_floats: Lower bound of the number of floats in memory at a time.

    Raises:
        UsageError: The arrays need more than the available memory.
    """
    needed = n_floats * BYTES_PER_FLOAT
    if n_floats > MIN_CHECKED_SIZE and needed > (available := available_bytes()):
        text = f"{needed / 1e9:,.3g} GB of memory, {available / 1e9:,.3g} GB are available"
        raise UsageError(f"must be smaller: {value:,} needs at least {text}", argument=argument)


def check_memory_of_rows(counts: Mapping[str, int], n_floats: int) -> None:
    """Refuse arguments with too many rows, by the name of the one with the most.

    Args:
        counts: Argument -> its number of rows.
        n_floats: Lower bound of the number of floats in memory for a row.

    Raises:
        UsageError: The rows need more than the available memory.
    """
    argument = max(counts, key=lambda name: counts[name])
    check_memory(argument, counts[argument], counts[argument] * n_floats)


def available_bytes() -> int:
    """Return the memory that new arrays can use without swapping."""
    import psutil

    return int(psutil.virtual_memory().available)
