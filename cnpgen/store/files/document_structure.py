"""The structure of JSON documents: the keys of tables and the types of all values.

A structure is one of

* ``TEXT``, ``WHOLE`` (an integer from 0 to 2^63 - 1), ``NUMBER`` (infinities are texts that ``float`` reads),
  ``FINITE`` and ``ANYTHING``;
* ``Nullable(structure)``: a value with this structure, or null;
* ``[structure]``: a list of values with this structure;
* ``{"key": structure}``: a table with these keys; other keys are ignored;
* ``{ANY_KEY: structure}``: a table with any keys and values with this structure.

``structure_of`` is that of a type, such as a dataclass whose fields are stored.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from enum import Enum
from typing import Any, get_args, get_origin, get_type_hints

Structure = Any
ANY_KEY = "*"
MAX_INTEGER = 2**63 - 1
_MISSING = object()
_NOT_FINITE = ("inf", "-inf", "nan")


class Leaf(Enum):
    """The structure of a value that is neither a table nor a list."""

    TEXT = "a text"
    WHOLE = f"a whole number from 0 to {MAX_INTEGER}"
    NUMBER = "a number"
    FINITE = "a finite number"
    ANYTHING = "anything"


TEXT, WHOLE, NUMBER, FINITE, ANYTHING = Leaf


@dataclass(frozen=True)
class Nullable:
    """A structure, or null."""

    structure: Structure


_LEAVES = {str: TEXT, int: WHOLE, float: NUMBER}


def structure_of(hint: Any) -> Structure:
    """Return the structure of the values of a type: a leaf, a table, a list, a dataclass, or one of these or None.

    Values of other types, such as arrays, are ``ANYTHING``.
    """
    args = get_args(hint)
    if is_dataclass(hint):
        fields = get_type_hints(hint)
        return {name: structure_of(fields[name]) for name in hint.__dataclass_fields__}
    if type(None) in args:
        return Nullable(structure_of(args[0]))
    if get_origin(hint) is tuple:
        return [structure_of(args[0])]
    if get_origin(hint) in {dict, Mapping}:
        return {ANY_KEY: structure_of(args[1])}
    return _LEAVES.get(hint, ANYTHING)


class StructureError(ValueError):
    """A value that does not have the expected structure.

    Each level appends the key of the value to ``key_path``, which begins with the
    innermost one.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.key_path: list[str] = []

    def __str__(self) -> str:
        return f"{''.join(reversed(self.key_path)).lstrip('.') or 'the document'} {self.args[0]}"


def check_structure(value: Any, structure: Structure) -> None:
    """Raise StructureError, which names the key, if a result of ``json.loads`` has another structure."""
    if isinstance(structure, Leaf):
        if not _is(value, structure):
            raise _structure_error(structure.value, value)
    elif isinstance(structure, list):
        _check_list(value, structure[0])
    elif isinstance(structure, Nullable):
        if value is not None:
            check_structure(value, structure.structure)
    else:
        _check_table(value, structure)


def _check_list(value: Any, structure: Structure) -> None:
    if not isinstance(value, list):
        raise _structure_error("a list", value)
    # A list that the fast check does not accept is checked entry by entry, which names
    # the first wrong one.
    if isinstance(structure, Leaf) and _are_all(value, structure):
        return
    for index, item in enumerate(value):
        try:
            check_structure(item, structure)
        except StructureError as error:
            error.key_path.append(f"[{index}]")
            raise


def _check_table(value: Any, structure: Mapping[str, Structure]) -> None:
    if not isinstance(value, dict):
        raise _structure_error("a table", value)
    common = structure.get(ANY_KEY)
    # Without a common structure only the required keys are checked; others are allowed.
    for key in value if common else structure:
        try:
            check_structure(value.get(key, _MISSING), common or structure[key])
        except StructureError as error:
            # The path grows from the inside out.
            error.key_path.append(f".{key}")
            raise


def _are_all(values: list[Any], leaf: Leaf) -> bool:
    """Return whether all values have a structure, by a fast check for long lists.

    False if it cannot decide.
    """
    kinds = set(map(type, values))
    if kinds == {int}:
        low = 0 if leaf is WHOLE else -MAX_INTEGER
        return (
            leaf in {WHOLE, NUMBER, FINITE}
            and low <= min(values)
            and max(values) <= MAX_INTEGER
        )
    return (leaf is NUMBER and kinds == {float}) or (leaf is TEXT and kinds == {str})


def _is(value: Any, leaf: Leaf) -> bool:
    """Return whether a value has the structure of a leaf."""
    if leaf is ANYTHING:
        return value is not _MISSING
    if leaf is TEXT:
        return isinstance(value, str)
    # In Python a bool is an int.
    if isinstance(value, bool):
        return False
    if leaf is WHOLE:
        return isinstance(value, int) and 0 <= value <= MAX_INTEGER
    if isinstance(value, int):
        # Larger integers of JSON do not fit into int64.
        return abs(value) <= MAX_INTEGER
    finite = isinstance(value, float) and math.isfinite(value)
    return finite or (
        leaf is NUMBER and (isinstance(value, float) or value in _NOT_FINITE)
    )


def _structure_error(expected: str, value: Any) -> StructureError:
    if value is _MISSING:
        return StructureError("is missing")
    shown = (
        f"a list of {len(value)}"
        if isinstance(value, list)
        else "a table"
        if isinstance(value, dict)
        else ""
    )
    return StructureError(f"must be {expected}, got {shown or f'{value!r:.60}'}")
