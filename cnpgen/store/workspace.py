"""The folder of a dataset that is being made: whose it is, opening it, and clearing what is to be replaced."""

import errno
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.blueprint import INFORMATIONAL, Blueprint, load_blueprint, to_json, write_plan
from cnpgen.store.files.atomic import machine_error, read_file, sweep
from cnpgen.store.layout import CARD, CROISSANT, MANIFEST, PLAN, STATS, WORK

_SUMMARIES = (MANIFEST, STATS, CROISSANT, CARD)
_SHARD = re.compile(r"shard-\d{5,}\.(h5|json)")
_MARK = re.compile(rb'\{\s*"format": "cnpgen-')


def check_place(folder: Path) -> None:
    """Refuse a folder in which no dataset can be made, before any work is done for it.

    Raises:
        UsageError: It is a file, lies below one, or holds something that is not a dataset of cnpgen.
        MachineError: It cannot be written.
    """
    try:
        above = [folder.absolute(), *folder.absolute().parents]
        there = next(path for path in above if path.exists())
        if not there.is_dir():
            raise UsageError(f"{there} is a file, not a folder; choose another --out")
        if there == above[0] and not is_dataset(folder) and any(item.name != WORK for item in folder.iterdir()):
            raise UsageError(f"{folder} is not empty and not a dataset of cnpgen; choose another --out")
        if not os.access(there, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise machine_error("write to", folder, error) from error


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


def open_workspace(folder: Path, blueprint: Blueprint) -> None:
    """Create the folder with its plan, or make sure that it holds the same plan already.

    A plan of which nothing was made yet gives way to the new one: it costs nothing.

    Raises:
        UsageError: The folder holds something else.
        MachineError: The folder cannot be written.
        DatasetError: The plan in the folder is damaged.
    """
    check_place(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise machine_error("create", folder, error) from error
    if not holds_plan(folder, blueprint):
        for name in _SUMMARIES:
            (folder / name).unlink(missing_ok=True)
        write_plan(folder, blueprint)
    sweep(folder / WORK)


def holds_plan(folder: Path, blueprint: Blueprint) -> bool:
    """Whether a folder has the plan already; if not, it may be written.

    Raises:
        UsageError: It has rows of another plan.
        DatasetError: It has rows, and its plan is damaged.
    """
    used = any(_shard_files(folder))
    try:
        found = load_blueprint(folder)
    except DatasetError as error:
        if used:
            raise DatasetError(f"{error}; --force replaces the whole dataset") from error
        return False
    if found.fingerprint == blueprint.fingerprint:
        return True
    if used:
        raise UsageError(f"{folder} {_refusal(found, blueprint)}")
    return False


def _refusal(found: Blueprint, wanted: Blueprint) -> str:
    """Say why a dataset cannot become another one, and what to do."""
    differences = _differences(to_json(found), to_json(wanted))
    if not differences:
        return (
            f"holds this dataset with {_sizes(found)}, not with {_sizes(wanted)}; a dataset does not grow or shrink,"
            " but the rows that both sizes have are the same: choose another --out, or replace it with --force"
        )
    return f"holds another dataset ({'; '.join(differences[:3])}); choose another --out, or replace it with --force"


def _differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Name the settings, besides the number of rows, in which two plans differ."""
    found = []
    for key in old:
        if key in INFORMATIONAL or key == "splits" or old[key] == new[key]:
            continue
        if key == "recipe_sha256":
            found.append("another recipe")
            continue
        plain = isinstance(old[key], str | int)
        found.append(f"{key.replace('_', ' ')} {old[key]} instead of {new[key]}" if plain else f"another {key}")
    return found


def _sizes(blueprint: Blueprint) -> str:
    splits = ", ".join(f"{split} {rows:,}" for split, rows in blueprint.splits.items())
    return f"{sum(blueprint.splits.values()):,} rows ({splits})"


def require_plan(folder: Path, blueprint: Blueprint) -> None:
    """Make sure that the folder still belongs to a plan: another process may have replaced the dataset meanwhile.

    Raises:
        UsageError: It has another plan now, or none.
    """
    try:
        mine = blueprint.fingerprint.encode() in read_file(folder / PLAN)
    except DatasetError:
        mine = False
    if not mine:
        raise UsageError(f"{folder} was given to another dataset while this one was made; choose another --out")


def clear_dataset(folder: Path) -> None:
    """Delete the dataset in a folder, and nothing that is not part of one.

    Raises:
        UsageError: The folder holds something that is not a dataset of cnpgen.
        MachineError: A file cannot be deleted.
    """
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    splits = check_clearable(folder)
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


def check_clearable(folder: Path) -> list[Path]:
    """Refuse a folder that holds anything else than a dataset; return the folders of its splits.

    Raises:
        UsageError: It does.
    """
    if not is_dataset(folder):
        raise UsageError(f"{folder} is not a dataset of cnpgen: --force deletes only those; choose another --out")
    splits = _splits(folder)
    foreign = _foreign(folder, splits)
    if foreign:
        raise UsageError(
            f"{folder} holds {foreign.relative_to(folder)}, which is not part of the dataset: move it away first"
        )
    return splits


def _splits(folder: Path) -> list[Path]:
    """List the folders of the splits: those that the plan names, or, where it is damaged, those with shards."""
    try:
        splits = [folder / split for split in load_blueprint(folder).splits]
    except DatasetError:
        splits = sorted({path.parent for path in _shard_files(folder)})
    return [split for split in splits if split.is_dir()]


def _foreign(folder: Path, splits: list[Path]) -> Path | None:
    """Return a file that --force must not delete and that would be in the way, if there is one."""
    known = {*_SUMMARIES, PLAN, WORK, *(split.name for split in splits)}
    candidates = [path for path in folder.iterdir() if path.name not in known]
    for split in splits:
        candidates += [path for path in split.iterdir() if not _SHARD.fullmatch(path.name)]
        candidates += [split] if split.is_symlink() else []
    return min(candidates, default=None)
