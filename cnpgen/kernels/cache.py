"""The folder where tapes and compiled libraries are kept from run to run.

What is in it is loaded and run, so that nobody else may be able to change it: a folder that others own or may write to
is refused, a single file likewise is as if it were not there.
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
from typing import IO

from cnpgen.errors import MachineError

LIBRARIES, TAPES = "lib", "tape"
_WARM = "warm"  # in a temporary folder: a link to the cache that can be read but not written
_OTHERS = stat.S_IWGRP | stat.S_IWOTH
PATIENCE = 600  # [s] a process that needs longer may have been stopped: it is no longer waited for


def default_cache_folder() -> Path:
    """``$CNPGEN_CACHE``, else ``cnpgen`` in ``$XDG_CACHE_HOME`` or ``~/.cache``.

    Raises:
        MachineError: None of them is known.
    """
    if os.environ.get("CNPGEN_CACHE"):
        return Path(os.environ["CNPGEN_CACHE"])
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cnpgen"
    except RuntimeError as error:
        raise MachineError("this user has no home folder to keep kernels in: set CNPGEN_CACHE to a folder") from error


def usable_folder(folder: Path) -> Path:
    """Return the folder, made for this user alone if it is missing, or a temporary one.

    A folder that can only be read is still read: the temporary one refers to it. One that cannot be made, or that
    others may change, is left alone after a warning.
    """
    try:
        make_private(folder)
    except OSError as error:
        return _instead(f"cannot write the kernel cache {folder} ({error.strerror or error})", "that can be written")
    if why := distrusted(folder):
        return _instead(f"the kernel cache {folder} is not used, {why}", "that nobody else may write to")
    try:
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        temporary = temporary_folder()
        (temporary / _WARM).symlink_to(folder.absolute())
        return temporary


def _instead(problem: str, wanted: str) -> Path:
    warnings.warn(
        f"{problem}: kernels are built for this run only, in a temporary folder; set CNPGEN_CACHE to a folder {wanted}",
        RuntimeWarning,
        stacklevel=4,
    )
    return temporary_folder()


def make_private(folder: Path) -> None:
    """Make a folder, and those on the way to it, for this user alone, whatever the umask is; those there stay.

    Raises:
        OSError: It cannot be made.
    """
    for each in (*reversed(folder.absolute().parents), folder.absolute()):
        if not each.is_dir():
            try:
                each.mkdir()
            except FileExistsError as error:  # made by another process meanwhile, or a file
                if each.is_dir():
                    continue
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(each)) from error
            each.chmod(stat.S_IRWXU)


def keep_from_others(path: Path) -> None:
    """Let nobody else write to a file, whatever the umask is; who may read it stays as it is."""
    path.chmod(path.stat().st_mode & ~_OTHERS)


@contextmanager
def one_at_a_time(lock: Path) -> Iterator[None]:
    """Let one process after the other do what is inside, where the system has locks; they end with their process.

    Raises:
        OSError: The lock's file cannot be made.
    """
    with os.fdopen(os.open(lock, os.O_CREAT | os.O_RDWR, stat.S_IRUSR | stat.S_IWUSR), "r+b") as file:
        with suppress(FileNotFoundError):  # another process is done and has removed it
            lock.chmod(stat.S_IRUSR | stat.S_IWUSR)  # whatever the umask is
        end = time.monotonic() + PATIENCE
        while _is_held(file) and time.monotonic() < end:
            time.sleep(0.02)
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
            _let_go(file)


def _is_held(file: IO[bytes]) -> bool:
    """Take the lock on a file; whether another process holds it."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (ImportError, OSError):  # Windows, and file systems without locks
        return False
    return False


def _let_go(file: IO[bytes]) -> None:
    """Give up the lock on a file, also where processes that were forked meanwhile have it open."""
    with suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(file, fcntl.LOCK_UN)


def warm_folder(folder: Path) -> Path | None:
    """Return the cache that can only be read and that a temporary folder stands in for, or None."""
    return (folder / _WARM).resolve() if (folder / _WARM).is_symlink() else None


def require_trusted(folder: Path) -> list[Path]:
    """Return the folders to look for kernels in: this one and the one that it stands in for, if it does.

    Raises:
        MachineError: Others may change what is in one of them.
    """
    warm = warm_folder(folder)
    folders = [folder] if warm is None else [folder, warm]
    for each in folders:
        if why := distrusted(each):
            raise MachineError(f"the kernel cache {each} is not used, {why}: choose another folder")
    return folders


def distrusted(folder: Path) -> str:
    """Say who else may change what is in a cache folder: "as others may write to /a"; nothing if nobody may.

    Its folders and those on the way to it count, and what symbolic links on the way lead to.
    """
    for each in filter(os.path.lexists, _way(folder.absolute())):
        sticky = each != folder.absolute() and bool(each.stat().st_mode & stat.S_ISVTX)  # others' entries stay theirs
        if why := _others(each, writable=sticky or each.is_symlink()):
            return why
    inside = (folder / name for name in (LIBRARIES, TAPES))
    return next((why for each in inside if os.path.lexists(each) and (why := _planted(each))), "")


def is_trusted(path: Path) -> bool:
    """Whether a file in a cache folder is this user's or root's, no link, and nobody else may write to it."""
    return not _planted(path)


def distrusted_files(folder: Path) -> list[Path]:
    """List the tapes and libraries in a cache folder that others may have put there or changed."""
    found = (path for name in (LIBRARIES, TAPES) for path in sorted((folder / name).glob("*.*")))
    return [path for path in found if not is_trusted(path)]


def _planted(path: Path) -> str:
    return f"as {path} is a symbolic link" if path.is_symlink() else _others(path)


def _others(path: Path, *, writable: bool = False) -> str:
    """Say who else owns a path or may write to it, unless it may be ``writable``."""
    if not hasattr(os, "geteuid"):  # Windows
        return ""
    try:
        found = path.lstat()
    except FileNotFoundError:  # it was moved to its place since it was listed
        return ""
    if found.st_uid not in {0, os.geteuid()}:
        return f"as {path} belongs to another user (uid {found.st_uid})"
    if found.st_mode & _OTHERS and not writable:
        return f"as others may write to {path} ('chmod go-w' ends that)"
    return ""


def _way(path: Path) -> Iterator[Path]:
    """List a path that is there, the folders above it, and likewise what symbolic links among them lead to."""
    for each in (path, *path.parents):
        yield each
        if each.is_symlink():
            yield from _way(Path(os.path.normpath(each.parent / each.readlink())))


def temporary_folder() -> Path:
    """Make a folder that is removed when this process ends; its workers may use it until then."""
    folder = Path(tempfile.mkdtemp(prefix="cnpgen-cache-"))
    atexit.register(_remove, folder, os.getpid())
    return folder


def _remove(folder: Path, owner: int) -> None:
    if os.getpid() == owner:  # a forked worker inherits what is registered
        shutil.rmtree(folder, ignore_errors=True)
