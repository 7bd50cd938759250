"""What ``make-dataset --dry-run`` prints: the blueprint of a dataset and the state of its folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.cli.describe import table
from cnpgen.errors import DatasetError, UsageError
from cnpgen.make.blueprint import dataset_folder, draw_up
from cnpgen.make.load import load_notes
from cnpgen.store.blueprint import Blueprint, shards
from cnpgen.store.layout import MANIFEST
from cnpgen.store.record import pending
from cnpgen.store.shard import storage_dtype
from cnpgen.store.workspace import Workspace, check_clearable, find_workspace, is_begun

if TYPE_CHECKING:
    from cnpgen.make.recipe import DatasetRecipe

SHARD_OVERHEAD = 41_000  # bytes: what the HDF5 file and the sidecar of a shard take beside the rows
DOCUMENTS = 90_000  # bytes: plan.json, manifest, card and statistics


def blueprint_text(recipe: "DatasetRecipe", out: str | None, *, force: bool, **settings: Any) -> str:
    """Draw up the blueprint of a dataset without making anything, and describe it.

    Args:
        recipe: The recipe.
        out: Its folder; None for the default.
        force: Whether another dataset in the folder would be replaced.
        settings: Arguments of ``draw_up``.

    Raises:
        CnpgenError: The dataset cannot be made like this.
    """
    load_notes(recipe)
    workspace = find_workspace(dataset_folder(recipe, out))
    blueprint = draw_up(recipe, workspace, **settings, force=force).blueprint
    files = shards(blueprint)
    splits = [f"{split} {rows:,}" for split, rows in blueprint.splits.items()]
    counts = [f"{split} {sum(task.split == split for task in files)}" for split in blueprint.splits]
    facts = [
        ("folder", workspace.folder),
        ("state", folder_state(workspace, blueprint, force=force)),
        ("rows", f"{sum(blueprint.splits.values()):,}: {', '.join(splits)}"),
        ("shards", f"{len(files)} of at most {blueprint.shard_size:,} rows: {', '.join(counts)}"),
        ("size", f"about {size_text(estimate_bytes(blueprint))}, {row_bytes(blueprint)} bytes per row"),
        ("seed", str(blueprint.seed)),
        ("backend", blueprint.backend),
        ("dtype", blueprint.dtype),
        ("recipe", f"sha256 {blueprint.recipe_sha256}"),
    ]
    fields = [("field", "columns", "unit", "what")]
    fields += [(item.name, str(item.width or "-"), item.unit, item.long_name) for item in blueprint.fields]
    return "\n".join(
        [
            f"{blueprint.name} {blueprint.version}",
            *table(facts, indent="  "),
            "",
            *table(fields, indent="  ", right=(1,)),
        ]
    )


def row_bytes(blueprint: Blueprint) -> int:
    """Return what a row takes."""
    return sum(max(field.width, 1) * storage_dtype(field, blueprint.dtype).itemsize for field in blueprint.fields)


def estimate_bytes(blueprint: Blueprint) -> int:
    """Estimate what the finished dataset takes."""
    return sum(blueprint.splits.values()) * row_bytes(blueprint) + len(shards(blueprint)) * SHARD_OVERHEAD + DOCUMENTS


def folder_state(workspace: Workspace, blueprint: Blueprint, *, force: bool) -> str:
    """Say what is in the folder and what making the dataset would do to it."""
    if workspace.holds == "nothing":
        return "new"
    if workspace.holds != "a dataset":
        return "holds something else: would be refused"
    if force:
        return _replacement(workspace)
    return _refusal(workspace, blueprint) or _progress(workspace.folder, blueprint)


def _replacement(workspace: Workspace) -> str:
    """Say whether --force would replace the dataset in a folder."""
    try:
        check_clearable(workspace)
    except UsageError as error:
        return f"would be refused: it {str(error).removeprefix(f'{workspace.folder} ')}"
    return "holds a dataset, which would be replaced"


def _refusal(workspace: Workspace, blueprint: Blueprint) -> str:
    """Say what becomes of a dataset that is not the one that would be made; nothing if it is."""
    try:
        begun = is_begun(workspace, blueprint)
    except UsageError:
        return "holds another dataset: would be refused without --force"
    except DatasetError:
        return "holds a dataset with a damaged plan.json: would be refused without --force"
    return "" if begun else "holds a plan.json of which nothing was made: would be replaced"


def _progress(folder: Path, blueprint: Blueprint) -> str:
    """Say how far a dataset is."""
    todo, count = len(pending(folder, blueprint)), len(shards(blueprint))
    if todo == 0 and (folder / MANIFEST).is_file():
        return "complete already"
    return f"{count - todo} of {count} shards are there: would go on"


def size_text(number: int) -> str:
    """Write a number of bytes: ``"6.7 MB"``."""
    value, units = float(number), ["bytes", "kB", "MB", "GB", "TB"]
    while value >= 1000 and len(units) > 1:
        value, units = value / 1000, units[1:]
    return f"{value:.3g} {units[0]}" if units[0] != "bytes" else f"{number} bytes"
