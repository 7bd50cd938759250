"""Locks of files, for one process at a time; a lock ends with its process."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from cnpgen.errors import UsageError
from cnpgen.store.files.atomic import machine_errors


def try_lock(file: IO[bytes]) -> bool:
    """Lock an open file; return False if another process holds the lock, True where there are no locks."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        # Windows, and file systems without locks
        return True
    return True


def unlock(file: IO[bytes]) -> None:
    """Release the lock on a file, even if processes that were forked meanwhile have it open."""
    with suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(file, fcntl.LOCK_UN)


@contextmanager
def output_lock(out: Path, lock: Path) -> Iterator[None]:
    """Raise UsageError if another process writes the same output; else hold the lock file while the block runs.

    A lock file that cannot be created raises MachineError.
    """
    with machine_errors("write", lock):
        file = lock.open("ab")
    with file:
        # Another process may have removed the file between opening and locking; a lock
        # on it would exclude no other process.
        if not try_lock(file) or not _is_present(file, lock):
            raise UsageError(
                f"another process is writing {out}: wait for it, or choose another {{out}}",
                remedies={"out": None},
            )
        try:
            yield
        finally:
            # The name is removed before the lock ends: a process that waits then sees
            # that its file is gone.
            lock.unlink(missing_ok=True)
            unlock(file)


def _is_present(file: IO[bytes], path: Path) -> bool:
    """Return whether an open file still has its name.

    The previous owner of a lock removes its file.
    """
    with suppress(OSError):
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    return False
