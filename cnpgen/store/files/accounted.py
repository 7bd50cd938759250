"""Accounted documents: mappings and lists of a file that record which elements a reader used.

Every element of an input is treated in one of three ways. It is used; it is refused by name; or
it cannot change the answer and is listed as unused. A reader wraps its document once by
``accounted`` and reads it as plain mappings and lists. ``Account.finish`` then raises an
error for every other element, with its path and the nearest known name.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from cnpgen.errors import UsageError, counted, listed, nearest

ALLOW_UNUSED = "allow_unused"  # argument that accepts the loss of an element by name
MAX_REPORTED = 10  # elements that one error names
MISSPELT = 0.75  # least share of equal letters of a misspelt key


@dataclass(frozen=True)
class UnusedElements:
    """Elements of a format that its reader does not use, because they cannot change the answer.

    The keys are ends of paths, such as ``header.stamp``, or whole paths that begin with
    a dot, such as ``.name``; the values are the reasons.

    Attributes:
        harmless: Names, colors, time stamps and the like, which are not reported.
        unused: Elements for other software, which are listed in one line.
    """

    harmless: Mapping[str, str]
    unused: Mapping[str, str] = field(default_factory=dict)

    def known(self) -> set[str]:
        """Return the last keys of all entries."""
        return {path.rpartition(".")[2] for path in (*self.harmless, *self.unused)}


class Account:
    """Record of the elements of one document that were used, accepted as unused, or refused.

    Args:
        place: File, and part of it, for messages.
        known: Elements that cannot change the answer.
        allow_unused: Keys or ends of paths whose loss the caller accepts.
        error: Class of the errors.

    Attributes:
        unused: Elements for other software that the document has.
        accepted: Elements whose loss the caller accepted.
    """

    def __init__(
        self,
        place: str,
        known: UnusedElements,
        *,
        allow_unused: Sequence[str] = (),
        error: type[UsageError] = UsageError,
    ) -> None:
        self.place = place
        self.known = known
        self.error = error
        self._allowed = tuple(allow_unused)
        self.unused: list[str] = []
        self.accepted: list[str] = []
        # Of all mappings, for suggestions.
        self.keys: set[str] = set()

    def refuse(self, path: str, value: object, text: str) -> None:
        """Raise an error for an element that the reader does not honour, unless its loss is accepted."""
        if _matches(path, self._allowed):
            self.accepted.append(_plain(path))
            return
        key = _plain(path).rpartition(".")[2]
        raise self.error(
            f"{self.place}: {path} is {_summary(value)}: {text}; {{{ALLOW_UNUSED}}} leaves it unused",
            remedies={ALLOW_UNUSED: key},
        )

    def finish(self, *documents: AccountedMapping) -> None:
        """Raise an error for all elements that were not used and are not known to be harmless."""
        unknown = []
        for document in documents:
            for path, known in document.unread():
                # Order: elements that are not reported, elements for other software,
                # and those whose loss the caller accepts.
                if _matches(path, self.known.harmless):
                    continue
                if _matches(path, self.known.unused):
                    self.unused.append(_plain(path))
                elif _matches(path, self._allowed):
                    self.accepted.append(_plain(path))
                else:
                    names = known | self.known.known()
                    key = _plain(path).rpartition(".")[2]
                    # Of a list, which has no name.
                    is_entry = path.endswith("]")
                    hint = "" if is_entry else nearest(key, sorted(names))
                    unknown.append((key, f"{path}{hint}"))
        if unknown:
            count = counted(len(unknown), "unknown element")
            texts = listed([text for _, text in unknown], MAX_REPORTED)
            raise self.error(
                f"{self.place} has {count}, {texts}; {{{ALLOW_UNUSED}}} leaves one unused",
                remedies={ALLOW_UNUSED: unknown[0][0]},
            )


def unmatched(keys: Sequence[str], paths: Sequence[str]) -> list[str]:
    """Return the keys that name none of some elements.

    Raises:
        UsageError: A key is no text.
    """
    if wrong := [key for key in keys if not isinstance(key, str)]:
        raise UsageError(f"must be names, got {wrong[0]!r:.60}", argument=ALLOW_UNUSED)
    return [key for key in keys if not any(_matches(path, [key]) for path in paths)]


def check_allowed(
    keys: Sequence[str], unused: Sequence[str], known: Iterable[str] = ()
) -> None:
    """Raise UsageError if the loss of an element is accepted that no document has, or that is used.

    Args:
        keys: Keys or ends of paths of elements whose loss the caller accepts.
        unused: Paths of the unused elements of all documents.
        known: Keys of the documents, for suggestions.
    """
    for key in unmatched(keys, unused):
        names = sorted({*known, *unused})
        hint = " that is refused" if key in names else nearest(key, names)
        raise UsageError(
            f"must name a refused or unknown element of the input, which has no {key!r}{hint}",
            argument=ALLOW_UNUSED,
        )


def misspelt(*documents: AccountedMapping) -> str:
    """Describe the elements not read so far whose names are near one that is missing beside them; empty without any.

    A misspelt key looks like a missing one, and an error about the latter ends the
    reading.
    """
    found = [text for document in documents for text in document.misspelt()]
    return f"unknown: {listed(found, MAX_REPORTED)}" if found else ""


class AccountedMapping(dict[str, Any]):
    """Mapping that records which of its keys were read."""

    def __init__(self, values: Mapping[str, Any], path: str, account: Account) -> None:
        super().__init__(
            (key, _wrapped(value, f"{path}.{key}" if path else str(key), account))
            for key, value in values.items()
        )
        self.path = path
        self.account = account
        account.keys.update(self)
        # Also keys that the mapping lacks.
        self._read: set[str] = set()
        # Keys whose presence was checked.
        self._known: set[str] = set()

    def __contains__(self, key: object) -> bool:
        self._known.add(str(key))
        return super().__contains__(key)

    def __getitem__(self, key: str) -> Any:
        self._read.add(key)
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return a value and record it as read."""
        self._read.add(key)
        return super().get(key, default)

    def items(self) -> Any:
        """Return all entries and record them as read."""
        self._read.update(self)
        return super().items()

    def refuse(self, key: str, text: str) -> None:
        """Refuse an element that is not honoured; empty and zero values have no effect and are accepted."""
        value = self.get(key)
        if not is_default(value):
            path = f"{self.path}.{key}" if self.path else key
            self.account.refuse(path, value, text)
        mark_read(value)

    def unread(self) -> Iterator[tuple[str, set[str]]]:
        """Yield the paths of the outermost elements that were not read, with the known keys beside them."""
        for key, value in dict.items(self):
            # An unread mapping is reported as a whole, without its entries.
            if key not in self._read:
                known = self._read | self._known
                yield (f"{self.path}.{key}" if self.path else key), known
            elif isinstance(value, AccountedMapping | AccountedList):
                yield from value.unread()

    def misspelt(self) -> Iterator[str]:
        """Yield the paths of elements that were not read, each with a name near it that the mapping lacks."""
        missing = sorted((self._read | self._known).difference(self))
        for key, value in dict.items(self):
            if key not in self._read:
                if hint := nearest(key, missing, similarity=MISSPELT):
                    yield (f"{self.path}.{key}" if self.path else key) + hint
            elif isinstance(value, AccountedMapping | AccountedList):
                yield from value.misspelt()


class AccountedList(list[Any]):
    """List that records which of its entries were read; an iteration reads all."""

    def __init__(self, values: Sequence[Any], path: str, account: Account) -> None:
        super().__init__(
            _wrapped(value, f"{path}[{index}]", account)
            for index, value in enumerate(values)
        )
        self.path = path
        self._read: set[int] = set()

    def __iter__(self) -> Iterator[Any]:
        self._read.update(range(len(self)))
        return super().__iter__()

    def __getitem__(self, index: Any) -> Any:
        self._read.update(
            # Negative indices and slices are counted from the end.
            range(*index.indices(len(self)))
            if isinstance(index, slice)
            else [index % len(self) if len(self) else index]
        )
        return super().__getitem__(index)

    def misspelt(self) -> Iterator[str]:
        """Yield those of the entries, see ``AccountedMapping.misspelt``."""
        for value in list.__iter__(self):
            if isinstance(value, AccountedMapping | AccountedList):
                yield from value.misspelt()

    def unread(self) -> Iterator[tuple[str, set[str]]]:
        """Yield the paths of the outermost entries that were not read."""
        for index, value in enumerate(list.__iter__(self)):
            if index not in self._read:
                yield f"{self.path}[{index}]", set()
            elif isinstance(value, AccountedMapping | AccountedList):
                yield from value.unread()


def accounted(document: Mapping[str, Any], account: Account) -> AccountedMapping:
    """Return a document that records what is read, with the mappings and lists in it."""
    return AccountedMapping(document, "", account)


def mark_read(value: Any) -> None:
    """Record a whole element as read."""
    if isinstance(value, AccountedMapping):
        for entry in dict.values(value):
            mark_read(entry)
        # Marks all keys of the mapping itself as read.
        value.items()
    elif isinstance(value, AccountedList):
        for entry in value:
            mark_read(entry)


def is_default(value: Any) -> bool:
    """Return whether an element is that of an empty message: zero, false, empty, or made of such elements.

    A list of mappings is not empty, even if these are.
    """
    if isinstance(value, Mapping):
        return all(is_default(entry) for entry in dict.values(dict(value)))
    if isinstance(value, list):
        entries = list(list.__iter__(value))
        # A list of mappings has entries, even if these are empty.
        return not any(
            isinstance(entry, Mapping) or not is_default(entry) for entry in entries
        )
    if value is None or value in {"", False}:
        return True
    text = str(value).strip().lower()
    with suppress(ValueError):
        number = float(text)
        return number == 0 and not math.isnan(number)
    return text in {"", "false", "no"}


def _wrapped(value: Any, path: str, account: Account) -> Any:
    if isinstance(value, Mapping):
        return AccountedMapping(value, path, account)
    if isinstance(value, list):
        return AccountedList(value, path, account)
    return value


def _plain(path: str) -> str:
    """Return a path without the indices of lists."""
    # "a[0].b[1]" becomes "a.b".
    head, *rest = path.split("[")
    return head + "".join(part.partition("]")[2] for part in rest)


def _matches(
    path: str, ends: Iterator[str] | Sequence[str] | Mapping[str, str]
) -> bool:
    """Return whether a path ends with one of some paths, key by key; it begins with an empty key."""
    keys = ["", *_plain(path).split(".")]
    return any(keys[-len(end) :] == end for end in (each.split(".") for each in ends))


def _summary(value: object) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, Mapping):
        return f"a mapping of {listed(sorted(dict.keys(dict(value))), 4)}"
    return f"{value!r:.60}"
