"""Generation of shards: blocks, spot check by Pinocchio and Coal, commit."""

import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from cnpgen.arrays import Columns
from cnpgen.errors import MachineError
from cnpgen.kernels.library import Backend, choose_backend
from cnpgen.machine.versions import versions
from cnpgen.make.recipe import makes_its_rows, restored
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.prepared import Block, PreparedPipeline
from cnpgen.robots.scene import scene_poses
from cnpgen.schema.registry import group_of, package_of
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask
from cnpgen.store.field import Field
from cnpgen.store.manifest import source_date
from cnpgen.store.sampling_statistics import SamplingStatistics, merge_sampling
from cnpgen.store.scene_table import (
    OBSTACLE_POSES,
    SCENE_ID,
    SceneTable,
    concatenate_scenes,
)
from cnpgen.store.shard import storage_dtype
from cnpgen.store.shard_record import commit_shard
from cnpgen.store.workspace import require_dataset_spec

# Per shard, recomputed by Pinocchio and Coal before the commit.

MAX_SPOT_CHECK_ROWS = 32


@dataclass(frozen=True)
class Job:
    """Picklable input of a worker.

    Attributes:
        folder: Folder of the dataset.
        spec: Specification of the dataset.
        pipeline: Pipeline of the dataset; None to rebuild it from the specification,
            for workers without its files.
        backend: Backend of the kernels.
        cache_folder: Folder of compiled kernels; None for the default folder of the
            worker's machine.
        date: Date of all records, from SOURCE_DATE_EPOCH; None for the current time and
            durations.
    """

    folder: Path
    spec: DatasetSpec
    pipeline: Pipeline | None
    backend: Backend
    cache_folder: Path | None
    date: datetime | None = field(default_factory=source_date)


def prepare(job: Job) -> PreparedPipeline:
    """Prepare the pipeline of a job.

    Raise MachineError if this version of cnpgen generates other rows.
    """
    cache_folder = (
        choose_backend(job.backend)[1] if job.cache_folder is None else job.cache_folder
    )
    load = partial(
        PreparedPipeline,
        backend=job.backend,
        cache_folder=cache_folder,
        dtype=job.spec.dtype,
    )
    if job.pipeline is not None:
        return load(job.pipeline)
    with restored(job.spec) as recipe:
        if not makes_its_rows(recipe, job.spec):
            raise MachineError(
                f"{platform.node()} has another version of cnpgen, or of a plug-in, which generates other rows:"
                " install the same ones on all machines"
            )
        return load(recipe.pipeline)


def make_shards(
    job: Job, tasks: Sequence[ShardTask]
) -> Iterator[tuple[int, SamplingStatistics]]:
    """Generate, check and commit shards of one split, in order; yield rows and sampling statistics of each.

    The operation is idempotent.
    """
    started = _now(job)
    clock = time.perf_counter()
    prepared = _prepared(job)
    for task, (columns, sampling, scenes) in zip(
        tasks, shard_columns(prepared, job.spec, tasks), strict=True
    ):
        checked = replace(
            sampling, verification=spot_check(prepared, columns, job.spec, task, scenes)
        )
        # Before each commit: a replaced dataset must not receive shards of this one.
        require_dataset_spec(job.folder, job.spec)
        # With a fixed date the bytes of records must not depend on the machine's speed.
        seconds = 0.0 if job.date else round(time.perf_counter() - clock, 3)
        commit_shard(
            job.folder,
            job.spec,
            task,
            columns=columns,
            sampling=checked,
            scenes=scenes,
            started=started,
            seconds=seconds,
            versions=versions(),
        )
        started = _now(job)
        clock = time.perf_counter()
        yield task.rows, checked


def _now(job: Job) -> str:
    """Return the date of a job, or the time, in UTC to the second."""
    return (job.date or datetime.now(UTC)).isoformat(timespec="seconds")


def shard_columns(
    prepared: PreparedPipeline, spec: DatasetSpec, tasks: Sequence[ShardTask]
) -> Iterator[tuple[Columns, SamplingStatistics, SceneTable | None]]:
    """Compute the rows of shards of one split; every block is computed once.

    Yield the columns as stored, shape (rows, width) or (rows,), the sampling
    statistics, and the scenes or None.
    """
    chunks = _chunks(prepared, spec.seed, tasks)
    for task in tasks:
        parts: list[Block] = []
        while sum(part.columns["sample_id"].shape[1] for part in parts) < task.rows:
            parts.append(next(chunks))
        columns = stored_columns(parts, spec.fields, spec.dtype)
        tables = [
            part.scenes.astype(spec.dtype) for part in parts if part.scenes is not None
        ]
        scenes = concatenate_scenes(tables) if tables else None
        yield columns, merge_sampling([part.sampling for part in parts]), scenes


def _chunks(
    prepared: PreparedPipeline, seed: int, tasks: Sequence[ShardTask]
) -> Iterator[Block]:
    """Compute the blocks of shards in chunks of one shard each."""
    size = prepared.block_rows
    blocks = {index for task in tasks for index in blocks_of(task, size)}
    for index in sorted(blocks):
        begin = index * size
        ranges = [
            (
                # Rows of the shard relative to the block, clipped to it.
                max(task.first_row - begin, 0),
                min(task.first_row + task.rows - begin, size),
            )
            for task in tasks
            if index in blocks_of(task, size)
        ]
        yield from prepared.chunks(seed, tasks[0].split, index, ranges)


def blocks_of(task: ShardTask, size: int) -> range:
    """Return the indices of the blocks of ``size`` rows that overlap a shard."""
    return range(task.first_row // size, (task.first_row + task.rows - 1) // size + 1)


def stored_columns(
    parts: Sequence[Block], fields: Sequence[Field], dtype: str
) -> Columns:
    """Concatenate chunks to the stored values of their fields, shape (rows, width) or (rows,) each."""
    columns = {}
    for item in fields:
        rows = np.concatenate([part.columns[item.name] for part in parts], axis=1).T
        columns[item.name] = np.ascontiguousarray(
            rows if item.width else rows[:, 0], storage_dtype(item, dtype)
        )
    return columns


def spot_check(
    prepared: PreparedPipeline,
    columns: Columns,
    spec: DatasetSpec,
    task: ShardTask,
    scenes: SceneTable | None = None,
) -> dict[str, float]:
    """Recompute some rows of a shard with Pinocchio and Coal, to detect errors of the compiler or backend.

    Return the largest violation of every check, in its unit; raise MachineError if a
    row fails a check.
    """
    from cnpgen.judges.rows.verify import verify_rows

    # Rows are spread evenly, so that a few blocks do not stand for the whole shard.
    rows = np.unique(np.linspace(0, task.rows - 1, MAX_SPOT_CHECK_ROWS).astype(int))
    some = {name: values[rows] for name, values in columns.items()}
    if scenes is not None:
        table = scenes[scenes.rows_of(some[SCENE_ID])]
        some[OBSTACLE_POSES] = scene_poses(prepared.context.problem.obstacle, table)
    report = verify_rows(
        prepared.context.problem, prepared.context.robot, some, dtype=spec.dtype
    )
    if len(report.failed_rows):
        wrong = ", ".join(
            f"{check.name} {check.worst:.3g} {check.unit}" for check in report.failed
        )
        kinds = (*prepared.context.problem.constraint, *prepared.pipeline.stage)
        packages = sorted(
            {package_of(group_of(type(kind)), type(kind)) for kind in kinds} - {""}
        )
        plug_ins = (
            f"what {', '.join(packages)} samples or solves is not what it measures, or "
            if packages
            else ""
        )
        raise MachineError(
            f"row {task.first_row + rows[report.failed_rows[0]]} of split {task.split!r} fails Pinocchio's check"
            f" ({wrong}): {plug_ins}"
            f"the {spec.backend!r} backend computes wrong numbers on this machine; try another {{backend}}",
            remedies={"backend": None},
        )
    return {check.name: check.worst for check in report.checks}


_PREPARED: dict[str, PreparedPipeline] = {}


def _prepared(job: Job) -> PreparedPipeline:
    """Prepare the pipeline of a job once per process."""
    key = f"{job.spec.fingerprint} {job.cache_folder}"
    if key not in _PREPARED:
        # Only the last pipeline is kept in memory.
        _PREPARED.clear()
        _PREPARED[key] = prepare(job)
    return _PREPARED[key]
