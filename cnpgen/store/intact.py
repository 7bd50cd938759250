"""Shards that are what was written: each is compared with its recorded size and sha256 before its numbers are used."""

import os
from pathlib import Path

from cnpgen.errors import DatasetError
from cnpgen.store.files.atomic import file_sha256

AGAIN = "run make_dataset or 'cnpgen make-dataset' again with the same arguments"

OUTSIDE = "is a link that leads out of the dataset's folder"

_intact: set[tuple[Path, int, int, str]] = set()  # path, mtime [ns], size and sha256 of what this process has compared


def leads_outside(path: Path) -> bool:
    """Whether a file of a split is a link, or in a folder that is one, that leads out of the folder of the dataset."""
    if not (path.is_symlink() or path.parent.is_symlink()):
        return False
    folder = os.path.realpath(path.parents[1])  # Path.resolve raises where links lead in a circle
    return not Path(os.path.realpath(path)).is_relative_to(folder)


def size_problem(path: Path, size: int) -> str:
    """Say what is wrong with a shard without opening it; nothing if it has the recorded size [bytes]."""
    if not path.is_file():
        return f"{path} is missing"
    if leads_outside(path):
        return f"{path} {OUTSIDE}"
    found = path.stat().st_size
    return "" if found == size else f"{path} has {found} bytes instead of {size}"


def digest_problem(path: Path) -> str:
    """Say that a shard has not the recorded sha256."""
    return f"{path} is damaged: its sha256 is not the recorded one"


def require_intact(path: Path, *, size: int, sha256: str) -> None:
    """Refuse a shard that is not the recorded one; it is read once per process, unless it is written to afterwards.

    Args:
        path: The shard.
        size: Its recorded size [bytes].
        sha256: Its recorded digest.

    Raises:
        DatasetError: It is missing, cut off or changed.
        MachineError: The system would not let us read it.
    """
    if problem := size_problem(path, size):
        raise DatasetError(f"{problem}; {AGAIN}")
    state = (path.absolute(), path.stat().st_mtime_ns, size, sha256)
    if state in _intact:
        return
    if file_sha256(path) != sha256:
        raise DatasetError(f"{digest_problem(path)}; {AGAIN}")
    _intact.add(state)
