"""Files that are whole or absent: written under a temporary name, flushed to the disk, then renamed."""

import errno
import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cnpgen.errors import DatasetError, MachineError
from cnpgen.store.files.leftovers import temporary_name

_HINTS = {
    errno.ENOSPC: "free some space and try again",
    errno.EDQUOT: "your quota is used up; free some space and try again",
    errno.EFBIG: "the file is larger than this system or session allows (see ulimit -f)",
    errno.EROFS: "choose another folder",
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.ENOTDIR: "a file is where a folder should be; choose another folder",
    errno.EEXIST: "a file is where a folder should be; choose another folder",
    errno.ENOENT: "choose a folder that can be made",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "choose another folder",
    errno.EMFILE: "too many open files (see ulimit -n)",
}


def machine_error(verb: str, path: Path, error: OSError) -> MachineError:
    """Describe a failed system call: what could not be done to which path, why, and what helps.

    Args:
        verb: "read", "write".
        path: The file that was meant.
        error: What the system said.

    Returns:
        The error to raise from ``error``.
    """
    hint = _HINTS.get(error.errno or 0, "check the disk and try again")
    return MachineError(f"cannot {verb} {path}: {error.strerror or error}; {hint}")


@contextmanager
def committing(path: Path, work: Path | None = None) -> Iterator[Path]:
    """Give the block a temporary path to write to; rename it to ``path`` when the block ends without an error.

    Any number of processes may write the same ``path`` at once: each has a temporary file and the last rename wins.

    Args:
        path: The file that is to appear; its folder is made.
        work: Folder for the temporary file, on the same file system as ``path``; beside ``path`` by default.

    Yields:
        The temporary path; the block must create this file.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling. ``path`` is as it was; nothing is left behind.
    """
    folder = work or path.parent
    temporary = folder / temporary_name(path.name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _synchronise(temporary)
        temporary.replace(path)
        _synchronise(path.parent)
    except OSError as error:
        raise machine_error("write", path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def _synchronise(path: Path) -> None:
    """Flush a file or a folder's entries to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # file systems that cannot flush a folder say EINVAL
            raise
    finally:
        os.close(descriptor)


def write_file(path: Path, content: bytes | str, *, work: Path | None = None) -> None:
    """Write a whole file atomically; text as UTF-8.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    with committing(path, work) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def read_file(path: Path, *, most: int | None = None) -> bytes:
    """Read a whole file.

    Args:
        path: The file.
        most: Size that it may have [bytes]; as large as it is by default.

    Raises:
        DatasetError: There is no such file, it is a device or a pipe, which has no end, or it is too large.
        MachineError: The system would not let us read it.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):
            raise DatasetError(f"{path} is not a file")
        if most is not None and status.st_size > most:
            raise DatasetError(f"{path} has {status.st_size:,} bytes, expected at most {most:,}")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DatasetError(f"{path} is missing") from error
    except OSError as error:
        raise machine_error("read", path, error) from error


def file_sha256(path: Path) -> str:
    """Compute the sha256 of a file in constant memory, as 64 hexadecimal digits.

    Raises:
        DatasetError: There is no such file.
        MachineError: The system would not let us read it.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DatasetError(f"{path} is missing") from error
    except OSError as error:
        raise machine_error("read", path, error) from error
