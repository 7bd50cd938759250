"""Opening a folder to make a dataset in it, and clearing one that is to be replaced."""

import shutil
from pathlib import Path

from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.files import machine_error, sweep
from cnpgen.store.layout import PLAN, WORK
from cnpgen.store.plan import DatasetPlan, load_plan, save_plan, to_json

_COMPARED = ("name", "version", "seed", "splits", "dtype", "backend", "shard_size", "recipe_sha256")
_DOCUMENTS = (PLAN, "manifest.json", "stats.json", "croissant.json", "README.md")


def open_workspace(folder: Path, plan: DatasetPlan) -> None:
    """Create the folder with its plan, or make sure that it holds the same plan already.

    Raises:
        UsageError: The folder holds something else.
        MachineError: The folder cannot be written.
        DatasetError: The plan in the folder is damaged.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file, not a folder; choose another --out")
    if (folder / PLAN).exists():
        found = load_plan(folder)
        if found.fingerprint != plan.fingerprint:
            raise UsageError(
                f"{folder} holds another dataset ({_difference(found, plan)});"
                " choose another --out, or replace it with --force"
            )
    elif folder.is_dir() and any(path.name not in (WORK, PLAN) for path in folder.iterdir()):
        raise UsageError(f"{folder} is not empty and not a dataset of cnpgen; choose another --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise machine_error("create", folder, error) from error
    if not (folder / PLAN).exists():
        save_plan(folder, plan)
    sweep(folder / WORK)


def clear_dataset(folder: Path) -> None:
    """Delete the dataset in a folder, and nothing that is not part of one.

    Raises:
        UsageError: The folder holds something that is not a dataset of cnpgen.
        MachineError: A file cannot be deleted.
    """
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not (folder / PLAN).is_file():
        raise UsageError(f"{folder} is not a dataset of cnpgen: --force deletes only those; choose another --out")
    try:
        splits = [folder / split for split in load_plan(folder).splits]
    except DatasetError:  # a damaged plan: what looks like a split is one
        splits = sorted({path.parent for path in folder.glob("*/shard-*.json")})
    foreign = _foreign(folder, splits)
    if foreign:
        raise UsageError(
            f"{folder} holds {foreign.relative_to(folder)}, which is not part of the dataset: move it away first"
        )
    try:
        for name in ("manifest.json", *_DOCUMENTS):  # the manifest first: what is half deleted must not look complete
            (folder / name).unlink(missing_ok=True)
        for split in splits:
            for path in split.glob("shard-*.*"):
                path.unlink()
            if split.is_dir() and not any(split.iterdir()):
                split.rmdir()
        shutil.rmtree(folder / WORK, ignore_errors=True)
    except OSError as error:
        raise machine_error("delete from", folder, error) from error


def _foreign(folder: Path, splits: list[Path]) -> Path | None:
    """Return a file that --force must not delete and that would be in the way, if there is one."""
    known = {*_DOCUMENTS, WORK, *(split.name for split in splits)}
    candidates = [path for path in folder.iterdir() if path.name not in known]
    for split in splits:
        if split.is_dir():
            candidates += [path for path in split.iterdir() if not path.match("shard-*.*")]
    return min(candidates, default=None)


def _difference(found: DatasetPlan, wanted: DatasetPlan) -> str:
    """Name the first few settings in which two plans differ."""
    old, new = to_json(found), to_json(wanted)
    differences = [f"{key} {old[key]} instead of {new[key]}" for key in _COMPARED if old[key] != new[key]]
    return "; ".join(differences[:3]) or "made by another version of cnpgen"
