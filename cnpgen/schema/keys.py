"""Dataclasses whose fields are the keys of recipe tables: what each may be, in which unit, within which bounds."""

import dataclasses
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from cnpgen.schema.units import dimension, show


@dataclass(frozen=True)
class Range:
    """A closed interval; ``"0.16 m"`` reads as a single point.

    Attributes:
        low: Lower end, SI unit.
        high: Upper end, SI unit.
    """

    low: float
    high: float


def field(
    doc: str,
    *,
    unit: str = "1",
    default: Any = MISSING,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    pattern: str = "",
    form: str = "",
) -> Any:
    """Declare a key of a recipe table.

    Args:
        doc: What the key means, in a few words.
        unit: SI unit that the value is stored in; a quantity string in another unit of the same dimension is converted.
        default: Value when the key is absent; without it the key is required.
        low: Smallest allowed number.
        high: Largest allowed number.
        choices: Allowed strings.
        pattern: Regular expression that a string, or the names in a table of integers, must match.
        form: How the value is written, where the type does not say it.

    Returns:
        A dataclass field with this as metadata.
    """
    bounds = {"low": low, "high": high, "choices": choices, "pattern": pattern}
    return dataclasses.field(default=default, metadata={"doc": doc, "unit": unit, "form": form, **bounds})


@dataclass(frozen=True, kw_only=True)
class Key:
    """A key of a recipe table, as ``field`` declared it.

    Attributes:
        name: The key.
        hint: Type of the dataclass field, without ``| None``.
        default: Value when the key is absent, ``dataclasses.MISSING`` if it is required.
    """

    name: str
    hint: Any
    default: Any
    doc: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    pattern: str
    form: str

    @property
    def required(self) -> bool:
        """Whether the key has no default."""
        return self.default is MISSING

    @property
    def expected(self) -> str:
        """What to write, in a few words: ``"a range, each end a length [m]"``."""
        if self.choices:
            return "one of " + ", ".join(show(choice) for choice in self.choices)
        return self.form or _expected(self.hint, self.unit)


def keys(cls: type) -> tuple[Key, ...]:
    """List the keys of the table that a dataclass is read from, in order.

    Args:
        cls: A dataclass; its fields that ``field`` did not declare are no keys.
    """
    hints = get_type_hints(cls)
    return tuple(
        Key(name=spec.name, hint=_present(hints[spec.name]), default=spec.default, **spec.metadata)
        for spec in dataclasses.fields(cls)
        if "doc" in spec.metadata
    )


@dataclass(frozen=True)
class Place:
    """Where in which file something is: ``place / "robot" / "base"``, ``place / "stage" / 3``.

    Entries of a list are shown as people count them: the first stage is "stage 1".
    """

    file: str
    key: str = ""

    def __truediv__(self, key: str | int) -> "Place":
        if isinstance(key, int):
            return Place(self.file, f"{self.key} {key + 1}")
        bare = key if re.fullmatch(r"[\w-]{1,60}", key) else json.dumps(key[:60])
        return Place(self.file, f"{self.key}.{bare}" if self.key else bare)

    def says(self, text: str) -> str:
        """Return ``"FILE: key: text"``."""
        return ": ".join(part for part in (self.file, self.key, text) if part)


def to_dict(obj: Any, *, label: Callable[[Any], Mapping[str, Any]] = lambda _: {}) -> dict[str, Any]:
    """Turn an object declared with ``field`` into plain dicts, lists, numbers and strings, all in SI.

    Args:
        obj: The object; its fields that are no keys are left out.
        label: What else to write for a nested object, such as its registered name.
    """
    return {**label(obj), **{key.name: _plain(getattr(obj, key.name), label) for key in keys(type(obj))}}


def _plain(value: Any, label: Callable[[Any], Mapping[str, Any]]) -> Any:
    if isinstance(value, Range):
        return [value.low, value.high]
    if dataclasses.is_dataclass(value):
        return to_dict(value, label=label)
    if isinstance(value, tuple):
        return [_plain(item, label) for item in value]
    return dict(value) if isinstance(value, dict) else value


def _present(hint: Any) -> Any:
    """Return ``X`` for ``X | None``: TOML has no null, a key is there or not."""
    if get_origin(hint) not in (Union, UnionType):
        return hint
    options = [option for option in get_args(hint) if option is not type(None)]
    return options[0] if len(options) == 1 else hint


def _expected(hint: Any, unit: str) -> str:
    """Say what a value of a type is, in a few words."""
    args = get_args(hint)
    if get_origin(hint) is tuple:
        count = "a list" if args[-1] is Ellipsis else f"a list of {len(args)}"
        return f"{count}, each {_expected(args[0], unit)}"
    if get_origin(hint) is dict:
        return "a table of integers"
    if hint in (float, Range):
        return dimension(unit) if hint is float else f"a range, each end {dimension(unit)}"
    return {int: "an integer", bool: "true or false", str: "a string"}.get(hint, "a table")


NAME = "^[a-z0-9][a-z0-9-]{0,99}$"
