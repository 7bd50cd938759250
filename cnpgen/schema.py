"""Dataclasses from TOML tables: types, units and bounds checked, every mistake reported with its file and key."""

import dataclasses
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from cnpgen.errors import nearest
from cnpgen.units import dimension, parse_number, parse_numbers, parse_range, show

T = TypeVar("T")


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
        bare = key if re.fullmatch(r"[\w-]+", key) else json.dumps(key)
        return Place(self.file, f"{self.key}.{bare}" if self.key else bare)

    def says(self, text: str) -> str:
        """Return ``"FILE: key: text"``."""
        return ": ".join(part for part in (self.file, self.key, text) if part)


Reader = Callable[[Any, Place, list[str]], Any]
"""A function of (TOML value, where it is, mistakes) that returns an object, or None after adding to the mistakes."""


def parse(
    cls: type[T],
    table: object,
    *,
    where: Place,
    mistakes: list[str],
    readers: Mapping[type, Reader] | None = None,
) -> T | None:
    """Build a dataclass declared with ``field`` from a TOML table.

    What types and bounds cannot say, a dataclass checks itself: with a ValueError in ``__post_init__``, or with a
    method ``find_mistakes()`` that yields pairs (key, what is wrong).

    Args:
        cls: The dataclass.
        table: What the TOML parser returned.
        where: Where the table is.
        mistakes: Every mistake is appended to it, one line each.
        readers: How to read fields of types that are not written as a table of their own keys.

    Returns:
        The object with all values in SI, or None if there was a mistake.
    """
    before = len(mistakes)
    parser = _Parser(mistakes, readers or {})
    made: T | None = parser.attempt(lambda: parser.table(cls, table, where), where)
    return made if len(mistakes) == before else None


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


@dataclass(frozen=True)
class _Parser:
    """Reads values of any supported type; what comes after a mistake is None, which no TOML value is."""

    mistakes: list[str]
    readers: Mapping[type, Reader]

    def attempt(self, read: Callable[[], Any], where: Place) -> Any:
        try:
            return read()
        except ValueError as error:
            self.mistakes.append(where.says(str(error)))
            return None

    def table(self, cls: type[T], table: Any, where: Place) -> T | None:
        if not isinstance(table, dict):
            raise ValueError(f"expected a table, got {show(table)}")  # noqa: TRY004 - a user's mistake
        before = len(self.mistakes)
        known = {key.name: key for key in keys(cls)}
        for name in [name for name in table if name not in known]:
            hint = nearest(name, known) or f", known: {', '.join(known)}"
            self.mistakes.append((where / name).says(f"unknown key{hint}"))
        for name, key in known.items():
            if key.required and name not in table:
                self.mistakes.append((where / name).says(f"missing key, expected {key.expected}: {key.doc}"))
        given = [key for name, key in known.items() if name in table]
        values = {key.name: self.value(key.hint, table[key.name], key, where / key.name) for key in given}
        return self.build(cls, values, where) if len(self.mistakes) == before else None

    def build(self, cls: type[T], values: Mapping[str, Any], where: Place) -> T:
        made = cls(**values)
        for name, text in getattr(made, "find_mistakes", tuple)():
            self.mistakes.append((where / name).says(text))
        return made

    def value(self, hint: Any, value: Any, key: Key, where: Place) -> Any:
        return self.attempt(lambda: self.read(hint, value, key, where), where)

    def read(self, hint: Any, value: Any, key: Key, where: Place) -> Any:
        args = get_args(hint)
        if hint in self.readers:
            return self.readers[hint](value, where, self.mistakes)
        if hint in _LEAVES:
            return _LEAVES[hint](value, key)
        if dataclasses.is_dataclass(hint):
            return self.table(hint, value, where)  # type: ignore[arg-type]
        if get_origin(hint) is dict:
            return self.entries(args[1], value, key, where)
        if get_origin(hint) is tuple and args[0] is float:
            return _floats(value, key, None if args[1] is Ellipsis else len(args))
        if get_origin(hint) is tuple:
            return self.array(args[0], None if args[1] is Ellipsis else len(args), value, key, where)
        raise ValueError(f"the type of this key, {hint}, is not one that a recipe can hold")

    def array(self, hint: Any, count: int | None, values: Any, key: Key, where: Place) -> tuple[Any, ...]:
        _check_filled(list, values, key)
        if hint is Range and any(isinstance(item, int | float) for item in values):
            raise ValueError(f"expected a list of ranges, got {show(values)}; write a point as [0.1, 0.1]")
        if count not in (None, len(values)):
            raise ValueError(f"expected {count} entries, got {len(values)}: {show(values)}")
        return tuple(self.value(hint, item, key, where / index) for index, item in enumerate(values))

    def entries(self, hint: Any, values: Any, key: Key, where: Place) -> dict[str, Any]:
        _check_filled(dict, values, key)
        for name in values:
            if key.pattern and not re.fullmatch(key.pattern, name):
                self.mistakes.append((where / name).says(f"the name {show(name)} does not match {key.pattern}"))
        return {name: self.value(hint, item, key, where / name) for name, item in values.items()}


def _check_filled(kind: type, value: Any, key: Key) -> None:
    if not isinstance(value, kind):
        raise ValueError(f"expected {key.expected}, got {show(value)}")  # noqa: TRY004 - a user's mistake
    if not value:
        raise ValueError(f"is empty, expected at least one: {key.doc}")


def _float(value: Any, key: Key) -> float:
    return _bounded(parse_number(value, key.unit), key)


def _int(value: Any, key: Key) -> int:
    if isinstance(value, int) and not isinstance(value, bool):
        return _bounded(value, key)
    raise ValueError(f"expected an integer, got {show(value)}")


def _bool(value: Any, _: Key) -> bool:
    if isinstance(value, bool):
        return value
    raise ValueError(f"expected true or false, got {show(value)}")


def _str(value: Any, key: Key) -> str:
    if not isinstance(value, str):
        raise ValueError(f"expected a string, got {show(value)}")  # noqa: TRY004 - a user's mistake
    if key.choices and value not in key.choices:
        raise ValueError(f"expected {key.expected}, got {show(value)}{nearest(value, key.choices)}")
    if key.pattern and not re.fullmatch(key.pattern, value):
        raise ValueError(f"{show(value)} does not match {key.pattern}: {key.doc}")
    return value


def _range(value: Any, key: Key) -> Range:
    low, high = parse_range(value, key.unit)
    return Range(_bounded(low, key), _bounded(high, key))


def _floats(value: Any, key: Key, count: int | None) -> tuple[float, ...]:
    return tuple(_bounded(number, key) for number in parse_numbers(value, key.unit, count=count))


_Number = TypeVar("_Number", int, float)


def _bounded(number: _Number, key: Key) -> _Number:
    unit = "" if key.unit == "1" else f" {key.unit}"
    if key.low is not None and number < key.low:
        raise ValueError(f"{number}{unit} is too small, expected at least {key.low:g}{unit}")
    if key.high is not None and number > key.high:
        raise ValueError(f"{number}{unit} is too large, expected at most {key.high:g}{unit}")
    return number


_LEAVES: dict[Any, Callable[[Any, Key], Any]] = {float: _float, int: _int, bool: _bool, str: _str, Range: _range}
