"""Adding rows to a dataset: shards beside those that are there, which stay as they are."""

from dataclasses import replace
from pathlib import Path

from cnpgen.errors import DatasetError, UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.machine.engine import Engine
from cnpgen.make.blueprint import MAX_ROWS
from cnpgen.make.dataset import Begin, MadeDataset, Progress, carry_out
from cnpgen.make.load import makes_its_rows, restored
from cnpgen.make.recipe import DatasetRecipe, split_rows
from cnpgen.make.shards import Job, prepare
from cnpgen.schema.arguments import integer
from cnpgen.schema.texts import read_own, utf8_text
from cnpgen.store.blueprint import Blueprint, write_blueprint
from cnpgen.store.card import card_notes
from cnpgen.store.files.atomic import machine_error
from cnpgen.store.files.leftovers import sweep
from cnpgen.store.intact import AGAIN
from cnpgen.store.layout import CARD, MANIFEST, PLAN, WORK
from cnpgen.store.paths import require_folder
from cnpgen.store.record import pending
from cnpgen.store.workspace import check_place, find_workspace


def extend_dataset(
    folder: str | Path,
    n: int,
    *,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
    begin: Begin | None = None,
    progress: Progress | None = None,
) -> MadeDataset:
    """Add rows to a dataset, or go on with that after an interruption.

    Every split grows in the proportion of the recipe; the rows are those that a dataset of ``n`` rows would have.
    Shards that are there stay as they are, to the bit, a short last one, too; documents and statistics are of all rows
    afterwards. On the way the dataset is unfinished: it has no manifest.

    Args:
        folder: The dataset.
        n: Rows of all splits together afterwards.
        workers: Processes, as of ``make_dataset``, like all that follow.
        engine: Where they run.
        address: Of a cluster.
        begin: Called before rows are compared and before they are made.
        progress: Called with the rows of every shard.

    Raises:
        UsageError: There is no such folder, the dataset has more rows or is unfinished, or this version of cnpgen or of
            its plug-ins would make other rows.
        DatasetError: It holds no dataset, or its plan.json is damaged.
        RecipeError: The recipe in the blueprint does not fit this version of cnpgen.
        MachineError: The backend that made the dataset does not work here, a full disk, a dead worker.
    """
    where, folder, n = Engine(engine, address, workers), Path(folder), integer("n", n, least=1, most=MAX_ROWS)
    begun = _begun(folder)
    with restored(begun) as recipe:
        wanted = _extended(folder, begun, recipe, n)
        backend, cache_folder = choose_backend(begun.backend)
        job = Job(folder, wanted, recipe.pipeline, backend, cache_folder)
        notes = _notes(folder)
        if wanted is not begun:
            prepare(job)  # what does not work here is found before anything is touched
            _replace_blueprint(folder, wanted)
        sweep(folder / WORK)
        return carry_out(job, notes, engine=where, begin=begin, progress=progress)


def _begun(folder: Path) -> Blueprint:
    """Return the blueprint of the dataset in a folder that can be written."""
    require_folder(folder)
    workspace = find_workspace(folder)
    check_place(workspace)
    if workspace.blueprint is None:
        raise DatasetError(workspace.damage or f"{folder} holds no dataset")
    return workspace.blueprint


def _extended(folder: Path, begun: Blueprint, recipe: DatasetRecipe, n: int) -> Blueprint:
    """Return the blueprint of the extended dataset: the one that is there, if it has as many rows."""
    splits = split_rows(recipe, n)
    if splits == begun.splits:
        return begun
    if any(splits.get(split, 0) < rows for split, rows in begun.splits.items()):
        raise UsageError(f"{folder} has {sum(begun.splits.values()):,} rows: choose a larger n=, got {n:,}")
    if not makes_its_rows(recipe, begun):
        raise UsageError(
            f"{folder} was made by another version of cnpgen or of its plug-ins, and this one would make other rows"
        )
    if waiting := pending(folder, begun):
        raise UsageError(f"{folder} is unfinished, it lacks {waiting[0].file}: {AGAIN}, then extend it")
    return replace(begun, splits=splits, earlier=(*begun.earlier, begun.splits))


def _notes(folder: Path) -> str:
    """Read the notes in the card; they are nowhere else in a dataset."""
    try:
        return card_notes(utf8_text(read_own(folder / CARD, folder / PLAN, "a card")))
    except (OSError, ValueError):
        return ""


def _replace_blueprint(folder: Path, blueprint: Blueprint) -> None:
    """Write the new plan.json; the manifest, which is of the old one, goes first."""
    try:
        (folder / MANIFEST).unlink(missing_ok=True)
    except OSError as error:
        raise machine_error("delete", folder / MANIFEST, error) from error
    write_blueprint(folder, blueprint)
