"""Keys of recipe tables, declared as dataclass fields with units and bounds."""

import dataclasses
import json
import re
from collections.abc import Callable, Hashable, Mapping
from dataclasses import MISSING, dataclass
from functools import cache
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from cnpgen.documents import JsonObject
from cnpgen.schema.units import dimension, show


@dataclass(frozen=True)
class Range:
    """Closed interval; ``"0.16 m"`` is a single point.

    Attributes:
        low: Lower end, SI unit.
        high: Upper end, SI unit.
    """

    low: float
    high: float


@dataclass(frozen=True)
class PerJoint:
    """One number per planned joint: ``"2 rad/s"`` for all joints, or a list.

    Attributes:
        values: Numbers in the SI unit; one, or one per joint.
    """

    values: tuple[float, ...]


def field(
    doc: str,
    *,
    unit: str = "1",
    default: Any = MISSING,
    low: float | None = None,
    high: float | None = None,
    plausible: float | None = None,
    choices: tuple[str, ...] = (),
    pattern: str = "",
    form: str = "",
    since_version: int = 1,
) -> Any:
    """Declare a key of a recipe table.

    Args:
        doc: Short description of the key.
        unit: SI unit of the stored value; quantities in other units of the same
            dimension are converted.
        default: Value of an absent key; without a default the key is required.
        low: Minimum value.
        high: Maximum value.
        plausible: Largest plausible absolute value: larger ones in a user's file are
            probably in another unit. By default that of the unit, ``PLAUSIBLE_MAX``.
        choices: Allowed strings.
        pattern: Regular expression that a string, or the names in a table of integers,
            must match.
        form: Notation of the value, if the type does not determine it; beside choices
            a remark on them.
        since_version: First version of the recipe schema with this key. Keys of
            versions later than 1 are omitted from records at their default, so that
            digests of older recipes stay the same.

    Returns:
        A dataclass field with this as metadata.
    """
    bounds = {
        "low": low,
        "high": high,
        "plausible": plausible,
        "choices": choices,
        "pattern": pattern,
    }
    return dataclasses.field(
        default=default,
        metadata={
            "doc": doc,
            "unit": unit,
            "form": form,
            "since_version": since_version,
            **bounds,
        },
    )


@dataclass(frozen=True, kw_only=True)
class Key:
    """Key of a recipe table, declared by ``field``."""

    name: str
    hint: Any  # type of the dataclass field, without ``| None``
    default: Any  # of an absent key; ``dataclasses.MISSING`` for required keys
    doc: str
    unit: str
    low: float | None
    high: float | None
    plausible: float | None
    choices: tuple[str, ...]
    pattern: str
    form: str
    since_version: int

    @property
    def required(self) -> bool:
        """Whether the key has no default."""
        return self.default is MISSING

    @property
    def expected(self) -> str:
        """Short description of valid values: ``"a range, each end a length [m]"``."""
        if self.choices:
            choices = "one of " + ", ".join(show(choice) for choice in self.choices)
            return f"{choices} ({self.form})" if self.form else choices
        return self.form or _expected(self.hint, self.unit)


def keys(cls: type) -> tuple[Key, ...]:
    """List the keys of a dataclass, in order.

    Fields that are not declared with ``field`` are not keys.
    """
    return _keys_of(cls)


@cache
def _keys_of(cls: Hashable) -> tuple[Key, ...]:
    assert isinstance(cls, type)
    hints = get_type_hints(cls)
    return tuple(
        Key(
            name=spec.name,
            hint=_present(hints[spec.name]),
            default=spec.default,
            **spec.metadata,
        )
        for spec in dataclasses.fields(cls)
        if "doc" in spec.metadata
    )


@dataclass(frozen=True)
class RecipeLocation:
    """Location in a recipe file: ``location / "robot" / "base"``, ``location / "stage" / 3``.

    Messages count list entries from 1: the first stage is "stage 1".
    """

    file: str
    key: str = ""

    def __truediv__(self, key: str | int) -> "RecipeLocation":
        if isinstance(key, int):
            # Entries of arrays are counted from 1 in messages.
            return RecipeLocation(self.file, f"{self.key} {key + 1}")
        bare = key if re.fullmatch(r"[\w-]{1,60}", key) else json.dumps(key[:60])
        return RecipeLocation(self.file, f"{self.key}.{bare}" if self.key else bare)

    def message(self, text: str) -> str:
        """Return ``"FILE: key: text"``."""
        return ": ".join(part for part in (self.file, self.key, text) if part)


def to_dict(
    obj: Any, *, label: Callable[[Any], Mapping[str, Any]] = lambda _: {}
) -> JsonObject:
    """Turn an object declared with ``field`` into plain dicts, lists, numbers and strings, all in SI.

    Fields that are not keys are omitted; ``label`` returns further entries of an
    object, such as its registered name.
    """
    values = ((key, getattr(obj, key.name)) for key in keys(type(obj)))
    return {
        **label(obj),
        **{
            k.name: _plain(value, label)
            for k, value in values
            # Keys that were added later are left out at their default, so that hashes
            # of older recipes stay the same.
            if not (k.since_version > 1 and value == k.default)
        },
    }


def _plain(value: Any, label: Callable[[Any], Mapping[str, Any]]) -> Any:
    if isinstance(value, Range):
        return [value.low, value.high]
    if isinstance(value, PerJoint):
        return list(value.values)
    if dataclasses.is_dataclass(value):
        return to_dict(value, label=label)
    if isinstance(value, tuple):
        return [_plain(item, label) for item in value]
    return dict(value) if isinstance(value, dict) else value


def alternatives(hint: Any) -> tuple[Any, ...]:
    """Return the alternatives of an annotation without None."""
    options = get_args(hint) if get_origin(hint) in {Union, UnionType} else (hint,)
    return tuple(option for option in options if option is not type(None))


def _present(hint: Any) -> Any:
    """Return ``X`` for ``X | None``, since TOML has no null."""
    options = alternatives(hint)
    return options[0] if len(options) == 1 else hint


def _expected(hint: Any, unit: str) -> str:
    """Return a short description of the values of a type."""
    args = get_args(hint)
    if get_origin(hint) is tuple:
        count = "a list" if args[-1] is Ellipsis else f"a list of {len(args)}"
        return f"{count}, each {_expected(args[0], unit)}"
    if get_origin(hint) is dict:
        return "a table of integers"
    if hint is PerJoint:
        return f"{dimension(unit)}, or a list of them, one per planned joint"
    if hint in (float, Range):
        return (
            dimension(unit) if hint is float else f"a range, each end {dimension(unit)}"
        )
    return {int: "an integer", bool: "true or false", str: "a string"}.get(
        hint, "a table"
    )


NAME = "^[a-z0-9][a-z0-9-]{0,99}$"
