"""Frozen dataclasses of values that are known to be valid, without the time of their checks."""

from typing import Any, TypeVar

T = TypeVar("T")


def unchecked(cls: type[T], *values: Any) -> T:
    """Build an object of a dataclass from the values of all of its fields in order, without ``__post_init__``.

    Only for values whose types and shapes follow from other ones that were checked.

    Raises:
        ValueError: There are fewer or more values than fields.
    """
    made = object.__new__(cls)
    names = cls.__dataclass_fields__  # type: ignore[attr-defined]
    # A frozen dataclass refuses assignments; its dictionary takes all at once.
    vars(made).update(zip(names, values, strict=True))
    return made
