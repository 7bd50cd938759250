"""An append-only journal: records with checksums, which survive a crash except for an incomplete last record.

The file starts with a line that names its format. Every record has its length (8 bytes,
little endian), its sha256 and its bytes. A reader stops at the first incomplete or
damaged record; the next writer overwrites it. Logs that users read are text without
checksums, line by line (``append_line``).
"""

import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.files.atomic import machine_error, machine_errors
from cnpgen.store.files.file_lock import try_lock

MAX_RECORD_BYTES = 1 << 30
_LENGTH_BYTES = 8
_DIGEST_BYTES = hashlib.sha256().digest_size
# The file is not truncated before it is locked.
_MODE = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)


def append_line(path: Path, line: str) -> None:
    """Append a line to a text file and flush it to the disk."""
    with machine_errors("write", path), path.open("a", encoding="utf-8") as file:
        file.write(f"{line}\n")
        file.flush()
        os.fsync(file.fileno())


@dataclass
class JournalFile:
    """An open journal with the valid records of the file in order, locked for this process."""

    path: Path
    records: list[bytes]
    _file: IO[bytes]
    _magic: bytes

    def append(self, record: bytes) -> None:
        """Append a record and flush it to the disk."""
        # Record: length, sha256, content; an incomplete one has another sha256.
        length = len(record).to_bytes(_LENGTH_BYTES, "little")
        with machine_errors("write", self.path):
            self._file.write(length + hashlib.sha256(record).digest() + record)
            self._file.flush()
            os.fsync(self._file.fileno())
        self.records.append(record)

    def clear(self) -> None:
        """Remove all records."""
        with machine_errors("write", self.path):
            self._file.seek(0)
            self._file.truncate()
            self._file.write(self._magic)
            self._file.flush()
        self.records.clear()

    def close(self) -> None:
        """Close and unlock the file."""
        # Of an incomplete record after a failed append.
        with suppress(OSError):
            self._file.close()


def open_journal_file(path: Path, magic: bytes) -> JournalFile:
    """Open a journal for reading and appending, or create it, and remove an incomplete last record.

    ``magic`` is the first line of the file, with format name and version, in ASCII with
    its newline. A file that does not start with it raises DatasetError, one that
    another process has locked UsageError.
    """
    with machine_errors("write", path):
        file = os.fdopen(os.open(path, _MODE, 0o666), "r+b")
    try:
        return _recover(path, file, magic)
    except OSError as error:
        file.close()
        raise machine_error("write", path, error) from error
    except BaseException:
        file.close()
        raise


def _recover(path: Path, file: IO[bytes], magic: bytes) -> JournalFile:
    """Lock the file if the system has locks, read its records and remove what follows them."""
    if not try_lock(file):
        raise UsageError(f"{path} is in use by another process")
    head = file.read(len(magic))
    # A file that ended within the magic number is one of this kind, too.
    if not magic.startswith(head):
        raise DatasetError(f"{path} does not start with {magic!r}")
    journal = JournalFile(path, [], file, magic)
    if head == magic:
        journal.records = _read_records(file)
        # The next record follows the last valid one.
        file.truncate()
    else:
        # A new file, or one that ended within its first line.
        journal.clear()
    return journal


def _read_records(file: IO[bytes]) -> list[bytes]:
    """Return the valid records from the current position, and seek to their end."""
    records = []
    end = file.tell()
    header_bytes = _LENGTH_BYTES + _DIGEST_BYTES
    while len(header := file.read(header_bytes)) == header_bytes:
        record = file.read(
            # A damaged length may be huge.
            min(int.from_bytes(header[:_LENGTH_BYTES], "little"), MAX_RECORD_BYTES)
        )
        if hashlib.sha256(record).digest() != header[_LENGTH_BYTES:]:
            break
        records.append(record)
        end = file.tell()
    file.seek(end)
    return records
