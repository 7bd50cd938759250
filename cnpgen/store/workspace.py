"""The folder in which a dataset is made: what is there, whose it is, and what may be done with it."""

import errno
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.store.blueprint import INFORMATIONAL, Blueprint, load_blueprint, to_json, write_blueprint
from cnpgen.store.files.atomic import machine_error, read_file
from cnpgen.store.files.documents import Difference, differences
from cnpgen.store.files.leftovers import sweep
from cnpgen.store.layout import CARD, CROISSANT, MANIFEST, PLAN, STATS, WORK

_SUMMARIES = (MANIFEST, STATS, CROISSANT, CARD)
_SHARD = re.compile(r"shard-\d{5,}\.(h5|json)")
_MARK = re.compile(rb'\{\s*"format": "cnpgen-')


@dataclass(frozen=True)
class Workspace:
    """A folder for a dataset as it was found; others may change it meanwhile.

    Attributes:
        folder: The folder.
        there: The folder, or where it is missing the nearest one above it that is there.
        holds: What is in it: "nothing", "a dataset", finished or not, damaged or not, "a file" in its place, or
            "something else".
        rows: Whether there are shards, or records of shards.
        blueprint: The blueprint in it; None where there is none that can be read.
        damage: Why the blueprint cannot be read; empty where it can.
    """

    folder: Path
    there: Path
    holds: Literal["nothing", "a dataset", "a file", "something else"]
    rows: bool = False
    blueprint: Blueprint | None = None
    damage: str = ""


def find_workspace(folder: Path) -> Workspace:
    """Look at a folder in which a dataset is to be made.

    Raises:
        MachineError: The system would not let us look.
    """
    try:
        above = [folder.absolute(), *folder.absolute().parents]
        there = next(path for path in above if path.exists())
        if not there.is_dir():
            return Workspace(folder, there, "a file")
        if there != above[0] or all(item.name == WORK for item in folder.iterdir()):
            return Workspace(folder, there, "nothing")
    except OSError as error:
        raise machine_error("write to", folder, error) from error
    if not is_dataset(folder):
        return Workspace(folder, there, "something else")
    rows = any(_shard_files(folder))
    try:
        return Workspace(folder, there, "a dataset", rows, load_blueprint(folder))
    except DatasetError as error:
        return Workspace(folder, there, "a dataset", rows, damage=str(error))


def check_place(workspace: Workspace) -> None:
    """Refuse a folder in which no dataset can be made, before any work is done for it.

    A finished dataset need not be writable: it may turn out that there is nothing to do.

    Raises:
        UsageError: It is a file, lies below one, or holds something that is not a dataset of cnpgen.
        MachineError: It cannot be written.
    """
    if workspace.holds == "a file":
        raise UsageError(f"{workspace.there} is a file, not a folder; choose another out=")
    if workspace.holds == "something else":
        raise UsageError(f"{workspace.folder} is not empty and not a dataset of cnpgen; choose another out=")
    if (workspace.folder / MANIFEST).is_file():
        return
    if not os.access(workspace.there, os.W_OK | os.X_OK):
        number = errno.EROFS if _is_read_only(workspace.there) else errno.EACCES
        raise machine_error("write to", workspace.folder, OSError(number, os.strerror(number)))


def _is_read_only(path: Path) -> bool:
    """Whether a path is on a file system that nobody can write to."""
    return hasattr(os, "statvfs") and bool(os.statvfs(path).f_flag & os.ST_RDONLY)


def begun_blueprint(workspace: Workspace, wanted: Blueprint) -> Blueprint | None:
    """Return the blueprint in a folder if it is the one that is wanted; if there is none, it may be written.

    It is the same, but perhaps written by another version of cnpgen, as its shards say.

    Raises:
        UsageError: It has rows of another blueprint.
        DatasetError: It has rows, and its blueprint is damaged.
    """
    found = workspace.blueprint
    if found is not None and found.fingerprint == wanted.fingerprint:
        return found
    if not workspace.rows:
        return None
    if found is None:
        raise DatasetError(f"{workspace.damage}; force=True replaces the whole dataset")
    raise UsageError(f"{workspace.folder} {_refusal(found, wanted)}")


def open_workspace(folder: Path, blueprint: Blueprint, *, force: bool = False) -> Blueprint:
    """Create the folder with its blueprint, or make sure that it holds the same blueprint already.

    The folder is looked at anew: while kernels were built another process may have begun the dataset in it. A blueprint
    of which nothing was made yet gives way to the new one: it costs nothing.

    Args:
        folder: The folder.
        blueprint: What is to be made.
        force: Whether to delete the dataset that is in the folder.

    Returns:
        The blueprint in the folder (see ``begun_blueprint``).

    Raises:
        UsageError: The folder holds something else.
        MachineError: The folder cannot be written.
        DatasetError: The blueprint in the folder is damaged.
    """
    workspace = find_workspace(folder)
    check_place(workspace)
    workspace = _cleared(workspace) if force else workspace
    begun = begun_blueprint(workspace, blueprint)
    if begun is None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for name in _SUMMARIES:
                (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise machine_error("write to", folder, error) from error
        write_blueprint(folder, blueprint)
    sweep(folder / WORK)
    return begun or blueprint


def require_blueprint(folder: Path, blueprint: Blueprint) -> None:
    """Make sure that the folder still belongs to a blueprint: another process may have replaced the dataset meanwhile.

    Raises:
        UsageError: It has another blueprint now.
        MachineError: It has none, or is gone.
    """
    try:
        mine = blueprint.fingerprint.encode() in read_file(folder / PLAN)
    except DatasetError as error:
        what = f"the {PLAN} in it" if folder.is_dir() else "it"
        raise MachineError(
            f"{folder}: {what} was deleted or moved while the dataset was made; make it again"
        ) from error
    if not mine:
        raise UsageError(f"{folder} was given to another dataset while this one was made; choose another out=")


def is_dataset(folder: Path) -> bool:
    """Whether a folder holds a dataset of cnpgen, finished or not, damaged or not: one of its documents says so."""
    sidecars = (path for path in _shard_files(folder) if path.suffix == ".json")
    return any(_is_ours(path) for path in (folder / PLAN, folder / MANIFEST, folder / STATS, *sidecars))


def _is_ours(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return _MARK.match(file.read(64)) is not None
    except OSError:
        return False


def _shard_files(folder: Path) -> Iterator[Path]:
    """List the shards and sidecars in a folder, of whatever splits."""
    return (path for path in folder.glob("*/shard-*.*") if _SHARD.fullmatch(path.name))


def _refusal(found: Blueprint, wanted: Blueprint) -> str:
    """Say why a dataset cannot become another one, and what to do."""
    if changed := changed_settings(found, wanted):
        return f"holds another dataset ({changed}); choose another out=, or replace it with force=True"
    larger = all(rows <= wanted.splits.get(split, 0) for split, rows in found.splits.items())
    extend = "extend_dataset or 'cnpgen extend' adds the rows, or " if larger else ""
    return (
        f"holds this dataset with {_sizes(found)}, not with {_sizes(wanted)}; the rows that both sizes have are the"
        f" same: {extend}choose another out=, or replace it with force=True"
    )


def changed_settings(found: Blueprint, wanted: Blueprint) -> str:
    """Name up to three settings in which two blueprints differ, except for their sizes; nothing if there are none."""
    same = (*INFORMATIONAL, "splits", "earlier")
    old, new = ({key: value for key, value in to_json(item).items() if key not in same} for item in (found, wanted))
    return "; ".join([*dict.fromkeys(_setting(difference) for difference in differences(old, new))][:3])


def _setting(difference: Difference) -> str:
    """Name a setting in which two blueprints differ, with its values where they say something."""
    key, _, rest = difference.key.partition(".")
    if key == "recipe_sha256":
        return "another recipe"
    if rest or isinstance(difference.found, list):
        return f"another {key}"
    return f"{key.replace('_', ' ')} {difference.found} instead of {difference.wanted}"


def _sizes(blueprint: Blueprint) -> str:
    splits = ", ".join(f"{split} {rows:,}" for split, rows in blueprint.splits.items())
    return f"{sum(blueprint.splits.values()):,} rows ({splits})"


def _cleared(workspace: Workspace) -> Workspace:
    """Delete the dataset in a folder, and nothing that is not part of one.

    Raises:
        UsageError: The folder holds something that is not part of the dataset.
        MachineError: A file cannot be deleted.
    """
    if workspace.holds != "a dataset":
        return workspace
    folder, splits = workspace.folder, check_clearable(workspace)
    try:
        (folder / MANIFEST).unlink(missing_ok=True)  # first: what is half deleted must not look complete
        for split in splits:
            for path in split.iterdir():
                path.unlink()
            split.rmdir()
        shutil.rmtree(folder / WORK, ignore_errors=True)
        for name in (*_SUMMARIES, PLAN):  # last: what is half deleted must still look like a dataset
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise machine_error("delete from", folder, error) from error
    return Workspace(folder, workspace.there, "nothing")


def check_clearable(workspace: Workspace) -> list[Path]:
    """Refuse a folder that holds anything else than a dataset; return the folders of its splits.

    Those are the splits that the blueprint names, or, where it cannot be read, the folders with shards.

    Raises:
        UsageError: It does.
    """
    folder, blueprint = workspace.folder, workspace.blueprint
    named = sorted({path.parent for path in _shard_files(folder)})
    if blueprint is not None:
        named = [folder / split for split in blueprint.splits]
    splits = [split for split in named if split.is_dir()]
    if foreign := _foreign(folder, splits):
        raise UsageError(
            f"{folder} holds {foreign.relative_to(folder)}, which is not part of the dataset: move it away first"
        )
    return splits


def _foreign(folder: Path, splits: list[Path]) -> Path | None:
    """Return a file that force=True must not delete and that would be in the way, if there is one."""
    known = {*_SUMMARIES, PLAN, WORK, *(split.name for split in splits)}
    candidates = [path for path in folder.iterdir() if path.name not in known]
    for split in splits:
        candidates += [path for path in split.iterdir() if not _SHARD.fullmatch(path.name)]
        candidates += [split] if split.is_symlink() else []
    return min(candidates, default=None)
