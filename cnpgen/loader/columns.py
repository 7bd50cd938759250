"""The fields to load and their columns in the packed table."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cnpgen.errors import UsageError
from cnpgen.loader.scene_columns import scene_fields
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.field import Field


@dataclass(frozen=True)
class Columns:
    """The fields to load, in order. Float fields share a table; integer fields are separate arrays."""

    fields: tuple[Field, ...]

    @cached_property
    def floats(self) -> tuple[Field, ...]:
        """The float fields, which are in the table."""
        return tuple(field for field in self.fields if field.dtype == "float")

    @cached_property
    def integers(self) -> tuple[Field, ...]:
        """The integer fields, which are neither in the table nor normalized."""
        return tuple(field for field in self.fields if field.dtype != "float")

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Field name -> columns of the table."""
        slices, start = {}, 0
        for field in self.floats:
            slices[field.name] = slice(start, start + max(field.width, 1))
            start += max(field.width, 1)
        return slices

    @cached_property
    def scalars(self) -> frozenset[str]:
        """Names of the fields with one value per row: shape (rows,), not (rows, 1)."""
        return frozenset(field.name for field in self.fields if not field.width)

    @property
    def summary(self) -> str:
        """The fields with their widths: ``"start_q[6], hit_speed"``."""
        return ", ".join(f"{field.name}[{field.width}]" if field.width else field.name for field in self.fields)

    @property
    def width(self) -> int:
        """Number of columns of the table."""
        return sum(max(field.width, 1) for field in self.floats)


def select_columns(spec: DatasetSpec, names: Iterable[str] | None) -> Columns:
    """Select fields by name, in the requested order.

    By default these are all float fields except for diagnostics, in the order of the specification. Fields of scenes
    have to be named.

    Raises:
        DatasetError: There is no such field.
        UsageError: The names are a single text, empty or not unique.
    """
    if names is None:
        return Columns(tuple(field for field in spec.fields if field.dtype == "float" and field.role != "diagnostic"))
    if isinstance(names, str):
        raise UsageError(f"must be a list of names, got the text {names!r}: write [{names!r}]", argument="fields")
    given: Any = names
    if isinstance(given, bytes) or getattr(given, "ndim", 1) != 1:
        raise UsageError(f"must be a list of names, got {names!r:.100}", argument="fields")
    selected: Sequence[str] = tuple(names)
    texts = all(isinstance(name, str) for name in selected)
    if not selected or not texts or len(set(selected)) != len(selected):
        raise UsageError(f"must be one or more different names, got {list(selected)!s:.200}", argument="fields")
    of_scenes = {field.name: field for field in scene_fields(spec)}
    return Columns(tuple(of_scenes.get(name) or spec.field_named(name) for name in selected))
