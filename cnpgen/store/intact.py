"""Verification of shards against their recorded size and sha256, before their values are used."""

import os
from collections.abc import Iterable
from pathlib import Path

from cnpgen.errors import DatasetError
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.layout import DOCUMENTS, WORK

COPY_HINT = "replace the links by files: copy the dataset with cp -rL"
RERUN_HINT = "run make_dataset or 'cnpgen make-dataset' again with the same arguments"

OUTSIDE = "is a link that leads outside the folder of the dataset"

# Path, mtime [ns], size and sha256 of the shards that this process has verified.
_verified: set[tuple[Path, int, int, str]] = set()


def leads_outside(path: Path, folder: Path | None = None) -> bool:
    """Return whether a file, or its folder, is a link that leads outside the folder of the dataset.

    By default, the file is in the folder of a split.
    """
    folder = path.parents[1] if folder is None else folder
    if not (path.is_symlink() or (path.parent != folder and path.parent.is_symlink())):
        return False
    # resolve() refuses circular links
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def outside_links(folder: Path, names: Iterable[str] = (*DOCUMENTS, WORK)) -> list[str]:
    """List the documents of a dataset and the folders in it that are links that lead outside its folder."""
    return [name for name in names if leads_outside(folder / name, folder)]


def size_problem(path: Path, size: int) -> str:
    """Describe the problem of a shard without opening it.

    Empty if it has the recorded size [bytes].
    """
    if not path.is_file():
        return f"{path} is missing"
    if leads_outside(path):
        return f"{path} {OUTSIDE}"
    actual = path.stat().st_size
    return "" if actual == size else f"{path} has {actual} bytes instead of {size}"


def digest_problem(path: Path) -> str:
    """Return the message for a shard with another sha256 than the recorded one."""
    return f"{path} is damaged: its sha256 is not the recorded one"


def require_intact(path: Path, *, size: int, sha256: str) -> None:
    """Raise DatasetError if a shard has not its recorded size [bytes] and sha256.

    Verify it once per process.
    """
    if problem := size_problem(path, size):
        raise DatasetError(f"{problem}; {RERUN_HINT}")
    # A changed file has another time: it is verified again.
    identity = (path.absolute(), path.stat().st_mtime_ns, size, sha256)
    if identity in _verified:
        return
    if file_sha256(path) != sha256:
        raise DatasetError(f"{digest_problem(path)}; {RERUN_HINT}")
    _verified.add(identity)
