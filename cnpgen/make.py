"""Making datasets: the plan, the pool of workers, the shards, the manifest."""

import hashlib
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen import __version__
from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels.library import Backend, choose_backend
from cnpgen.library import load_dataset_recipe
from cnpgen.outcome import Outcome, merge_outcomes
from cnpgen.pipelines.prepared import BLOCK_ROWS, PreparedPipeline
from cnpgen.recipes import DatasetRecipe, Pipeline, recipe_digest, resolved, split_rows
from cnpgen.store.layout import MANIFEST, PLAN
from cnpgen.store.manifest import finalize
from cnpgen.store.plan import DatasetPlan, ShardTask, default_shard_size, load_plan, shards
from cnpgen.store.record import commit_shard, pending
from cnpgen.store.workspace import clear_dataset, open_workspace

SPOT_CHECKS = 32  # rows of every shard that Pinocchio and Coal recompute before it is written
MAX_ROWS = 10**12

Progress = Callable[[int, Outcome], None]  # called with the rows and the outcome of every shard that is finished
Begin = Callable[
    [Path, int, int], None
]  # called once with the folder, the rows wanted and those that are there already


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


@dataclass(frozen=True)
class Job:
    """Everything a worker needs, picklable.

    Attributes:
        folder: The dataset.
        plan: Its plan.
        pipeline: The recipe.
        backend: Which kernels run.
        cache_folder: Where they are cached.
    """

    folder: Path
    plan: DatasetPlan
    pipeline: Pipeline
    backend: Backend
    cache_folder: Path


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
        workers: Processes; default one per available core.
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
    loaded = recipe if isinstance(recipe, DatasetRecipe) else load_dataset_recipe(recipe)
    job = plan_dataset(
        loaded, out, n=n, seed=seed, shard_size=shard_size, dtype=dtype, backend=backend, resume=not force
    )
    if force and part is not None:
        raise UsageError("--force would delete what the other parts have made: remove the folder, then start the parts")
    if force:
        clear_dataset(job.folder)
    open_workspace(job.folder, job.plan)
    job = replace(job, plan=load_plan(job.folder))  # begun perhaps by another version: shards say what the plan says
    mine = _select(shards(job.plan), part)
    waiting = set(pending(job.folder, job.plan))
    tasks = [task for task in mine if task in waiting]
    if begin is not None:
        rows = sum(task.rows for task in mine)
        begin(job.folder, rows, rows - sum(task.rows for task in tasks))
    made = 0
    for rows, outcome in _run(job, tasks, worker_count(workers, len(tasks))):
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
        backend, shard_size = backend or begun.backend, shard_size or begun.shard_size
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


def shard_columns(
    prepared: PreparedPipeline, plan: DatasetPlan, task: ShardTask
) -> tuple[dict[str, NDArray[Any]], Outcome]:
    """Make the rows of a shard from its blocks.

    Returns:
        ``(columns, outcome)``: field name -> values as stored, shape (rows, width) or (rows,).
    """
    stop = task.first_row + task.rows
    parts, outcomes = [], []
    for index in range(task.first_row // BLOCK_ROWS, -(-stop // BLOCK_ROWS)):
        begin = index * BLOCK_ROWS
        block = prepared.block(
            plan.seed, task.split, index, first=max(task.first_row - begin, 0), stop=min(stop - begin, BLOCK_ROWS)
        )
        parts.append(block.columns)
        outcomes.append(block.outcome)
    columns: dict[str, NDArray[Any]] = {}
    for field in plan.fields:
        rows = np.concatenate([part[field.name] for part in parts], axis=1).T
        stored = np.ascontiguousarray(
            rows if field.width else rows[:, 0], "<i8" if field.dtype == "int64" else plan.dtype
        )
        columns[field.name] = stored
    return columns, merge_outcomes(outcomes)


def make_shard(job: Job, task: ShardTask) -> tuple[int, Outcome]:
    """Make, check and commit one shard; running it twice is harmless.

    Returns:
        Its rows and the fates of its draws.
    """
    started, clock = datetime.now(UTC).isoformat(timespec="seconds"), time.perf_counter()
    prepared = _prepared(job)
    columns, outcome = shard_columns(prepared, job.plan, task)
    worst = spot_check(prepared, columns, job.plan, task)
    outcome = replace(outcome, verification=worst)
    seconds = round(time.perf_counter() - clock, 3)
    commit_shard(
        job.folder,
        job.plan,
        task,
        columns=columns,
        outcome=outcome,
        started=started,
        seconds=seconds,
        versions=versions(),
    )
    return task.rows, outcome


def spot_check(
    prepared: PreparedPipeline, columns: dict[str, NDArray[Any]], plan: DatasetPlan, task: ShardTask
) -> dict[str, float]:
    """Recompute some rows with Pinocchio and Coal: a wrong compiler must not get a shard past this point.

    Returns:
        The worst violation of every check, in its unit.

    Raises:
        MachineError: A row is not what the kernels said it is.
    """
    from cnpgen.verify.rows import verify_rows

    rows = np.unique(np.linspace(0, task.rows - 1, SPOT_CHECKS).astype(int))
    some = {name: values[rows] for name, values in columns.items()}
    report = verify_rows(prepared.context.problem, prepared.context.robot, some, dtype=plan.dtype)
    if len(report.out):
        wrong = ", ".join(f"{check.name} {check.worst:.3g} {check.unit}" for check in report.failed)
        raise MachineError(
            f"row {task.first_row + rows[report.out[0]]} of split {task.split!r} fails Pinocchio's check ({wrong}):"
            f" the {plan.backend!r} backend computes wrong numbers on this machine; try another --backend"
        )
    return {check.name: check.worst for check in report.checks}


_PREPARED: dict[str, PreparedPipeline] = {}


def _prepared(job: Job) -> PreparedPipeline:
    """Load the stages once per process."""
    key = f"{job.plan.fingerprint} {job.cache_folder}"
    if key not in _PREPARED:
        _PREPARED.clear()
        _PREPARED[key] = PreparedPipeline(
            job.pipeline, backend=job.backend, cache_folder=job.cache_folder, dtype=job.plan.dtype
        )
    return _PREPARED[key]


def _run(job: Job, tasks: list[ShardTask], workers: int) -> Iterator[tuple[int, Outcome]]:
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
    try:
        yield from run(delayed(make_shard)(job, task) for task in tasks)
    except BrokenProcessPool as error:
        raise MachineError(
            f"a worker died (killed, or out of memory): the shards that are finished are safe in {job.folder};"
            " run the same command again to go on"
        ) from error


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


def _select(tasks: list[ShardTask], part: tuple[int, int] | None) -> list[ShardTask]:
    """Keep the tasks of one part of a job array."""
    if part is None:
        return tasks
    k, m = part
    if not (m >= 1 and 0 <= k < m):
        raise UsageError(f"part must be K/M with 0 <= K < M, got {k}/{m}")
    return tasks[k::m]


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


@cache
def versions() -> dict[str, str]:
    """Versions of cnpgen, Python and the libraries that make rows."""
    names = ("numpy", "casadi", "pin", "coal", "h5py", "joblib")
    machine = f"{platform.system()} {platform.machine()}"
    found = {"cnpgen": __version__, "python": platform.python_version(), "platform": machine}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
