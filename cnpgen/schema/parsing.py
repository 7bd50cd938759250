"""Dataclasses from TOML tables: types, units and bounds checked, every mistake reported with its file and key."""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, dataclass
from typing import Any, NoReturn, TypeVar, get_args, get_origin

from cnpgen.errors import nearest
from cnpgen.schema.keys import Key, Place, Range, keys
from cnpgen.schema.units import parse_number, parse_numbers, parse_range, show

T = TypeVar("T")

MOST_UNKNOWN = 20  # unknown keys of a table that are named; the others are counted

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
    method ``find_mistakes()`` that yields pairs (key, what is wrong). The latter is also asked where other keys have
    mistakes, and then gets as far as it needs none of those.

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
        unknown = [name for name in table if name not in known]
        for name in unknown[:MOST_UNKNOWN]:
            hint = nearest(name, known) or f", known: {', '.join(known)}"
            self.mistakes.append((where / name).says(f"unknown key{hint}"))
        if len(unknown) > MOST_UNKNOWN:
            self.mistakes.append(where.says(f"and {len(unknown) - MOST_UNKNOWN:,} more unknown keys"))
        for name, key in known.items():
            if key.required and name not in table:
                self.mistakes.append((where / name).says(f"missing key, expected {key.expected}: {key.doc}"))
        given = [key for name, key in known.items() if name in table]
        values = {key.name: self.value(key.hint, table[key.name], key, where / key.name) for key in given}
        if len(self.mistakes) == before:
            made = cls(**values)
            self.check(_mistakes_of(made), where)
            return made
        self.check(_first_mistakes_of(_partly(cls, known, values)), where)
        return None

    def check(self, mistakes: Iterable[tuple[str, str]], where: Place) -> None:
        self.mistakes.extend((where / name).says(text) for name, text in mistakes)

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


class _Wrong:
    """Stands for a value with a mistake: nothing that depends on it can be checked."""

    def _refuse(self, *_: Any) -> NoReturn:
        raise TypeError("nothing is known of a value with a mistake")

    __bool__ = __len__ = __iter__ = __eq__ = __ne__ = __lt__ = __le__ = __gt__ = __ge__ = _refuse
    __hash__ = None  # type: ignore[assignment]


def _partly(cls: type[T], known: Mapping[str, Key], values: Mapping[str, Any]) -> T:
    """Build an object of which some values have mistakes or are missing."""
    made = object.__new__(cls)
    for name, key in known.items():
        value = values.get(name, key.default)
        object.__setattr__(made, name, _Wrong() if value is MISSING or (name in values and value is None) else value)
    return made


def _mistakes_of(made: object) -> Iterable[tuple[str, str]]:
    found: Iterable[tuple[str, str]] = getattr(made, "find_mistakes", tuple)()
    return found


def _first_mistakes_of(made: object) -> list[tuple[str, str]]:
    """List the mistakes of an object up to the first check that needs a value which has one."""
    found: list[tuple[str, str]] = []
    with suppress(TypeError, AttributeError):
        for mistake in _mistakes_of(made):
            found.append(mistake)  # noqa: PERF402 - what was found before an error is kept
    return found


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
