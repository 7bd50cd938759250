"""The forms of JSON documents: which keys a table has and of which type their values are, down to the last number.

A form is one of

* ``TEXT``, ``WHOLE`` (from 0 to 2^63 - 1), ``NUMBER`` (infinities are texts that ``float`` reads), ``FINITE``,
  ``ANYTHING``;
* ``Maybe(form)``: that, or null;
* ``[form]``: a list of such values;
* ``{"key": form}``: a table with these keys and perhaps others, which are not looked at;
* ``{EVERY: form}``: a table with any keys and such values.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

Form = Any
EVERY = "*"
LARGEST = 2**63 - 1
_MISSING = object()
_NOT_FINITE = ("inf", "-inf", "nan")


class Leaf(Enum):
    """What is no table and no list."""

    TEXT = "a text"
    WHOLE = f"a whole number from 0 to {LARGEST}"
    NUMBER = "a number"
    FINITE = "a finite number"
    ANYTHING = "anything"


TEXT, WHOLE, NUMBER, FINITE, ANYTHING = Leaf


@dataclass(frozen=True)
class Maybe:
    """A form, or null."""

    form: Form


class FormError(ValueError):
    """A value that has another form.

    Args:
        text: What was expected and what is there.

    Attributes:
        where: Keys that lead to the value, the last one first: each level adds its own.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.where: list[str] = []

    def __str__(self) -> str:
        return f"{''.join(reversed(self.where)).lstrip('.') or 'the document'} {self.args[0]}"


def check_form(value: Any, form: Form) -> None:
    """Refuse a value that has another form.

    Args:
        value: What ``json.loads`` returned.
        form: The form.

    Raises:
        FormError: It has; the message says where, what was expected and what is there.
    """
    if isinstance(form, Leaf):
        if not _is(value, form):
            raise _wrong(form.value, value)
    elif isinstance(form, list):
        _check_list(value, form[0])
    elif isinstance(form, Maybe):
        if value is not None:
            check_form(value, form.form)
    else:
        _check_table(value, form)


def _check_list(value: Any, form: Form) -> None:
    if not isinstance(value, list):
        raise _wrong("a list", value)
    if isinstance(form, Leaf) and _are(value, form):
        return
    for index, item in enumerate(value):
        try:
            check_form(item, form)
        except FormError as error:
            error.where.append(f"[{index}]")
            raise


def _check_table(value: Any, form: Mapping[str, Form]) -> None:
    if not isinstance(value, dict):
        raise _wrong("a table", value)
    every = form.get(EVERY)
    for key in value if every else form:
        try:
            check_form(value.get(key, _MISSING), every or form[key])
        except FormError as error:
            error.where.append(f".{key}")
            raise


def _are(values: list[Any], leaf: Leaf) -> bool:
    """Whether all values are plainly so; where not, each is looked at: histograms are thousands of counts."""
    kinds = set(map(type, values))
    if kinds == {int}:
        low = 0 if leaf is WHOLE else -LARGEST
        return leaf in {WHOLE, NUMBER, FINITE} and low <= min(values) and max(values) <= LARGEST
    return (leaf is NUMBER and kinds == {float}) or (leaf is TEXT and kinds == {str})


def _is(value: Any, leaf: Leaf) -> bool:
    if leaf is ANYTHING:
        return value is not _MISSING
    if leaf is TEXT:
        return isinstance(value, str)
    if isinstance(value, bool):
        return False
    if leaf is WHOLE:
        return isinstance(value, int) and 0 <= value <= LARGEST
    if isinstance(value, int):
        return abs(value) <= LARGEST
    finite = isinstance(value, float) and math.isfinite(value)
    return finite or (leaf is NUMBER and (isinstance(value, float) or value in _NOT_FINITE))


def _wrong(expected: str, value: Any) -> FormError:
    if value is _MISSING:
        return FormError("is missing")
    shown = f"a list of {len(value)}" if isinstance(value, list) else "a table" if isinstance(value, dict) else ""
    return FormError(f"must be {expected}, got {shown or f'{value!r:.60}'}")
