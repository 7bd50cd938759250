"""Making one shard: its blocks, the spot check by Pinocchio and Coal, the commit."""

import platform
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen import __version__
from cnpgen.errors import MachineError
from cnpgen.kernels.library import Backend
from cnpgen.outcome import Outcome, merge_outcomes
from cnpgen.pipelines.prepared import BLOCK_ROWS, PreparedPipeline
from cnpgen.recipes import Pipeline
from cnpgen.store.plan import DatasetPlan, ShardTask
from cnpgen.store.record import commit_shard

SPOT_CHECKS = 32  # rows of every shard that Pinocchio and Coal recompute before it is written


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
