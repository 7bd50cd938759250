"""Temporary files and their removal after the process that wrote them was killed.

The name of a temporary file contains the machine and the process. Several machines with
different clocks may use one folder, so the age of a file is no criterion. A process
removes only files of dead processes on its own machine; all others are removed when the
dataset is finished.
"""

import glob
import hashlib
import os
import platform
import uuid
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path


def temporary_name(name: str) -> str:
    """Return a unique name of a temporary file for the file ``name``.

    It contains machine and process.
    """
    return f".{name}.{_machine()}-{os.getpid()}.{uuid.uuid4().hex}.tmp"


def remove_leftovers(work: Path) -> None:
    """Remove temporary files of dead processes of this machine from their folder, if that is no symbolic link."""
    _remove(path for path in _temporary(work) if _is_dead(path))


def remove_all_temporary(work: Path) -> None:
    """Remove the temporary files of all processes from their folder."""
    _remove(_temporary(work))


def remove_leftovers_of(path: Path) -> None:
    """Remove temporary files for ``path`` of dead processes of this machine."""
    with suppress(OSError):
        _remove(filter(_is_dead, path.parent.glob(f".{glob.escape(path.name)}.*.tmp")))


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _temporary(work: Path) -> Iterator[Path]:
    if not work.is_symlink():
        with suppress(OSError):
            # A temporary name has four dots or more: .NAME.PROCESS.UUID.tmp.
            yield from [
                path for path in work.glob(".*.tmp") if path.name.count(".") > 3
            ]


def _is_dead(path: Path) -> bool:
    """Return whether the owner of a temporary file was a process of this machine that has ended."""
    machine, _, process = path.name.split(".")[-3].partition("-")
    return machine == _machine() and process.isdigit() and not _is_alive(int(process))


def _is_alive(process: int) -> bool:
    try:
        # Signal 0 only checks that the process exists.
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    # A process of another user cannot be signalled, but exists; doubtful files are
    # kept.
    except (OSError, OverflowError):
        return True
    return True


@cache
def _machine() -> str:
    """Return an identifier of the process id space: the boot of the machine and the PID namespace."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        namespace = str(Path("/proc/self/ns/pid").stat().st_ino)
    except OSError:  # no Linux
        boot = platform.node()
        namespace = str(uuid.getnode())
    return hashlib.sha256(f"{boot} {namespace}".encode()).hexdigest()[:12]
