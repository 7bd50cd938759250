"""The forms of JSON documents: which keys a table has and of which type their values are, down to the last number.

A form is one of

* ``TEXT``, ``WHOLE`` (from 0 to 2^63 - 1), ``NUMBER`` (infinities are texts that ``float`` reads), ``ANYTHING``;
* ``Maybe(form)``: that, or null;
* ``[form]``: a list of such values;
* ``{"key": form}``: a table with these keys and perhaps others, which are not looked at;
* ``{EVERY: form}``: a table with any keys and such values.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

Form = Any
EVERY = "*"
LARGEST = 2**63 - 1


class Leaf(Enum):
    """What is no table and no list."""

    TEXT = "a text"
    WHOLE = f"a whole number from 0 to {LARGEST}"
    NUMBER = "a number"
    ANYTHING = "anything"


TEXT, WHOLE, NUMBER, ANYTHING = Leaf


@dataclass(frozen=True)
class Maybe:
    """A form, or null."""

    form: Form


def check_form(value: Any, form: Form, where: str = "") -> None:
    """Refuse a value that has another form.

    Args:
        value: What ``json.loads`` returned.
        form: The form.
        where: Dotted key of the value: ``"splits.train"``.

    Raises:
        ValueError: It has; the message says where, what was expected and what is there.
    """
    if isinstance(form, Maybe):
        if value is not None:
            check_form(value, form.form, where)
    elif isinstance(form, Leaf):
        if not _is(value, form):
            raise _wrong(where, form.value, value)
    elif isinstance(form, list):
        _check_list(value, form[0], where)
    else:
        _check_table(value, form, where)


def _check_list(value: Any, form: Form, where: str) -> None:
    if not isinstance(value, list):
        raise _wrong(where, "a list", value)
    for index, item in enumerate(value):
        check_form(item, form, f"{where}[{index}]")


def _check_table(value: Any, form: Mapping[str, Form], where: str) -> None:
    if not isinstance(value, dict):
        raise _wrong(where, "a table", value)
    if EVERY in form:
        for key, item in value.items():
            check_form(item, form[EVERY], _joined(where, key))
        return
    for key, expected in form.items():
        if key not in value:
            raise ValueError(f"{_joined(where, key)} is missing")
        check_form(value[key], expected, _joined(where, key))


def _is(value: Any, leaf: Leaf) -> bool:
    if leaf is ANYTHING:
        return True
    if leaf is TEXT:
        return isinstance(value, str)
    if isinstance(value, bool):
        return False
    if leaf is WHOLE:
        return isinstance(value, int) and 0 <= value <= LARGEST
    if isinstance(value, int):
        return abs(value) <= LARGEST
    return isinstance(value, float) or value in {"inf", "-inf", "nan"}


def _joined(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def _wrong(where: str, expected: str, value: Any) -> ValueError:
    shown = f"a list of {len(value)}" if isinstance(value, list) else "a table" if isinstance(value, dict) else ""
    return ValueError(f"{where or 'the document'} must be {expected}, got {shown or f'{value!r:.60}'}")
