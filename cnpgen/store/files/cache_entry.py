"""Entries of the cache with a checksum: a damaged one is computed again, and a full disk is no error."""

import errno
import hashlib
import warnings
from pathlib import Path

from cnpgen.errors import MachineError
from cnpgen.store.files.atomic import write_file

MAX_ENTRY_BYTES = 1 << 28
_FULL = {errno.ENOSPC, errno.EDQUOT}


def read_entry(path: Path) -> bytes | None:
    """Return the content of an entry, None if there is none or if it is damaged."""
    try:
        if path.stat().st_size > MAX_ENTRY_BYTES:
            return None
        # The first line is the sha256 of the rest.
        checksum, _, content = path.read_bytes().partition(b"\n")
    except OSError:
        return None
    return content if _checksum(content) == checksum else None


def write_entry(path: Path, content: bytes) -> None:
    """Write an entry, if the cache is writable; a full disk is reported by a warning."""
    try:
        write_file(path, _checksum(content) + b"\n" + content)
    except MachineError as error:
        # Other failures, such as a read-only cache, are silent: the result is only not
        # kept.
        cause = error.__cause__
        if isinstance(cause, OSError) and cause.errno in _FULL:
            warnings.warn(
                f"the disk of the cache {path.parent} is full: the result is used and not kept",
                RuntimeWarning,
                stacklevel=3,
            )


def _checksum(content: bytes) -> bytes:
    """Return the sha256 of a content in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest().encode()
