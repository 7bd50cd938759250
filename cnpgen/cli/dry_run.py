"""What ``make-dataset --dry-run`` prints: the plan of a dataset and the state of its folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.cli.describe import table
from cnpgen.errors import DatasetError, UsageError
from cnpgen.make.blueprint import plan_dataset
from cnpgen.make.load import load_notes
from cnpgen.store.blueprint import DatasetPlan, shards
from cnpgen.store.layout import MANIFEST
from cnpgen.store.record import pending
from cnpgen.store.shard import storage_dtype
from cnpgen.store.workspace import check_clearable, holds_plan, is_dataset

if TYPE_CHECKING:
    from cnpgen.make.recipe import DatasetRecipe

SHARD_OVERHEAD = 41_000  # bytes: what the HDF5 file and the sidecar of a shard take beside the rows
DOCUMENTS = 90_000  # bytes: plan, manifest, card and statistics


def plan_text(recipe: "DatasetRecipe", *, force: bool, **settings: Any) -> str:
    """Plan a dataset without making anything, and describe the plan.

    Args:
        recipe: The recipe.
        force: Whether another dataset in the folder would be replaced.
        settings: Arguments of ``plan_dataset``.

    Raises:
        CnpgenError: The dataset cannot be made like this.
    """
    load_notes(recipe)
    job = plan_dataset(recipe, **settings, resume=not force)
    plan = job.plan
    files = shards(plan)
    splits = [f"{split} {rows:,}" for split, rows in plan.splits.items()]
    counts = [f"{split} {sum(task.split == split for task in files)}" for split in plan.splits]
    facts = [
        ("folder", job.folder),
        ("state", folder_state(job.folder, plan, force=force)),
        ("rows", f"{sum(plan.splits.values()):,}: {', '.join(splits)}"),
        ("shards", f"{len(files)} of at most {plan.shard_size:,} rows: {', '.join(counts)}"),
        ("size", f"about {size_text(estimate_bytes(plan))}, {row_bytes(plan)} bytes per row"),
        ("seed", str(plan.seed)),
        ("backend", plan.backend),
        ("dtype", plan.dtype),
        ("recipe", f"sha256 {plan.recipe_sha256}"),
    ]
    fields = [("field", "columns", "unit", "what")]
    fields += [(item.name, str(item.width or "-"), item.unit, item.long_name) for item in plan.fields]
    return "\n".join(
        [f"{plan.name} {plan.version}", *table(facts, indent="  "), "", *table(fields, indent="  ", right=(1,))]
    )


def row_bytes(plan: DatasetPlan) -> int:
    """Return what a row takes."""
    return sum(max(field.width, 1) * storage_dtype(field, plan.dtype).itemsize for field in plan.fields)


def estimate_bytes(plan: DatasetPlan) -> int:
    """Estimate what the finished dataset takes."""
    return sum(plan.splits.values()) * row_bytes(plan) + len(shards(plan)) * SHARD_OVERHEAD + DOCUMENTS


def folder_state(folder: Path, plan: DatasetPlan, *, force: bool) -> str:
    """Say what is in the folder and what making the dataset would do to it."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return "new"
    if not is_dataset(folder):
        return "holds something else: would be refused"
    if force:
        return _replacement(folder)
    return _refusal(folder, plan) or _progress(folder, plan)


def _replacement(folder: Path) -> str:
    """Say whether --force would replace the dataset in a folder."""
    try:
        check_clearable(folder)
    except UsageError as error:
        return f"would be refused: it {str(error).removeprefix(f'{folder} ')}"
    return "holds a dataset, which would be replaced"


def _refusal(folder: Path, plan: DatasetPlan) -> str:
    """Say what becomes of a dataset that is not the planned one; nothing if it is."""
    try:
        same = holds_plan(folder, plan)
    except UsageError:
        return "holds another dataset: would be refused without --force"
    except DatasetError:
        return "holds a dataset with a damaged plan: would be refused without --force"
    return "" if same else "holds a plan of which nothing was made: would be replaced"


def _progress(folder: Path, plan: DatasetPlan) -> str:
    """Say how far a dataset is."""
    todo, count = len(pending(folder, plan)), len(shards(plan))
    if todo == 0 and (folder / MANIFEST).is_file():
        return "complete already"
    return f"{count - todo} of {count} shards are there: would go on"


def size_text(number: int) -> str:
    """Write a number of bytes: ``"6.7 MB"``."""
    value, units = float(number), ["bytes", "kB", "MB", "GB", "TB"]
    while value >= 1000 and len(units) > 1:
        value, units = value / 1000, units[1:]
    return f"{value:.3g} {units[0]}" if units[0] != "bytes" else f"{number} bytes"
