"""The cache folder of tapes and compiled libraries.

Its files are loaded and executed, so other users must not be able to change them. A
folder that other users own or may write to is refused; such a file is ignored.
"""

import atexit
import errno
import os
import shutil
import stat
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cnpgen.errors import MachineError
from cnpgen.store.files.file_lock import try_lock, unlock

LIBRARIES = "lib"
TAPES = "tape"
# In a temporary folder: a link to a cache that is readable but not writable.
_READ_ONLY_LINK = "warm"
_WRITABLE_FOR_OTHERS = stat.S_IWGRP | stat.S_IWOTH
MAX_LOCK_WAIT_S = 600  # a process that holds a lock longer may have been stopped


def default_cache_folder() -> Path:
    """Return ``$CNPGEN_CACHE``, else ``cnpgen`` in ``$XDG_CACHE_HOME`` or ``~/.cache``."""
    if os.environ.get("CNPGEN_CACHE"):
        return Path(os.environ["CNPGEN_CACHE"])
    try:
        return (
            Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cnpgen"
        )
    except RuntimeError as error:
        raise MachineError(
            "this user has no home folder for the kernel cache: set CNPGEN_CACHE to a folder"
        ) from error


def usable_cache_folder(folder: Path) -> Path:
    """Return the folder, created with private permissions if missing, or a temporary folder.

    The temporary folder links to a cache that is readable but not writable. A cache
    that cannot be created, or that other users may change, is not used; a warning names
    the reason.
    """
    try:
        make_private_folder(folder)
    except OSError as error:
        return _temporary_cache(
            f"cannot write the kernel cache {folder} ({error.strerror or error})",
            "that is writable",
        )
    if problem := trust_problem(folder):
        return _temporary_cache(
            f"the kernel cache {folder} is not used, {problem}",
            "that is not writable for other users",
        )
    try:
        # Permissions do not show whether the file system is read-only.
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        temporary = temporary_folder()
        (temporary / _READ_ONLY_LINK).symlink_to(folder.absolute())
        return temporary


def _temporary_cache(problem: str, expected: str) -> Path:
    warnings.warn(
        f"{problem}: kernels are built for this run only, in a temporary folder;"
        f" set CNPGEN_CACHE to a folder {expected}",
        RuntimeWarning,
        stacklevel=4,
    )
    return temporary_folder()


def make_private_folder(folder: Path) -> None:
    """Create a folder and its missing parents with permissions for this user only, independent of the umask."""
    for path in (*reversed(folder.absolute().parents), folder.absolute()):
        if not path.is_dir():
            try:
                path.mkdir()
            except FileExistsError as error:
                # Created by another process meanwhile, or a file.
                if path.is_dir():
                    continue
                raise NotADirectoryError(
                    errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path)
                ) from error
            path.chmod(stat.S_IRWXU)


def make_read_only_for_others(path: Path) -> None:
    """Remove the write permission of other users from a file.

    Its read permissions stay.
    """
    path.chmod(path.stat().st_mode & ~_WRITABLE_FOR_OTHERS)


@contextmanager
def exclusive_lock(lock: Path) -> Iterator[None]:
    """Run the context in one process at a time, if the system has file locks.

    A lock ends with its process.
    """
    with os.fdopen(
        os.open(lock, os.O_CREAT | os.O_RDWR, stat.S_IRUSR | stat.S_IWUSR), "r+b"
    ) as file:
        # Another process has finished and removed it.
        with suppress(FileNotFoundError):
            # Independent of the umask.
            lock.chmod(stat.S_IRUSR | stat.S_IWUSR)
        # After the wait the work is done without the lock: twice, but complete.
        end = time.monotonic() + MAX_LOCK_WAIT_S
        while not try_lock(file) and time.monotonic() < end:
            time.sleep(0.02)
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
            unlock(file)


def read_only_cache(folder: Path) -> Path | None:
    """Return the read-only cache that a temporary folder links to, or None."""
    return (
        (folder / _READ_ONLY_LINK).resolve()
        if (folder / _READ_ONLY_LINK).is_symlink()
        else None
    )


def require_trusted(folder: Path) -> list[Path]:
    """Return the folders with cached kernels: this one and the read-only cache that it links to, if any.

    A folder in which other users may change files raises MachineError.
    """
    linked = read_only_cache(folder)
    folders = [folder] if linked is None else [folder, linked]
    for cache in folders:
        if problem := trust_problem(cache):
            raise MachineError(
                f"the kernel cache {cache} is not used, {problem}: choose another folder"
            )
    return folders


def trust_problem(folder: Path) -> str:
    """Return why other users may change files in a cache folder, or an empty text if they cannot.

    The folder, its subfolders, its parents and the targets of symbolic links among them
    are checked.
    """
    for path in filter(os.path.lexists, _path_components(folder.absolute())):
        # Protects entries of others.
        sticky = path != folder.absolute() and bool(path.stat().st_mode & stat.S_ISVTX)
        if problem := _permission_problem(path, writable=sticky or path.is_symlink()):
            return problem
    subfolders = (folder / name for name in (LIBRARIES, TAPES))
    return next(
        (
            problem
            for path in subfolders
            if os.path.lexists(path) and (problem := _entry_problem(path))
        ),
        "",
    )


def is_trusted(path: Path) -> bool:
    """Return whether a cache file is no link, belongs to this user or root, and is not writable for others."""
    return not _entry_problem(path)


def untrusted_files(folder: Path) -> list[Path]:
    """List the tapes and libraries in a cache folder that other users may have created or changed."""
    paths = (
        path
        for name in (LIBRARIES, TAPES)
        for path in sorted((folder / name).glob("*.*"))
    )
    return [path for path in paths if not is_trusted(path)]


def _entry_problem(path: Path) -> str:
    return (
        f"as {path} is a symbolic link"
        if path.is_symlink()
        else _permission_problem(path)
    )


def _permission_problem(path: Path, *, writable: bool = False) -> str:
    """Return why other users own or may write a path, or an empty text.

    ``writable`` permits writing.
    """
    if not hasattr(os, "geteuid"):  # Windows
        return ""
    try:
        status = path.lstat()
    except FileNotFoundError:
        # Moved since it was listed.
        return ""
    # Root may change any file in any case.
    if status.st_uid not in {0, os.geteuid()}:
        return f"as {path} belongs to another user (uid {status.st_uid})"
    if status.st_mode & _WRITABLE_FOR_OTHERS and not writable:
        return f"as others may write to {path} ('chmod go-w' ends that)"
    return ""


def _path_components(path: Path) -> Iterator[Path]:
    """Yield an existing path, its parents, and the components of the targets of symbolic links among them."""
    for component in (path, *path.parents):
        yield component
        if component.is_symlink():
            yield from _path_components(
                Path(os.path.normpath(component.parent / component.readlink()))
            )


def temporary_folder() -> Path:
    """Create a folder that is removed when this process ends.

    Its workers may use it until then.
    """
    folder = Path(tempfile.mkdtemp(prefix="cnpgen-cache-"))
    atexit.register(_remove, folder, os.getpid())
    return folder


def _remove(folder: Path, owner: int) -> None:
    if os.getpid() == owner:
        # A forked worker inherits the exit handler.
        shutil.rmtree(folder, ignore_errors=True)
