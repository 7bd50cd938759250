"""Making datasets: the blueprint, what is there already, sharing out the rest, the manifest."""

import operator
import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path

from cnpgen.errors import UsageError
from cnpgen.machine.engine import Engine, assembled
from cnpgen.make.blueprint import dataset_folder, draw_up
from cnpgen.make.certify import certified
from cnpgen.make.load import as_dataset_recipe, load_notes
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.make.shards import Job, make_shards
from cnpgen.pipelines.stages.stage import BLOCK_ROWS
from cnpgen.store.blueprint import Blueprint, ShardTask, shards
from cnpgen.store.check import check_documents
from cnpgen.store.fates import Fates
from cnpgen.store.intact import AGAIN
from cnpgen.store.layout import MANIFEST
from cnpgen.store.manifest import finalize, source_date
from cnpgen.store.mending import discard, find_damaged, made_already
from cnpgen.store.record import pending
from cnpgen.store.workspace import check_place, find_workspace, open_workspace

ALONE = {
    "compiled": 200_000,
    "numpy": 20_000,
    "casadi": 5_000,
}  # rows up to which a second process is not worth its start
RUN_BLOCKS = 8  # blocks that a worker makes shards from before it is given others
RUNS = 4  # at least, for every worker, where there are enough blocks: so that none waits long for the last one

Begin = Callable[[str, Path, int, int], None]  # called with "checking" or "making", the folder, the rows, those there
Progress = Callable[[int, Fates | None], None]  # called with the rows of a shard and, where it was made, its fates


@dataclass(frozen=True)
class MadeDataset:
    """What ``make_dataset`` did.

    Attributes:
        folder: The dataset.
        blueprint: Its blueprint.
        made: Rows made by this call.
        complete: Whether every shard is there and the manifest is written.
        rows: Split -> rows that this call was about: all, or those of its part.
        mended: Files that were damaged and are made again, documents that were missing and are written.
    """

    folder: Path
    blueprint: Blueprint
    made: int
    complete: bool
    rows: Mapping[str, int] = field(default_factory=dict)
    mended: tuple[str, ...] = ()


def make_dataset(
    recipe: str | Path | DatasetRecipe,
    out: str | Path | None = None,
    *,
    n: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
    shard_size: int | None = None,
    dtype: str = "float64",
    backend: str | None = None,
    certify: bool = False,
    model: str | Path | None = None,
    force: bool = False,
    part: tuple[int, int] | None = None,
    begin: Begin | None = None,
    progress: Progress | None = None,
) -> MadeDataset:
    """Make a dataset, or finish one that was interrupted.

    What is there already is compared with its recorded sha256; what is damaged is made again, after a warning.
    Workers are processes of this machine by default, or of a cluster (docs/scale.md): the bytes are the same.

    Args:
        recipe: Name of a shipped dataset or pipeline, path of a recipe file, or a loaded recipe.
        out: Folder of the dataset; default ``NAME-vMAJOR`` in the current folder.
        n: Rows over all splits; default the recipe's. Fewer rows are the first of each split.
        seed: Root seed; default the recipe's.
        workers: Processes; default one per available core, or one where so few rows are missing that a second would
            not pay; of a cluster as many as it has.
        engine: "loky": processes of this machine; "dask" or "ray": a cluster, whose workers see the same folder. By
            default loky, or the backend that ``joblib.parallel_config`` names.
        address: Of the cluster's scheduler or head; by default a cluster on this machine, for this call.
        shard_size: Rows per shard; default between 8192 and 65536, of certified datasets between 64 and 1024.
        dtype: "float64" or "float32", what rows are stored as and validated as.
        backend: "compiled", "numpy" or "casadi"; default the fastest that works.
        certify: Whether to plan every sample and keep those with a valid plan, with the plan (about 30 ms a sample).
        model: The planner whose plans certifying begins with, which takes half the time; by default it begins from
            nothing. Plans are judged in the same way; they differ by what solvers from different starts differ by.
        force: Whether to delete another dataset that is in the folder.
        part: ``(k, m)``: make only the k-th of m parts of the shards, counted from 0, for arrays of batch jobs; whoever
            finds all shards there finishes the dataset.
        begin: Called with ("checking", folder, rows that are there, 0) before rows are compared, if there are any, and
            with ("making", folder, rows that this call is about, rows of them that are there) before rows are made.
        progress: Called with (rows, fates) of every shard that was made, and (rows, None) of every one compared.

    Raises:
        RecipeError: The recipe has mistakes, or its data card cannot be read.
        UsageError: An argument makes no sense, SOURCE_DATE_EPOCH does not, or the folder holds something else.
        MachineError: No working backend, a full disk, a dead worker; run again to go on.
        DatasetError: The plan.json in the folder is damaged.
    """
    where = Engine(engine, address, workers)
    _check(part, force=force)
    loaded = as_dataset_recipe(recipe)
    if model is not None and not certify:
        raise UsageError("model= says where certifying begins: it needs certify=True")
    loaded = certified(loaded, model=model) if certify else loaded
    notes = load_notes(loaded)
    folder = dataset_folder(loaded, out)
    workspace = find_workspace(folder)
    check_place(workspace)
    job = draw_up(loaded, workspace, n=n, seed=seed, shard_size=shard_size, dtype=dtype, backend=backend, force=force)
    job = replace(job, blueprint=open_workspace(folder, job.blueprint, force=force))
    return carry_out(job, notes, engine=where, part=part, begin=begin, progress=progress)


def carry_out(
    job: Job,
    notes: str,
    *,
    engine: Engine,
    part: tuple[int, int] | None = None,
    begin: Begin | None = None,
    progress: Progress | None = None,
) -> MadeDataset:
    """Make what is missing of a dataset whose blueprint is written, and finish it if all of it is there then.

    Args:
        job: The dataset.
        notes: Its data card.
        engine: Where the work is shared out to.
        part: As of ``make_dataset``, like all that follow.
        begin: Called before rows are compared and before they are made.
        progress: Called with the rows of every shard.
    """
    mine = _part(shards(job.blueprint), part)
    waiting, damaged = _take_stock(job, mine, begin, progress)
    if begin is not None:
        rows = sum(task.rows for task in mine)
        begin("making", job.folder, rows, rows - sum(task.rows for task in waiting))
    made = _make(job, waiting, engine, progress)
    complete, documents = finish(job.folder, job.blueprint, notes, made=made, alone=part is None)
    rows_of = {split: sum(task.rows for task in mine if task.split == split) for split in job.blueprint.splits}
    return MadeDataset(job.folder, job.blueprint, made, complete, rows_of, (*damaged, *documents))


def _part(tasks: list[ShardTask], part: tuple[int, int] | None) -> list[ShardTask]:
    """Return one part of the shards; neighbours, which may share a block, stay together."""
    k, m = part or (0, 1)
    return tasks[k * len(tasks) // m : (k + 1) * len(tasks) // m]


def _take_stock(
    job: Job, tasks: list[ShardTask], begin: Begin | None, progress: Progress | None
) -> tuple[list[ShardTask], list[str]]:
    """Compare the shards that are there with their records; return those to be made, and which files were damaged."""
    there = made_already(job.folder, tasks)
    if there and begin is not None:
        begin("checking", job.folder, sum(task.rows for task in there), 0)
    damaged = find_damaged(
        job.folder,
        job.blueprint,
        there,
        progress=lambda task: progress(task.rows, None) if progress is not None else None,
    )
    if damaged:
        first = next(iter(damaged.values()))
        count = f"{len(damaged)} shards are damaged and are" if len(damaged) > 1 else "a shard is damaged and is"
        warnings.warn(f"{count} made again: {first}", RuntimeWarning, stacklevel=3)
        discard(job.folder, list(damaged))
    sound = set(there) - set(damaged)
    return [task for task in tasks if task not in sound], [task.file for task in damaged]


def _make(job: Job, tasks: list[ShardTask], engine: Engine, progress: Progress | None) -> int:
    """Make the shards; return their rows."""
    made = 0
    with closing(_results(job, tasks, engine)) as results:
        for rows, fates in results:
            made += rows
            if progress is not None:
                progress(rows, fates)
    return made


def _results(job: Job, tasks: list[ShardTask], engine: Engine) -> Generator[tuple[int, Fates], None, None]:
    """Make the shards and yield what became of them as they are committed."""
    if not tasks:
        return
    with assembled(engine, len(tasks), quick=is_quick(job.blueprint, tasks)) as team:
        groups = runs(job.blueprint, tasks, team.size)
        if team.size == 1 and not team.is_far:
            for group in groups:
                yield from make_shards(job, group)
            return
        theirs = _for_others(job) if team.is_far else job
        advice = f": the shards that are finished are safe in {job.folder}; {AGAIN} to go on"
        with closing(team.share_out(partial(_made, theirs), groups, advice=advice)) as results:
            for made in results:
                yield from made


def _for_others(job: Job) -> Job:
    """Return a job as a machine can do it that sees the same folder, but perhaps no other files of this one."""
    return replace(job, folder=job.folder.absolute(), pipeline=None, cache_folder=None)


def _made(job: Job, tasks: Sequence[ShardTask]) -> list[tuple[int, Fates]]:
    """Make the shards of a run; what a worker does."""
    return list(make_shards(job, tasks))


def is_quick(blueprint: Blueprint, tasks: list[ShardTask]) -> bool:
    """Whether one process makes the shards before a second one would have started; small blocks mean slow rows."""
    return blueprint.block_rows >= BLOCK_ROWS and sum(task.rows for task in tasks) <= ALONE[blueprint.backend]


def runs(blueprint: Blueprint, tasks: list[ShardTask], workers: int) -> list[list[ShardTask]]:
    """Group shards that one worker makes one after the other, so that blocks which they share are made once."""
    if blueprint.shard_size % blueprint.block_rows == 0:
        return [[task] for task in tasks]  # these share none
    blocks = RUN_BLOCKS
    if workers > 1:
        blocks = min(max(sum(task.rows for task in tasks) // (RUNS * workers * blueprint.block_rows), 1), blocks)
    rows = blueprint.block_rows * blocks
    return [list(group) for _, group in groupby(tasks, key=lambda task: (task.split, task.first_row // rows))]


def finish(folder: Path, blueprint: Blueprint, notes: str, *, made: int, alone: bool) -> tuple[bool, list[str]]:
    """Write the documents of a dataset whose shards are all there; return whether they are, and what was damaged.

    Args:
        folder: The dataset.
        blueprint: Its blueprint.
        notes: Its data card.
        made: Rows that this call has made.
        alone: Whether nobody else is making parts of it, who might be about to write the documents.
    """
    if pending(folder, blueprint):
        return False, []
    sealed, damaged = (folder / MANIFEST).exists(), list[str]()
    if made == 0 and (sealed or alone):
        findings = check_documents(folder, blueprint)
        if not findings:
            return True, []
        damaged = list(dict.fromkeys(finding.file for finding in findings))
        if sealed:  # without a manifest the dataset was unfinished: a run may have ended just before
            warnings.warn(f"written again: {findings[0]}", RuntimeWarning, stacklevel=3)
    finalize(folder, blueprint, notes=notes)
    return True, damaged


def _check(part: tuple[int, int] | None, *, force: bool) -> None:
    """Refuse arguments and an environment that make no sense before anything is touched."""
    if part is not None:
        _check_part(part)
    if force and part is not None:
        lost = "what the other parts have made"
        raise UsageError(f"force=True would delete {lost}: remove the folder, then start the parts")
    source_date()


def _check_part(part: tuple[int, int]) -> None:
    try:
        k, m = map(operator.index, part)
    except (TypeError, ValueError) as error:
        raise UsageError(f"part must be two integers (K, M) with 0 <= K < M, got {part!r}") from error
    if not 0 <= k < m:
        raise UsageError(f"part must be K/M with 0 <= K < M, got {k}/{m}")
