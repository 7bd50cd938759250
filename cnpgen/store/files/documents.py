"""Sealed JSON documents: readable, identical from run to run, and any changed byte is noticed when they are read.

The last key of a document, ``self_sha256``, is the sha256 of the file's own text with 64 zeros in its place.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.errors import DatasetError
from cnpgen.store.files.atomic import read_file, write_file
from cnpgen.store.files.forms import Form, check_form
from cnpgen.store.files.limits import DOCUMENT_BYTES, DOCUMENT_DEPTH

SHOWN = 80  # characters of two values that a message still shows
_BLANK = "0" * 64
_SCALARS = frozenset({int, bool, str, type(None)})  # types that are JSON's own, whatever the value
_NESTED = frozenset({dict, list})
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")  # of half a character, which needs another half
_SEAL = re.compile(r'"self_sha256": "([0-9a-f]{64})"\n}\n\Z')


def plain(value: Any) -> Any:
    """Reduce a value to JSON's types: tuples and arrays become lists, infinities the strings ``float()`` reads.

    Raises:
        TypeError: Something has no JSON form.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        kinds = set(map(type, value))
        return list(value) if kinds <= _SCALARS else [plain(item) for item in value]  # long lists of counts are common
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"no JSON form for {type(value).__name__} {value!r}")


def canonical_sha256(value: Any) -> str:
    """Compute the sha256 of a value's compact JSON with sorted keys: equal values, equal digits."""
    text = json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Difference:
    """Where two JSON-able values differ; as text, the values only where they are short.

    Attributes:
        key: Dotted key, ``"robot.name"``.
        found: The value there in the first one, None where it is missing.
        wanted: The value there in the second one, None where it is missing.
    """

    key: str
    found: Any
    wanted: Any

    @property
    def is_short(self) -> bool:
        """Whether the values are short enough for a message."""
        return len(repr(self.found)) + len(repr(self.wanted)) < SHOWN

    def __str__(self) -> str:
        return f"{self.key} ({self.found!r}, now {self.wanted!r})" if self.is_short else self.key


def differences(found: Any, wanted: Any, key: str = "") -> Iterator[Difference]:
    """List where two JSON-able values differ, table by table, in the order of the first one's keys."""
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for name in [*found, *(name for name in wanted if name not in found)]:
            yield from differences(found.get(name), wanted.get(name), f"{key}.{name}" if key else name)
    elif found != wanted:
        yield Difference(key, found, wanted)


def render(value: Any, indent: str = "") -> str:
    """Lay out plain JSON with two spaces per level and lists of scalars on one line each."""
    inner = indent + "  "
    if isinstance(value, dict) and value:
        items = [f"{json.dumps(key, ensure_ascii=False)}: {render(item, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(inner + item for item in items) + "\n" + indent + "}"
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        return "[\n" + ",\n".join(inner + render(item, inner) for item in value) + "\n" + indent + "]"
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def save_document(path: Path, document: Mapping[str, Any], *, work: Path | None = None) -> None:
    """Seal a document and write it atomically.

    Args:
        path: Where to.
        document: JSON-able content with the keys "format" and "format_version" first.
        work: Folder for the temporary file.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    text = render(plain({**document, "self_sha256": _BLANK})) + "\n"
    digest = hashlib.sha256(text.encode()).hexdigest()
    write_file(path, _SEAL.sub(f'"self_sha256": "{digest}"\n}}\n', text), work=work)


def load_document(path: Path, kind: str, *, version: int, form: Form) -> dict[str, Any]:
    """Read a sealed document.

    Args:
        path: The file.
        kind: The "format" that it must have.
        version: The newest "format_version" that the caller understands.
        form: What it must hold, see ``cnpgen.store.files.forms``.

    Returns:
        Its content without the seal.

    Raises:
        DatasetError: It is missing, cut off, changed since it was written, too large, of another kind or form, or from
            a newer cnpgen.
        MachineError: The system would not let us read it.
    """
    text, document = _parse(path)
    if document.get("format") != kind:
        raise DatasetError(f"{path} is not a {kind} file: its format is {document.get('format')!r}")
    found = document.get("format_version")
    if isinstance(found, int) and found > version:
        raise DatasetError(f"{path} has format version {found}, this cnpgen reads up to {version}: upgrade cnpgen")
    seal = _SEAL.search(text)
    blank = _SEAL.sub(f'"self_sha256": "{_BLANK}"\n}}\n', text)
    if found is None or seal is None or seal[1] != hashlib.sha256(blank.encode()).hexdigest():
        raise DatasetError(f"{path} is damaged: it was changed after it was written")
    del document["self_sha256"]
    try:
        check_form(document, form)
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}") from error
    return document


def parse_json(text: str) -> Any:
    """Parse JSON that somebody else may have written.

    Raises:
        ValueError: It is none, is nested deeper than any document, or has texts that are no texts.
    """
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise _too_deep() from error
    _check_depth(value)
    if _SURROGATE.search(text):
        json.dumps(value, ensure_ascii=False).encode()  # half a character is a ValueError
    return value


def _check_depth(value: Any) -> None:
    level: list[Any] = [value] if isinstance(value, dict | list) else []
    for _ in range(DOCUMENT_DEPTH + 1):
        if not level:
            return
        inside = (each.values() if isinstance(each, dict) else each for each in level)
        level = [item for items in inside if not _NESTED.isdisjoint(map(type, items)) for item in items]
        level = [item for item in level if isinstance(item, dict | list)]
    raise _too_deep()


def _too_deep() -> ValueError:
    return ValueError(f"it has more than {DOCUMENT_DEPTH} tables and lists in one another")


def _parse(path: Path) -> tuple[str, dict[str, Any]]:
    """Return a JSON object's text and content."""
    content = read_file(path, most=DOCUMENT_BYTES)
    if not content:
        raise DatasetError(f"{path} is damaged: it is empty")
    try:
        text = content.decode()
        document = parse_json(text)
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: not JSON ({error})") from error
    if not isinstance(document, dict):
        raise DatasetError(f"{path} is damaged: a JSON object was expected")
    return text, document
