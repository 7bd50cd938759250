"""Extension of datasets: new shards are added, existing shards stay unchanged."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from cnpgen.errors import DatasetError, UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.machine.engine import Engine
from cnpgen.make.dataset_documents import dataset_documents
from cnpgen.make.generation_options import Begin
from cnpgen.make.make_dataset import MadeDataset, Progress, delete_shards, run
from cnpgen.make.make_shards import Job, prepare
from cnpgen.make.recipe import DatasetRecipe, makes_its_rows, restored, split_rows
from cnpgen.make.resolve_spec import MAX_ROWS
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.schema.texts import read_own, utf8_text
from cnpgen.store.dataset_spec import DatasetSpec, write_dataset_spec
from cnpgen.store.files.atomic import check_writable
from cnpgen.store.files.leftovers import remove_leftovers
from cnpgen.store.intact import RERUN_HINT
from cnpgen.store.layout import SPECIFICATION, WORK
from cnpgen.store.paths import require_dataset
from cnpgen.store.shard_record import pending
from cnpgen.store.workspace import check_place, find_workspace


@checked_arguments
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
    """Add rows to a dataset, or continue an interrupted extension.

    Every split grows in the proportion of the recipe; the rows are those of a dataset
    of ``n`` rows. Existing shards stay unchanged, including a short last one. Documents
    and statistics cover all rows afterwards. Until then the dataset is unfinished and
    has no manifest.

    Args:
        folder: Folder of the dataset.
        n: Final number of rows over all splits.
        workers: Number of processes; this and the following arguments as for
            ``make_dataset``.
        engine: Engine that runs the workers.
        address: Address of a cluster.
        begin: Callback before rows are compared and before they are generated.
        progress: Callback with the rows of every shard.

    Raises:
        UsageError: The folder does not exist or contains no dataset, the dataset has
            more rows or is unfinished, or this version of cnpgen or of its plug-ins
            generates other rows.
        DatasetError: The specification.json of the dataset is damaged.
        RecipeError: This version of cnpgen does not support the recipe in the
            specification.
        MachineError: The backend of the dataset does not work here, the disk is full,
            or a worker died.
    """
    where = Engine(engine, address, workers)
    n = integer("n", n, least=1, most=MAX_ROWS)
    folder = require_dataset(folder)
    begun = _begun(folder)
    # The recipe comes from the dataset itself: its file may have changed or be missing.
    with restored(begun) as recipe:
        extended = _extended(folder, begun, recipe, n)
        backend, cache_folder = choose_backend(begun.backend)
        job = Job(folder, extended, recipe.pipeline, backend, cache_folder)
        notes = _notes(folder)
        if extended is not begun:
            check_writable(folder)
            # Raises errors of this machine before anything is written.
            prepare(job)
            # The manifest goes first, so that the dataset counts as unfinished from the
            # new specification on.
            delete_shards(folder, ())
            write_dataset_spec(folder, extended)
        remove_leftovers(folder / WORK)
        return run(job, notes, engine=where, begin=begin, progress=progress)


def _begun(folder: Path) -> DatasetSpec:
    """Return the specification of the dataset in a writable folder."""
    workspace = find_workspace(folder)
    check_place(workspace)
    if workspace.spec is None:
        raise DatasetError(workspace.damage)
    return workspace.spec


def _extended(
    folder: Path, begun: DatasetSpec, recipe: DatasetRecipe, n: int
) -> DatasetSpec:
    """Return the specification of the extended dataset, or the present one if the rows are equal."""
    splits = split_rows(recipe, n)
    if splits == begun.splits:
        return begun
    # Rows are never removed.
    if any(splits.get(split, 0) < rows for split, rows in begun.splits.items()):
        raise UsageError(
            f"{folder} has {sum(begun.splits.values()):,} rows: choose a larger {{n}}, got {n:,}",
            remedies={"n": None},
        )
    if not makes_its_rows(recipe, begun):
        raise UsageError(
            f"{folder} was made by another version of cnpgen or of its plug-ins, and this version generates other rows"
        )
    if missing := pending(folder, begun):
        raise UsageError(
            f"{folder} is unfinished, it lacks {missing[0].file}: {RERUN_HINT}, then extend it"
        )
    return replace(
        begun, splits=splits, previous_splits=(*begun.previous_splits, begun.splits)
    )


def _notes(folder: Path) -> str:
    """Read the notes from the card, their only copy in a dataset."""
    for document in dataset_documents():
        # A missing card has no notes.
        with suppress(OSError, ValueError):
            text = utf8_text(
                read_own(folder / document.file, folder / SPECIFICATION, "a card")
            )
            if notes := document.notes(text):
                return notes
    return ""
