"""What processes that were killed leave behind: temporary files, each of which says in its name whose it is.

Several machines may work in one folder, with clocks that differ by hours, so that the age of a file says nothing: a
process sweeps only what processes of its own machine have left that are no more. What those of others have left goes
when the dataset is finished.
"""

import glob
import hashlib
import os
import platform
import uuid
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path


def temporary_name(name: str) -> str:
    """Return the name of a temporary file for a file called ``name``: of this process, and no other one."""
    return f".{name}.{_machine()}-{os.getpid()}.{uuid.uuid4().hex}.tmp"


def sweep(work: Path) -> None:
    """Remove what dead processes of this machine have left in the folder for temporary files.

    Args:
        work: The folder. What is not one of ours is kept, and all of it where the folder is a symbolic link: it may
            lead anywhere.
    """
    for path in _temporary(work):
        if _is_dead(path.name.split(".")[-3]):
            with suppress(OSError):
                path.unlink(missing_ok=True)


def sweep_all(work: Path) -> None:
    """Remove all temporary files from their folder, whoever writes to them: nobody needs them any more."""
    for path in _temporary(work):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def sweep_file(path: Path) -> None:
    """Remove what dead processes of this machine have left of writing a file beside it."""
    with suppress(OSError):
        for leftover in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
            if _is_dead(leftover.name.split(".")[-3]):
                leftover.unlink(missing_ok=True)


def _temporary(work: Path) -> Iterator[Path]:
    if not work.is_symlink():
        with suppress(OSError):
            yield from [path for path in work.glob(".*.tmp") if path.name.count(".") > 3]


def _is_dead(owner: str) -> bool:
    """Whether a process was one of this machine and is no more; of others nobody here knows."""
    machine, _, process = owner.partition("-")
    return machine == _machine() and process.isdigit() and not _is_alive(int(process))


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


@cache
def _machine() -> str:
    """Name what gives processes their numbers: a machine since it was started, and a container on it."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        space = str(Path("/proc/self/ns/pid").stat().st_ino)
    except OSError:  # no Linux
        boot, space = platform.node(), str(uuid.getnode())
    return hashlib.sha256(f"{boot} {space}".encode()).hexdigest()[:12]
