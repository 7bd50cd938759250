"""JSON documents with a checksum: readable, reproducible, and protected against any changed byte.

The last key of a document, ``self_sha256``, is the sha256 of the text of the file with
64 zeros in place of the value.
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

from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import DatasetError
from cnpgen.store.files.atomic import read_file, write_file
from cnpgen.store.files.document_structure import Structure, check_structure
from cnpgen.store.files.size_limits import MAX_DOCUMENT_BYTES, MAX_DOCUMENT_DEPTH

MAX_SHOWN_CHARACTERS = 80  # longer pairs of values are left out of messages
_BLANK = "0" * 64
# Types that JSON has for every value.
_SCALARS = frozenset({int, bool, str, type(None)})
_NESTED = frozenset({dict, list})
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")  # half of a UTF-16 surrogate pair
_CHECKSUM = re.compile(r'"self_sha256": "([0-9a-f]{64})"\n}\n\Z')


def plain(value: Any) -> Any:
    """Convert a value to JSON types: tuples and arrays to lists, infinities to strings that ``float()`` reads."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        # Fast paths for long lists of numbers.
        kinds = set(map(type, value))
        is_plain = kinds <= _SCALARS or (
            kinds == {float} and all(map(math.isfinite, value))
        )
        return list(value) if is_plain else [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot convert {type(value).__name__} {value!r} to JSON")


def canonical_sha256(value: Any) -> str:
    """Compute the sha256 of the compact JSON of a value with sorted keys.

    Equal values have equal digests.
    """
    text = json.dumps(
        plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False
    )
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Difference:
    """A difference between two JSON-able values at a dotted key; a missing value is None.

    Its text contains the values if they are short.
    """

    key: str
    old: Any
    new: Any

    @property
    def is_short(self) -> bool:
        """Whether the values are short enough for a message."""
        return len(repr(self.old)) + len(repr(self.new)) < MAX_SHOWN_CHARACTERS

    def __str__(self) -> str:
        return (
            f"{self.key} ({self.old!r}, now {self.new!r})"
            if self.is_short
            else self.key
        )


def differences(old: Any, new: Any, key: str = "") -> Iterator[Difference]:
    """Yield the differences between two JSON-able values, in the order of the keys of the first one."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for name in [*old, *(name for name in new if name not in old)]:
            yield from differences(
                old.get(name), new.get(name), f"{key}.{name}" if key else name
            )
    elif old != new:
        yield Difference(key, old, new)


def render(value: Any, indent: str = "") -> str:
    """Format plain JSON with two spaces per level and each list of scalars on one line."""
    inner = indent + "  "
    if isinstance(value, dict) and value:
        items = [
            f"{json.dumps(key, ensure_ascii=False)}: {render(item, inner)}"
            for key, item in value.items()
        ]
        return "{\n" + ",\n".join(inner + item for item in items) + "\n" + indent + "}"
    if isinstance(value, list) and not _NESTED.isdisjoint(map(type, value)):
        return (
            "[\n"
            + ",\n".join(inner + render(item, inner) for item in value)
            + "\n"
            + indent
            + "]"
        )
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def save_document(
    path: Path, document: JsonMapping, *, work: Path | None = None
) -> None:
    """Write a document with its checksum, atomically.

    The keys "format" and "format_version" come first.
    """
    # The checksum is that of the text with zeros in its place, which a reader can
    # restore.
    text = render(plain({**document, "self_sha256": _BLANK})) + "\n"
    digest = hashlib.sha256(text.encode()).hexdigest()
    write_file(path, _CHECKSUM.sub(f'"self_sha256": "{digest}"\n}}\n', text), work=work)


def load_document(
    path: Path, kind: str, *, version: int, structure: Structure
) -> JsonObject:
    """Read a document with the "format" ``kind``, a "format_version" and a structure, and verify its checksum.

    A missing, too large or damaged file, and another format, version or structure,
    raise DatasetError.
    """
    text, document = _parse(path)
    if document.get("format") != kind:
        raise DatasetError(
            f"{path} is not a {kind} file: its format is {document.get('format')!r}"
        )
    actual = document.get("format_version")
    if isinstance(actual, int) and actual != version:
        remedy = "upgrade cnpgen" if actual > version else "make it again"
        raise DatasetError(
            f"{path} has format version {actual}, this cnpgen reads version {version}: {remedy}"
        )
    checksum = _CHECKSUM.search(text)
    # The same text as before the checksum was put in.
    blank = _CHECKSUM.sub(f'"self_sha256": "{_BLANK}"\n}}\n', text)
    if (
        actual is None
        or checksum is None
        or checksum[1] != hashlib.sha256(blank.encode()).hexdigest()
    ):
        raise DatasetError(f"{path} is damaged: it was changed after it was written")
    del document["self_sha256"]
    try:
        check_structure(document, structure)
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}") from error
    return document


def parse_json(text: str) -> Any:
    """Parse untrusted JSON; raise ValueError if it is not JSON, nested too deeply, or not valid Unicode."""
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise _too_deep() from error
    _check_depth(value)
    if _SURROGATE.search(text):
        # Raises a ValueError for a single surrogate.
        json.dumps(value, ensure_ascii=False).encode()
    return value


def _check_depth(value: Any) -> None:
    level: list[Any] = [value] if isinstance(value, dict | list) else []
    for _ in range(MAX_DOCUMENT_DEPTH + 1):
        if not level:
            return
        inside = (
            value.values() if isinstance(value, dict) else value for value in level
        )
        level = [
            item
            for items in inside
            # Long lists of scalars are skipped without visiting their entries one by
            # one.
            if not _NESTED.isdisjoint(map(type, items))
            for item in items
        ]
        level = [item for item in level if isinstance(item, dict | list)]
    raise _too_deep()


def _too_deep() -> ValueError:
    return ValueError(f"it has more than {MAX_DOCUMENT_DEPTH} nested tables and lists")


def _parse(path: Path) -> tuple[str, JsonObject]:
    """Read a JSON object; return its text and content."""
    content = read_file(path, max_bytes=MAX_DOCUMENT_BYTES)
    if not content:
        raise DatasetError(f"{path} is damaged: it is empty")
    try:
        text = content.decode()
        document = parse_json(text)
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: not JSON ({error})") from error
    if not isinstance(document, dict):
        raise DatasetError(f"{path} is damaged: expected a JSON object")
    return text, document
