"""Which fields are loaded, and where they are in the packed table."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from cnpgen.errors import UsageError
from cnpgen.store.blueprint import Blueprint
from cnpgen.store.field import Field


@dataclass(frozen=True)
class Columns:
    """The fields that are loaded, in order. Fields of numbers share a table; integers are kept as they are.

    Attributes:
        fields: The fields.
    """

    fields: tuple[Field, ...]

    @cached_property
    def floats(self) -> tuple[Field, ...]:
        """The fields in the table."""
        return tuple(field for field in self.fields if field.dtype == "float")

    @cached_property
    def integers(self) -> tuple[Field, ...]:
        """The fields beside the table: counters and identities, which are neither converted nor normalised."""
        return tuple(field for field in self.fields if field.dtype != "float")

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Field name -> its columns of the table."""
        found, start = {}, 0
        for field in self.floats:
            found[field.name] = slice(start, start + max(field.width, 1))
            start += max(field.width, 1)
        return found

    @cached_property
    def scalars(self) -> frozenset[str]:
        """Names of the fields with one value per row: shape (rows,), not (rows, 1)."""
        return frozenset(field.name for field in self.fields if not field.width)

    @property
    def summary(self) -> str:
        """The fields in a few words, with their widths: ``"start_q[6], hit_speed"``."""
        return ", ".join(f"{field.name}[{field.width}]" if field.width else field.name for field in self.fields)

    @property
    def width(self) -> int:
        """Number of columns of the table."""
        return sum(max(field.width, 1) for field in self.floats)


def tail(field: Field) -> tuple[int, ...]:
    """Return the shape of a field's value in one row: (width,), or () for a scalar."""
    return (field.width,) if field.width else ()


def select_columns(blueprint: Blueprint, names: Iterable[str] | None) -> Columns:
    """Look fields up by name.

    Args:
        blueprint: The dataset's blueprint.
        names: Names in the order they are wanted in; by default all fields of numbers that are not diagnostics, in
            the blueprint's order.

    Raises:
        DatasetError: There is no such field.
        UsageError: The names are a single text, none, or not different.
    """
    if names is None:
        return Columns(
            tuple(field for field in blueprint.fields if field.dtype == "float" and field.role != "diagnostic")
        )
    if isinstance(names, str):
        raise UsageError(f"fields must be a list of names, got the text {names!r}: write [{names!r}]")
    wanted: Sequence[str] = tuple(names)
    if not wanted or len(set(wanted)) != len(wanted):
        raise UsageError(f"fields must be one or more different names, got {list(wanted)}")
    return Columns(tuple(blueprint.field_named(name) for name in wanted))
