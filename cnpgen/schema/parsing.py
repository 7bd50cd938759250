"""Parser of TOML tables to dataclasses: checks types, units and bounds, and reports errors with file and key."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import MISSING, dataclass
from typing import Any, NoReturn, TypeVar, get_args, get_origin

from cnpgen.documents import JsonObject
from cnpgen.errors import nearest
from cnpgen.schema.keys import Key, PerJoint, Range, RecipeLocation, keys
from cnpgen.schema.old_keywords import errors_of
from cnpgen.schema.units import (
    PLAUSIBLE_MAX,
    parse_number,
    parse_numbers,
    parse_range,
    show,
    suggested_unit,
)

T = TypeVar("T")

MAX_UNKNOWN_KEYS = 20  # unknown keys of a table that messages name

_IS_STORED = ContextVar("_IS_STORED", default=False)


@contextmanager
def stored_values() -> Iterator[None]:
    """Accept implausible values in the block: those of a stored recipe, which nobody can edit."""
    token = _IS_STORED.set(True)
    try:
        yield
    finally:
        _IS_STORED.reset(token)


Reader = Callable[[Any, RecipeLocation, list[str]], Any]
"""Function of (TOML value, location, errors) that returns an object, or None after adding to the errors."""


def parse(
    cls: type[T],
    table: object,
    *,
    where: RecipeLocation,
    errors: list[str],
    readers: Mapping[type, Reader] | None = None,
) -> T | None:
    """Build a dataclass declared with ``field`` from the table at a location; all values are in SI.

    Returns None after an error, and appends one line per error to ``errors``. Field
    types that are not tables of their own keys have ``readers``. Further conditions are
    checked by the dataclass: by a ValueError in ``__post_init__``, or by a method
    ``validate()`` that yields (key, error) pairs. The method also runs if other keys
    have errors, and then stops at the first use of such a key.
    """
    before = len(errors)
    parser = _Parser(errors, readers or {})
    made: T | None = parser.attempt(lambda: parser.table(cls, table, where), where)
    # Errors of nested tables count, too.
    return made if len(errors) == before else None


@dataclass(frozen=True)
class _Parser:
    """Parser of values of all supported types.

    None marks an error, since TOML has no null.
    """

    errors: list[str]
    readers: Mapping[type, Reader]

    def attempt(self, read: Callable[[], Any], where: RecipeLocation) -> Any:
        try:
            return read()
        except ValueError as error:
            self.errors.append(where.message(str(error)))
            return None

    def table(self, cls: type[T], table: Any, where: RecipeLocation) -> T | None:
        if not isinstance(table, dict):
            raise ValueError(f"expected a table, got {show(table)}")  # noqa: TRY004 - a user's error
        before = len(self.errors)
        known = {key.name: key for key in keys(cls)}
        unknown = [name for name in table if name not in known]
        for name in unknown[:MAX_UNKNOWN_KEYS]:
            hint = nearest(name, known) or f", known: {', '.join(known)}"
            self.errors.append((where / name).message(f"unknown key{hint}"))
        if len(unknown) > MAX_UNKNOWN_KEYS:
            self.errors.append(
                where.message(
                    f"and {len(unknown) - MAX_UNKNOWN_KEYS:,} more unknown keys"
                )
            )
        for name, key in known.items():
            if key.required and name not in table:
                self.errors.append(
                    (where / name).message(
                        f"missing key, expected {key.expected}: {key.doc}"
                    )
                )
        given = [key for name, key in known.items() if name in table]
        values = {
            key.name: self.value(key.hint, table[key.name], key, where / key.name)
            for key in given
        }
        # Checks of the whole table need all of its values.
        if len(self.errors) == before:
            made = cls(**values)
            self.check(errors_of(made), where)
            return made
        # The checks of the valid part are reported with the other errors.
        self.check(_first_errors_of(_partly(cls, known, values)), where)
        return None

    def check(self, errors: Iterable[tuple[str, str]], where: RecipeLocation) -> None:
        self.errors.extend((where / name).message(text) for name, text in errors)

    def value(self, hint: Any, value: Any, key: Key, where: RecipeLocation) -> Any:
        return self.attempt(lambda: self.read(hint, value, key, where), where)

    def read(self, hint: Any, value: Any, key: Key, where: RecipeLocation) -> Any:
        args = get_args(hint)
        # Kinds and references have readers of their own, which take any value.
        if hint in self.readers:
            return self.readers[hint](value, where, self.errors)
        if hint in _LEAVES:
            return _plausible(_LEAVES[hint](value, key), value, key)
        if dataclasses.is_dataclass(hint):
            return self.table(hint, value, where)  # type: ignore[arg-type]
        if get_origin(hint) is dict:
            return self.entries(args[1], value, key, where)
        if get_origin(hint) is tuple and args[0] is float:
            return _plausible(
                _floats(value, key, None if args[1] is Ellipsis else len(args)),
                value,
                key,
            )
        if get_origin(hint) is tuple:
            return self.array(
                args[0], None if args[1] is Ellipsis else len(args), value, key, where
            )
        raise ValueError(
            f"the type of this key, {hint}, is not one that a recipe can hold"
        )

    def array(
        self, hint: Any, count: int | None, values: Any, key: Key, where: RecipeLocation
    ) -> tuple[Any, ...]:
        _check_filled(list, values, key)
        # [0.1, 0.2] may mean one range or two points.
        if hint is Range and any(isinstance(item, int | float) for item in values):
            raise ValueError(
                f"expected a list of ranges, got {show(values)}; write a point as [0.1, 0.1]"
            )
        if count not in (None, len(values)):
            raise ValueError(
                f"expected {count} entries, got {len(values)}: {show(values)}"
            )
        return tuple(
            self.value(hint, item, key, where / index)
            for index, item in enumerate(values)
        )

    def entries(
        self, hint: Any, values: Any, key: Key, where: RecipeLocation
    ) -> JsonObject:
        _check_filled(dict, values, key)
        for name in values:
            if key.pattern and not re.fullmatch(key.pattern, name):
                self.errors.append(
                    (where / name).message(
                        f"the name {show(name)} does not match {key.pattern}"
                    )
                )
        return {
            name: self.value(hint, item, key, where / name)
            for name, item in values.items()
        }


class _Wrong:
    """Placeholder of a value with an error; every use raises TypeError."""

    def _refuse(self, *_: Any) -> NoReturn:
        raise TypeError("a value with an error cannot be used")

    __bool__ = __len__ = __iter__ = __eq__ = __ne__ = __lt__ = __le__ = __gt__ = (
        __ge__
    ) = _refuse
    __hash__ = None  # type: ignore[assignment]


def _partly(cls: type[T], known: Mapping[str, Key], values: Mapping[str, Any]) -> T:
    """Build an object with placeholders for missing values and values with errors."""
    made = object.__new__(cls)
    for name, key in known.items():
        value = values.get(name, key.default)
        object.__setattr__(
            made,
            name,
            _Wrong()
            if value is MISSING or (name in values and value is None)
            else value,
        )
    return made


def _first_errors_of(made: object) -> list[tuple[str, str]]:
    """List the errors of an object up to the first check that uses a value with an error."""
    found: list[tuple[str, str]] = []
    with suppress(TypeError, AttributeError):
        for error in errors_of(made):
            found.append(error)  # noqa: PERF402 - keeps the errors before an error
    return found


def _check_filled(kind: type, value: Any, key: Key) -> None:
    if not isinstance(value, kind):
        raise ValueError(f"expected {key.expected}, got {show(value)}")  # noqa: TRY004 - a user's error
    if not value:
        raise ValueError(f"is empty, expected at least one: {key.doc}")


def _float(value: Any, key: Key) -> float:
    return _bounded(parse_number(value, key.unit), key, value)


def _int(value: Any, key: Key) -> int:
    if isinstance(value, int) and not isinstance(value, bool):
        return _bounded(value, key, value)
    raise ValueError(f"expected an integer, got {show(value)}")


def _bool(value: Any, _: Key) -> bool:
    if isinstance(value, bool):
        return value
    raise ValueError(f"expected true or false, got {show(value)}")


def _str(value: Any, key: Key) -> str:
    if not isinstance(value, str):
        raise ValueError(f"expected a string, got {show(value)}")  # noqa: TRY004 - a user's error
    if key.choices and value not in key.choices:
        raise ValueError(
            f"expected {key.expected}, got {show(value)}{nearest(value, key.choices)}"
        )
    if key.pattern and not re.fullmatch(key.pattern, value):
        raise ValueError(f"{show(value)} does not match {key.pattern}: {key.doc}")
    return value


def _range(value: Any, key: Key) -> Range:
    low, high = parse_range(value, key.unit)
    return Range(_bounded(low, key, value), _bounded(high, key, value))


def _per_joint(value: Any, key: Key) -> PerJoint:
    several = isinstance(value, list) or (
        isinstance(value, str) and value.lstrip().startswith("[")
    )
    return PerJoint(_floats(value, key, None) if several else (_float(value, key),))


def _floats(value: Any, key: Key, count: int | None) -> tuple[float, ...]:
    return tuple(
        _bounded(number, key, value)
        for number in parse_numbers(value, key.unit, count=count)
    )


_Number = TypeVar("_Number", int, float)


def _bounded(number: _Number, key: Key, value: Any) -> _Number:
    unit = "" if key.unit == "1" else f" {key.unit}"
    if key.low is not None and number < key.low:
        raise ValueError(
            f"{number}{unit} is too small, expected at least {key.low:g}{unit}"
        )
    if key.high is not None and number > key.high:
        # A stated unit was meant.
        hint = (
            "" if _has_unit(value) else suggested_unit(number, key.unit, high=key.high)
        )
        raise ValueError(
            f"{number}{unit} is too large, expected at most {key.high:g}{unit}{hint}"
        )
    return number


def _plausible(read: Any, value: Any, key: Key) -> Any:
    """Return a value in SI; raise ValueError if it is probably in another unit, with a hint if it has no unit."""
    limit = (
        PLAUSIBLE_MAX.get(key.unit, math.inf)
        if key.plausible is None
        else key.plausible
    )
    if limit == math.inf or _IS_STORED.get():
        return read
    numbers = (
        (read.low, read.high)
        if isinstance(read, Range)
        else getattr(read, "values", read)
    )
    for number in numbers if isinstance(numbers, tuple) else (numbers,):
        if abs(number) > limit:
            size = (
                "small, expected at least -"
                if number < 0
                else "large, expected at most "
            )
            hint = (
                ""
                if _has_unit(value)
                else suggested_unit(number, key.unit, -limit, limit)
            )
            raise ValueError(
                f"{number} {key.unit} is too {size}{limit:.4g} {key.unit}{hint}"
            )
    return read


def _has_unit(value: Any) -> bool:
    """Return whether a TOML value states a unit."""
    items = value if isinstance(value, list) else [value]
    return any(
        isinstance(item, str) and bool(re.search(r"[a-zA-Z°](?![+-]?[0-9])", item))
        for item in items
    )


_LEAVES: dict[Any, Callable[[Any, Key], Any]] = {
    float: _float,
    int: _int,
    bool: _bool,
    str: _str,
    Range: _range,
    PerJoint: _per_joint,
}
