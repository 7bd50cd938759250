"""Merge of the parts of a dataset, generated in separate folders, into one dataset."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from cnpgen.errors import DatasetError, RecipeError, UsageError, listed
from cnpgen.make.certify import certified
from cnpgen.make.generation_options import Begin
from cnpgen.make.make_dataset import MadeDataset, Progress, finish
from cnpgen.make.recipe import load_dataset_recipe, load_notes, recipe_digest
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.catalogue import list_recipes
from cnpgen.store.checked_shard import Shard, read_rows
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask, load_dataset_spec, shards
from cnpgen.store.files.atomic import committing, file_sha256, read_file, write_file
from cnpgen.store.intact import COPY_HINT, OUTSIDE, outside_links
from cnpgen.store.layout import DOCUMENTS, WORK
from cnpgen.store.manifest import source_date
from cnpgen.store.paths import require_dataset
from cnpgen.store.shard_record import is_committed, load_committed
from cnpgen.store.workspace import (
    changed_settings,
    check_place,
    find_workspace,
    open_workspace,
)

MAX_LISTED_SHARDS = 3  # in an error message


@checked_arguments
def merge_datasets(
    parts: Sequence[str | Path],
    out: str | Path,
    *,
    begin: Begin | None = None,
    progress: Progress | None = None,
) -> MadeDataset:
    """Merge parts that ``make_dataset(..., part=(k, m))`` generated in separate folders, or continue a merge.

    Shards and their records are copied after a comparison with their recorded sha256.
    The rows are therefore identical to those of a dataset generated at once. The parts
    stay unchanged.

    Args:
        parts: Folders of the parts.
        out: Folder of the dataset; it may be one of the parts.
        begin: Called with ("merging", folder, rows, existing rows) before shards are
            copied.
        progress: Called with (rows, None) of every copied shard.

    Raises:
        UsageError: A folder does not exist, a part belongs to another dataset, two
            parts have the same shard, or ``out`` holds other content.
        DatasetError: A folder holds no dataset, or a shard is damaged or missing.
        MachineError: The disk is full or a file operation failed.
    """
    source_date()
    if not parts or not all(isinstance(part, str | Path) for part in parts):
        raise UsageError(
            f"must name at least one folder, and only folders, got {parts!r:.100}",
            argument="parts",
        )
    out = Path(out)
    folders = [Path(part) for part in parts]
    spec = _common_spec(folders)
    # A part may be the output itself: its shards stay where they are.
    others = [folder for folder in folders if folder.resolve() != out.resolve()]
    workspace = find_workspace(out)
    check_place(workspace)
    owners = _owners(others, out, spec)
    open_workspace(out, spec)
    if begin is not None:
        rows = sum(spec.splits.values())
        begin("merging", out, rows, rows - sum(task.rows for task in owners))
    for task, folder in owners.items():
        _copy(folder, out, task, spec)
        if progress is not None:
            progress(task.rows, None)
    made = sum(task.rows for task in owners)
    complete, documents = finish(
        out, spec, _shipped_notes(spec), made=made, exclusive=True
    )
    return MadeDataset(out, spec, made, complete, dict(spec.splits), tuple(documents))


def _common_spec(folders: Sequence[Path]) -> DatasetSpec:
    """Return the common specification of all parts."""
    for folder in folders:
        require_dataset(folder, argument="parts")
        _require_inside(folder)
    first, *rest = folders
    spec = load_dataset_spec(first)
    for folder in rest:
        other = load_dataset_spec(folder)
        if other.fingerprint != spec.fingerprint:
            changed = (
                changed_settings(other, spec)
                or f"{dict(other.splits)} rows instead of {spec.splits}"
            )
            raise UsageError(f"{folder} is of another dataset than {first}: {changed}")
    return spec


def _require_inside(folder: Path, names: Sequence[str] = (*DOCUMENTS, WORK)) -> None:
    """Raise an error for documents, or other files, that are links that lead outside the folder of a part."""
    if links := outside_links(folder, names):
        raise DatasetError(f"{folder / links[0]} {OUTSIDE}; {COPY_HINT}")


def _owners(
    folders: Sequence[Path], out: Path, spec: DatasetSpec
) -> dict[ShardTask, Path]:
    """Return the folder of each shard to copy.

    Raise an error for a shard in two folders or in none.
    """
    owners: dict[ShardTask, Path] = {}
    missing = []
    for task in shards(spec):
        holders = [folder for folder in folders if (folder / task.sidecar).exists()]
        if len(holders) > 1:
            raise UsageError(
                f"{holders[0]} and {holders[1]} both have {task.file}: parts must not overlap"
            )
        if is_committed(out, spec, task):
            # Equal records are those of an earlier, interrupted merge.
            if holders and read_file(holders[0] / task.sidecar) != read_file(
                out / task.sidecar
            ):
                raise UsageError(
                    f"{holders[0]} and {out} both have {task.file}: parts must not overlap"
                )
        elif holders:
            _require_inside(holders[0], (task.file, task.sidecar))
            owners[task] = holders[0]
        else:
            missing.append(task.file)
    if missing:
        raise DatasetError(
            f"no part has {listed(missing, MAX_LISTED_SHARDS)}: make the missing shards first"
        )
    return owners


def _copy(folder: Path, out: Path, task: ShardTask, spec: DatasetSpec) -> None:
    """Copy a shard and then its sidecar, which marks it as complete."""
    record = load_committed(folder, spec, task)
    with committing(out / task.file, out / WORK) as temporary:
        shutil.copyfile(folder / task.file, temporary)
        # The copy is compared, not the source, so that errors of copying are found,
        # too.
        if file_sha256(temporary) != record.sha256:
            raise DatasetError(
                f"{folder / task.file} was changed: its sha256 is not the recorded one"
            )
        read_rows(Shard(folder, spec, task))
    write_file(out / task.sidecar, read_file(folder / task.sidecar), work=out / WORK)


def _shipped_notes(spec: DatasetSpec) -> str:
    """Return the data card of a shipped recipe with the same rows.

    Empty for other recipes.
    """
    model = spec.stages[-1].get("model")
    for name in list_recipes("dataset"):
        with suppress(RecipeError, UsageError):
            recipe = load_dataset_recipe(name)
            for variant in (recipe, certified(recipe, model=model)):
                if (
                    variant.name == spec.name
                    and recipe_digest(variant) == spec.recipe_sha256
                ):
                    return load_notes(variant)
    return ""
