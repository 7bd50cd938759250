"""Files of records that an interrupted run resumes from: a head that identifies the run, then one record per line.

Head and records are JSON. A checked line ends with a tab and the sha256 of its JSON. A
reader stops at the first incomplete or damaged line; the next writer overwrites it and
what follows. A record is appended, or replaces the whole file atomically.
"""

import base64
import hashlib
import io
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from cnpgen.arrays import AnyArray, Columns
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.files.archives import read_arrays
from cnpgen.store.files.atomic import append_to_file, machine_errors, write_file
from cnpgen.store.files.documents import differences, parse_json
from cnpgen.store.files.file_lock import try_lock
from cnpgen.store.files.kind import apparent_kind

# Errors of NumPy and Python for a record that cnpgen has not written.
RECORD_ERRORS = (
    ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError,
)  # fmt: skip
MAX_LINE_BYTES = 1 << 30
MAX_SHOWN_DIFFERENCES = 4
# The file is not truncated before it is locked.
_MODE = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
# First line of files of version 1.0, whose records were binary.
_BINARY_HEAD = re.compile(rb"(cnpgen)[- ]([a-z]+) ([0-9]{1,6})\n")


@dataclass(frozen=True)
class RecordFormat:
    """A format of files of records.

    Attributes:
        kind: Name of the format, "cnpgen-" and one word.
        version: Its version.
        name: What such a file is, "a journal of cnpgen".
        remedy: What a caller may do with the file of another run, with the argument in
            braces.
        argument: Argument that discards it.
        unpack: Conversion of a record that is read, which may raise ``RECORD_ERRORS``.
        checked: Whether lines have a checksum.
    """

    kind: str
    version: int
    name: str
    remedy: str
    argument: str
    unpack: Callable[[Any], Any]
    checked: bool = True

    def head(self, identity: JsonMapping) -> JsonObject:
        """Return the head of a run, as it is read back."""
        head = {"format": self.kind, "format_version": self.version, **identity}
        return dict(json.loads(json.dumps(head)))

    def line(self, record: Any) -> bytes:
        """Return the line of a record."""
        text = json.dumps(record).encode()
        return b"%b\t%b\n" % (text, _digest(text)) if self.checked else text + b"\n"

    def parse(self, line: bytes) -> Any:
        """Return the record of a line; raise ValueError if it is incomplete or damaged."""
        text = line.removesuffix(b"\n")
        if len(text) == len(line):
            raise ValueError("it is incomplete")
        if self.checked:
            text, _, digest = text.rpartition(b"\t")
            if digest != _digest(text):
                raise ValueError("it is damaged")
        return parse_json(text.decode())

    def require(self, path: Path, found: JsonObject, identity: JsonMapping) -> None:
        """Raise UsageError, which names the differences, if a head is not that of this run."""
        own = self.head(identity)
        # Of a file of another version only the keys that it has say something.
        if found.get("format_version") != self.version:
            known = {*found, "format_version"}
            own = {key: value for key, value in own.items() if key in known}
        changed = [str(each) for each in differences(found, own)]
        if changed:
            shown = ", ".join(changed[:MAX_SHOWN_DIFFERENCES])
            raise UsageError(
                f"{path} is of another run, it differs in {shown}: {self.remedy}",
                remedies={self.argument: True},
            )

    def unpacked(self, path: Path, records: Sequence[Any]) -> list[Any]:
        """Return converted records of a file; raise DatasetError for one that is not of this format."""
        found = []
        for number, record in enumerate(records, start=2):
            try:
                found.append(self.unpack(record))
            except RECORD_ERRORS as error:
                hint = "" if self.checked else "; delete that line"
                raise DatasetError(
                    f"{path} is damaged: line {number}: {error}{hint}"
                ) from error
        return found

    def replace(self, path: Path, identity: JsonMapping, record: Any) -> None:
        """Write a file with one record atomically."""
        write_file(path, self.line(self.head(identity)) + self.line(record))

    def read(self, path: Path) -> tuple[JsonObject | None, list[Any]]:
        """Return the head, None of a file that ended within it, and the records.

        Raises:
            DatasetError: The file is of another format.
            MachineError: It cannot be read.
        """
        with machine_errors("read", path), path.open("rb") as file:
            head, records, _ = self.read_open(path, file)
        return head, records

    def read_open(
        self, path: Path, file: IO[bytes]
    ) -> tuple[JsonObject | None, list[Any], int]:
        """Return head and records from the beginning of an open file, and their end."""
        first = file.readline(MAX_LINE_BYTES)
        begin = f'{{"format": "{self.kind}"'.encode()
        if not first.endswith(b"\n") and begin.startswith(first[: len(begin)]):
            return None, [], 0
        head = self._parsed_head(first)
        if head is None:
            raise DatasetError(
                f"{path} is not {self.name}, or its beginning is damaged{apparent_kind(path)}"
            )
        records = list[Any]()
        end = file.tell()
        for line in iter(partial(file.readline, MAX_LINE_BYTES), b""):
            try:
                records.append(self.parse(line))
            except ValueError:
                break
            end = file.tell()
        return head, records, end

    def _parsed_head(self, line: bytes) -> JsonObject | None:
        """Return the head in the first line of a file of this format, of any version; None if it is of another one."""
        if old := _BINARY_HEAD.fullmatch(line):
            head = {
                "format": f"cnpgen-{old[2].decode()}",
                "format_version": int(old[3]),
            }
        else:
            try:
                head = self.parse(line)
            except ValueError:
                return None
        is_own = isinstance(head, dict) and head.get("format") == self.kind
        return head if is_own else None


def _digest(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest().encode()


@dataclass
class RecordFile:
    """An open file of records, locked for this process, with the converted ones that it had when it was opened."""

    path: Path
    records: list[Any]
    _format: RecordFormat
    _file: IO[bytes]
    _head: bytes

    def append(self, record: Any) -> None:
        """Append a record and flush it to the disk."""
        append_to_file(self.path, self._format.line(record))

    def clear(self) -> None:
        """Remove all records."""
        with machine_errors("write", self.path):
            self._file.truncate(0)
        append_to_file(self.path, self._head)
        self.records.clear()

    def close(self) -> None:
        """Close and unlock the file."""
        self._file.close()


def open_records(
    path: Path, form: RecordFormat, identity: JsonMapping, *, discard: bool = False
) -> RecordFile:
    """Open the records of a run for appending, or create their file; remove an incomplete end.

    Records of another run are lost only if ``discard``.

    Raises:
        DatasetError: The file is of another format, or a record is.
        UsageError: It has records of another run, or another process has locked it.
        MachineError: It cannot be opened.
    """
    with machine_errors("write", path), ExitStack() as stack:
        file = stack.enter_context(os.fdopen(os.open(path, _MODE, 0o666), "r+b"))
        if not try_lock(file):
            raise UsageError(f"{path} is in use by another process")
        head, records, end = form.read_open(path, file)
        own = form.head(identity)
        result = RecordFile(path, [], form, file, form.line(own))
        # A file without records is no loss; those of another version are not read.
        if (
            head
            and not discard
            and (records or head.get("format_version") != form.version)
        ):
            form.require(path, head, identity)
        if head == own:
            # The next record follows the last valid one.
            file.truncate(end)
            result.records = form.unpacked(path, records)
        else:
            result.clear()
        stack.pop_all()
    return result


def pack_arrays(arrays: Mapping[str, AnyArray]) -> str:
    """Return arrays as text for a record."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return base64.b64encode(buffer.getvalue()).decode()


def unpack_arrays(text: str) -> Columns:
    """Return the arrays of ``pack_arrays``.

    Raises:
        ValueError: The text holds other content.
    """
    content = base64.b64decode(text, validate=True)
    # Compressed arrays are refused: a few bytes could expand to gigabytes.
    return read_arrays(content, max_bytes=8 * len(content), stored=True)
