"""Atomic writing of files: under a temporary name, flushed to the disk, then renamed."""

import errno
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cnpgen.errors import DatasetError, MachineError
from cnpgen.store.files.leftovers import temporary_name

_HINTS = {
    errno.ENOSPC: "free some space and try again",
    errno.EDQUOT: "your disk quota is used up; free some space and try again",
    errno.EFBIG: "the file is larger than this system or session allows (see ulimit -f)",
    errno.EROFS: "choose another folder",
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.ENOTDIR: "a file is where a folder should be; choose another folder",
    errno.EEXIST: "a file is where a folder should be; choose another folder",
    errno.ENOENT: "choose a folder that can be created",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "choose another folder",
    errno.EMFILE: "too many open files (see ulimit -n)",
}
_DENIED = {errno.EACCES, errno.EPERM}


def machine_error(verb: str, path: Path, error: OSError) -> MachineError:
    """Return the error to raise, with a hint, after a system call failed to "read" or "write" a file."""
    hint = _HINTS.get(error.errno or 0, "check the disk and try again")
    if verb == "read" and error.errno in _DENIED:
        hint = "its owner can permit reading it (chmod)"
    return MachineError(f"cannot {verb} {path}: {error.strerror or error}; {hint}")


@contextmanager
def machine_errors(verb: str, path: Path) -> Iterator[None]:
    """Raise ``machine_error`` for system calls in the block that fail."""
    try:
        yield
    except OSError as error:
        raise machine_error(verb, path, error) from error


def check_readable(path: Path) -> None:
    """Raise MachineError if the operating system denies reading an existing file or folder."""
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            # Needs the permissions to list and to enter.
            os.scandir(f"{path}/.").close()
        elif stat.S_ISREG(mode):
            path.open("rb").close()
    except PermissionError as error:
        raise machine_error("read", path, error) from error
    except (OSError, ValueError):
        # There is no such path.
        return


def check_writable(path: Path) -> None:
    """Raise MachineError if a file, or files in a folder, cannot be written.

    The path may be missing.
    """
    with machine_errors("write", path):
        places = [path.absolute(), *path.absolute().parents]
        if path.is_file():
            places.pop(0).open("ab").close()
        # A missing folder would be created in its nearest existing parent.
        folder = next(place for place in places if place.exists())
        with tempfile.TemporaryFile(dir=folder):
            pass


@contextmanager
def committing(path: Path, work: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path for the block to write to, and rename it to ``path`` if the block ends without an error.

    Several processes may write the same ``path`` at once: each has its own temporary
    file and the last rename wins. The temporary file is in ``work``, on the same file
    system, or in the folder of ``path``. Both folders are created.

    Raises:
        MachineError: The file cannot be written. ``path`` is unchanged and the
            temporary file is removed.
    """
    folder = work or path.parent
    temporary = folder / temporary_name(path.name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        # The content reaches the disk before its name, and the name before the call
        # returns.
        _synchronize(temporary)
        temporary.replace(path)
        _synchronize(path.parent)
    except OSError as error:
        raise machine_error("write", path, error) from error
    finally:
        with suppress(OSError):
            # After a success the temporary name no longer exists.
            temporary.unlink()


def _synchronize(path: Path) -> None:
    """Flush a file or a folder's entries to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:
            # From file systems that cannot flush a folder.
            raise
    finally:
        os.close(descriptor)


def write_file(path: Path, content: bytes | str, *, work: Path | None = None) -> None:
    """Write a whole file atomically, or raise MachineError.

    Text is encoded as UTF-8.
    """
    with committing(path, work) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def append_to_file(path: Path, content: bytes) -> None:
    """Append to a file and flush it to the disk, or raise MachineError."""
    with machine_errors("write", path), path.open("ab") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Raise an error that names the file if it is missing or cannot be read."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DatasetError(f"{path} is missing") from error
    except OSError as error:
        raise machine_error("read", path, error) from error


def read_file(path: Path, *, max_bytes: int | None = None) -> bytes:
    """Read a whole file of at most ``max_bytes``, by default of any size.

    Raises:
        DatasetError: The file is missing, too large, or a device or a pipe, whose size
            is unknown.
        MachineError: The file cannot be read.
    """
    with _reading(path):
        status = path.stat()
        # Reading a pipe or a device may block; a folder raises its own error below.
        if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):
            raise DatasetError(f"{path} is not a file")
        if max_bytes is not None and status.st_size > max_bytes:
            raise DatasetError(
                f"{path} has {status.st_size:,} bytes, expected at most {max_bytes:,}"
            )
        return path.read_bytes()


def file_sha256(path: Path) -> str:
    """Compute the sha256 of a file in constant memory, as 64 hexadecimal digits.

    Errors are those of ``read_file``.
    """
    with _reading(path), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
