"""Making datasets: the plan, the pool of workers, the shards, the manifest."""

import hashlib
import warnings
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.library import load_dataset_recipe
from cnpgen.make_shard import Job, make_shard, versions
from cnpgen.outcome import Outcome
from cnpgen.pipelines.prepared import BLOCK_ROWS, PreparedPipeline
from cnpgen.recipes import DatasetRecipe, recipe_digest, resolved, split_rows
from cnpgen.store.layout import MANIFEST, PLAN
from cnpgen.store.manifest import finalize
from cnpgen.store.plan import DatasetPlan, ShardTask, default_shard_size, load_plan, shards
from cnpgen.store.record import pending
from cnpgen.store.workspace import clear_dataset, open_workspace

MAX_ROWS = 10**12
ALONE = {
    "compiled": 200_000,
    "numpy": 20_000,
    "casadi": 5_000,
}  # rows up to which a second process is not worth its start

Progress = Callable[[int, Outcome], None]  # called with the rows and the outcome of every shard that is finished
Begin = Callable[[Path, int, int], None]  # called once with the folder, the rows wanted and those already there


@dataclass(frozen=True)
class MadeDataset:
    """What ``make_dataset`` did.

    Attributes:
        folder: The dataset.
        plan: Its plan.
        made: Rows made by this call.
        complete: Whether every shard is there and the manifest is written.
    """

    folder: Path
    plan: DatasetPlan
    made: int
    complete: bool


def make_dataset(
    recipe: str | Path | DatasetRecipe,
    out: str | Path | None = None,
    *,
    n: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    shard_size: int | None = None,
    dtype: str = "float64",
    backend: str | None = None,
    force: bool = False,
    part: tuple[int, int] | None = None,
    begin: Begin | None = None,
    progress: Progress | None = None,
) -> MadeDataset:
    """Make a dataset, or finish one that was interrupted.

    Workers run on joblib: its default is one process per core; inside ``joblib.parallel_config(backend="dask")`` or
    any other registered backend they run there.

    Args:
        recipe: Name of a shipped dataset or pipeline, path of a recipe file, or a loaded recipe.
        out: Folder of the dataset; default ``NAME-vMAJOR`` in the current folder.
        n: Rows over all splits; default the recipe's. Fewer rows are the first of each split.
        seed: Root seed; default the recipe's.
        workers: Processes; default one per available core, or one where so few rows are missing that a second would
            not pay.
        shard_size: Rows per shard; default between 8192 and 65536.
        dtype: "float64" or "float32", what rows are stored as and validated as.
        backend: "compiled", "numpy" or "casadi"; default the fastest that works.
        force: Whether to delete another dataset that is in the folder.
        part: ``(k, m)``: make only every m-th shard, beginning with the k-th, for arrays of batch jobs; whoever finds
            all shards there finishes the dataset.
        begin: Called once with (folder, rows that this call is about, rows of them that are there already).
        progress: Called with (rows, outcome) of every finished shard.

    Raises:
        RecipeError: The recipe has mistakes.
        UsageError: An argument makes no sense, or the folder holds something else.
        MachineError: No working backend, a full disk, a dead worker; run again to go on.
        DatasetError: The plan in the folder is damaged.
    """
    _check(workers, part, force=force)
    loaded = recipe if isinstance(recipe, DatasetRecipe) else load_dataset_recipe(recipe)
    job = plan_dataset(
        loaded, out, n=n, seed=seed, shard_size=shard_size, dtype=dtype, backend=backend, resume=not force
    )
    if force:
        clear_dataset(job.folder)
    open_workspace(job.folder, job.plan)
    job = replace(job, plan=load_plan(job.folder))  # begun perhaps by another version: shards say what the plan says
    k, m = part or (0, 1)
    mine = shards(job.plan)[k::m]
    waiting = set(pending(job.folder, job.plan))
    tasks = [task for task in mine if task in waiting]
    if begin is not None:
        rows = sum(task.rows for task in mine)
        begin(job.folder, rows, rows - sum(task.rows for task in tasks))
    if workers is None and sum(task.rows for task in tasks) <= ALONE[job.backend]:
        workers = 1
    made = 0
    with closing(_run(job, tasks, worker_count(workers, len(tasks)))) as results:
        for rows, outcome in results:
            made += rows
            if progress is not None:
                progress(rows, outcome)
    complete = not pending(job.folder, job.plan)
    if complete and not (made == 0 and (job.folder / MANIFEST).exists()):
        finalize(job.folder, notes=_notes(loaded))
    return MadeDataset(job.folder, job.plan, made, complete)


def plan_dataset(
    recipe: str | Path | DatasetRecipe,
    out: str | Path | None = None,
    *,
    n: int | None = None,
    seed: int | None = None,
    shard_size: int | None = None,
    dtype: str = "float64",
    backend: str | None = None,
    resume: bool = False,
) -> Job:
    """Resolve what ``make_dataset`` would make, building its kernels but writing nothing of the dataset.

    With ``resume``, backend and shard size that are not given are those of the plan that is in the folder already.

    Raises:
        RecipeError: The recipe has mistakes.
        UsageError: An argument makes no sense.
        MachineError: No working backend.
    """
    loaded = recipe if isinstance(recipe, DatasetRecipe) else load_dataset_recipe(recipe)
    total = sum(loaded.splits.values()) if n is None else n
    if not 1 <= total <= MAX_ROWS:
        raise UsageError(f"n must be between 1 and {MAX_ROWS}, got {total}")
    folder = Path(out) if out is not None else Path(f"{loaded.name}-v{loaded.version.split('.')[0]}")
    if resume and (folder / PLAN).is_file():
        begun = load_plan(folder)
        backend = begun.backend if backend is None else backend
        shard_size = begun.shard_size if shard_size is None else shard_size
    chosen, cache_folder = choose_backend(backend)
    prepared = PreparedPipeline(loaded.pipeline, backend=chosen, cache_folder=cache_folder, dtype=dtype)
    plan = DatasetPlan(
        name=loaded.name,
        version=loaded.version,
        title=loaded.title,
        license=loaded.license,
        recipe_sha256=recipe_digest(loaded),
        recipe=resolved(loaded),
        seed=loaded.seed if seed is None else seed,
        splits=split_rows(loaded, total),
        shard_size=default_shard_size(total) if shard_size is None else shard_size,
        block_rows=BLOCK_ROWS,
        dtype=dtype,
        backend=chosen,
        fields=prepared.fields,
        robot=_robot_record(prepared),
        versions=versions(),
    )
    return Job(folder, plan, loaded.pipeline, chosen, cache_folder)


def _run(job: Job, tasks: list[ShardTask], workers: int) -> Generator[tuple[int, Outcome], None, None]:
    """Run the tasks and yield their results as they come."""
    if not tasks:
        return
    if workers == 1:
        for task in tasks:
            yield make_shard(job, task)
        return
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import BrokenProcessPool

    run = Parallel(n_jobs=workers, return_as="generator_unordered", pre_dispatch="2*n_jobs", batch_size=1)
    results = run(delayed(make_shard)(job, task) for task in tasks)
    try:
        for result in results:  # noqa: UP028 - closing this generator must not close that one noisily
            yield result
    except BrokenProcessPool as error:
        raise MachineError(
            f"a worker died (killed, or out of memory): the shards that are finished are safe in {job.folder};"
            " run the same command again to go on"
        ) from error
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that tasks under way are cancelled is the point
            results.close()


def worker_count(workers: int | None, tasks: int) -> int:
    """Decide how many processes share the tasks: what was asked for, else one per available core.

    Raises:
        UsageError: Fewer than one was asked for.
    """
    if workers is None:
        from joblib import effective_n_jobs

        return max(1, min(int(effective_n_jobs(-1)), tasks))  # of the backend that parallel_config names, if any
    if workers < 1:
        raise UsageError(f"workers must be at least 1, got {workers}")
    return max(1, min(workers, tasks))


def _check(workers: int | None, part: tuple[int, int] | None, *, force: bool) -> None:
    """Refuse arguments that make no sense before anything is touched."""
    if workers is not None and workers < 1:
        raise UsageError(f"workers must be at least 1, got {workers}")
    if part is not None and not (part[1] >= 1 and 0 <= part[0] < part[1]):
        raise UsageError(f"part must be K/M with 0 <= K < M, got {part[0]}/{part[1]}")
    if force and part is not None:
        raise UsageError("--force would delete what the other parts have made: remove the folder, then start the parts")


def _notes(recipe: DatasetRecipe) -> str:
    """Return the data card that is kept beside the dataset's recipe."""
    card = recipe.path.with_suffix(".md")
    return card.read_text(encoding="utf-8") if card.is_file() else ""


def _robot_record(prepared: PreparedPipeline) -> dict[str, Any]:
    robot = prepared.context.robot
    limits = {
        name: [float(x) for x in getattr(robot, name)]
        for name in ("position_lower", "position_upper", "velocity_limit", "acceleration_limit", "torque_limit")
    }
    urdf = robot.urdf.read_bytes()
    return {
        "name": robot.urdf.stem,
        "urdf_sha256": hashlib.sha256(urdf).hexdigest(),
        "urdf": urdf.decode(),
        "tip": robot.tip,
        "joint_names": list(robot.joint_names),
        "limits": limits,
    }
