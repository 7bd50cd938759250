"""Parts of a dataset that were made in separate folders become one dataset."""

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from cnpgen.errors import DatasetError, RecipeError, UsageError
from cnpgen.make.certify import certified
from cnpgen.make.dataset import Begin, MadeDataset, Progress, finish
from cnpgen.make.load import load_dataset_recipe, load_notes
from cnpgen.make.recipe import recipe_digest
from cnpgen.schema.catalogue import list_recipes
from cnpgen.store.blueprint import Blueprint, ShardTask, load_blueprint, shards
from cnpgen.store.files.atomic import committing, file_sha256, read_file, write_file
from cnpgen.store.layout import WORK
from cnpgen.store.manifest import source_date
from cnpgen.store.paths import require_folder
from cnpgen.store.record import is_committed, load_committed
from cnpgen.store.workspace import changed_settings, check_place, find_workspace, open_workspace

SHOWN = 3  # shards that a message names


def merge_datasets(
    parts: Sequence[str | Path],
    out: str | Path,
    *,
    begin: Begin | None = None,
    progress: Progress | None = None,
) -> MadeDataset:
    """Make one dataset of parts that ``make_dataset(..., part=(k, m))`` made in separate folders, or go on with that.

    Shards and their records are copied, after a comparison with their recorded sha256, so that the rows are those of a
    dataset that was made at once, to the bit. The parts stay as they are.

    Args:
        parts: The folders of the parts.
        out: The folder of the dataset; it may be one of the parts, whose shards then stay where they are.
        begin: Called with ("merging", folder, rows, rows that are there) before shards are copied.
        progress: Called with (rows, None) of every shard that was copied.

    Raises:
        UsageError: A folder is not there, a part is of another dataset, two have the same shard, or ``out`` holds
            something else.
        DatasetError: A folder holds no dataset, a shard is damaged, or no part has it.
        MachineError: The disk is full, or otherwise unwilling.
    """
    source_date()
    out, folders = Path(out), [Path(part) for part in parts]
    blueprint = _common_blueprint(folders)
    others = [folder for folder in folders if folder.resolve() != out.resolve()]
    workspace = find_workspace(out)
    check_place(workspace)
    theirs = _owners(others, out, blueprint)
    open_workspace(out, blueprint)
    if begin is not None:
        rows = sum(blueprint.splits.values())
        begin("merging", out, rows, rows - sum(task.rows for task in theirs))
    for task, folder in theirs.items():
        _copy(folder, out, task, blueprint)
        if progress is not None:
            progress(task.rows, None)
    made = sum(task.rows for task in theirs)
    complete, documents = finish(out, blueprint, _shipped_notes(blueprint), made=made, alone=True)
    return MadeDataset(out, blueprint, made, complete, dict(blueprint.splits), tuple(documents))


def _common_blueprint(folders: Sequence[Path]) -> Blueprint:
    """Return the blueprint that all parts have."""
    if not folders:
        raise UsageError("parts must name at least one folder, got none")
    for folder in folders:
        require_folder(folder)
    first, *rest = folders
    blueprint = load_blueprint(first)
    for folder in rest:
        found = load_blueprint(folder)
        if found.fingerprint != blueprint.fingerprint:
            changed = changed_settings(found, blueprint) or f"{dict(found.splits)} rows instead of {blueprint.splits}"
            raise UsageError(f"{folder} is of another dataset than {first}: {changed}")
    return blueprint


def _owners(folders: Sequence[Path], out: Path, blueprint: Blueprint) -> dict[ShardTask, Path]:
    """Return who has each of the shards that are to be copied.

    Raises:
        UsageError: Two have the same one.
        DatasetError: Nobody has one.
    """
    owners: dict[ShardTask, Path] = {}
    missing = []
    for task in shards(blueprint):
        having = [folder for folder in folders if (folder / task.sidecar).exists()]
        if len(having) > 1:
            raise UsageError(f"{having[0]} and {having[1]} both have {task.file}: parts must not overlap")
        if is_committed(out, blueprint, task):
            if having and read_file(having[0] / task.sidecar) != read_file(out / task.sidecar):
                raise UsageError(f"{having[0]} and {out} both have {task.file}: parts must not overlap")
        elif having:
            owners[task] = having[0]
        else:
            missing.append(task.file)
    if missing:
        more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        raise DatasetError(f"no part has {', '.join(missing[:SHOWN])}{more}: make what is missing first")
    return owners


def _copy(folder: Path, out: Path, task: ShardTask, blueprint: Blueprint) -> None:
    """Copy a shard and then its sidecar, by which it counts as made."""
    record = load_committed(folder, blueprint, task)
    with committing(out / task.file, out / WORK) as temporary:
        shutil.copyfile(folder / task.file, temporary)
        if file_sha256(temporary) != record.sha256:
            raise DatasetError(f"{folder / task.file} was changed: its sha256 is not the recorded one")
    write_file(out / task.sidecar, read_file(folder / task.sidecar), work=out / WORK)


def _shipped_notes(blueprint: Blueprint) -> str:
    """Return the data card of the shipped recipe that a dataset was made of; parts of other recipes hold none."""
    known: Mapping[str, Path] = list_recipes("dataset")
    model = blueprint.stages[-1].get("model")
    for name in known:
        with suppress(RecipeError, UsageError):
            recipe = load_dataset_recipe(name)
            for each in (recipe, certified(recipe, model=model)):
                if each.name == blueprint.name and recipe_digest(each) == blueprint.recipe_sha256:
                    return load_notes(each)
    return ""
