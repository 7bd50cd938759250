"""Making shards: their blocks, the spot check by Pinocchio and Coal, the commit."""

import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import MachineError
from cnpgen.kernels.library import Backend, choose_backend
from cnpgen.machine.versions import versions
from cnpgen.make.load import makes_its_rows, restored
from cnpgen.pipelines.piece import Block
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.store.blueprint import Blueprint, ShardTask
from cnpgen.store.fates import Fates, merge_fates
from cnpgen.store.field import Field
from cnpgen.store.record import commit_shard
from cnpgen.store.shard import storage_dtype
from cnpgen.store.workspace import require_blueprint

SPOT_CHECKS = 32  # rows of every shard that Pinocchio and Coal recompute before it is written


@dataclass(frozen=True)
class Job:
    """Everything a worker needs, picklable.

    Attributes:
        folder: The dataset.
        blueprint: What it will hold.
        pipeline: The recipe; None where it is that of the blueprint: a worker elsewhere may not find its files.
        backend: Which kernels run.
        cache_folder: Where they are cached; None where the machine that makes them caches them.
    """

    folder: Path
    blueprint: Blueprint
    pipeline: Pipeline | None
    backend: Backend
    cache_folder: Path | None


def prepare(job: Job) -> PreparedPipeline:
    """Load the stages of what is made.

    Raises:
        MachineError: The backend does not work on this machine, or this version of cnpgen would make other rows.
    """
    cache_folder = choose_backend(job.backend)[1] if job.cache_folder is None else job.cache_folder
    load = partial(PreparedPipeline, backend=job.backend, cache_folder=cache_folder, dtype=job.blueprint.dtype)
    if job.pipeline is not None:
        return load(job.pipeline)
    with restored(job.blueprint) as recipe:
        if not makes_its_rows(recipe, job.blueprint):
            raise MachineError(
                f"{platform.node()} has another version of cnpgen, or of a plug-in, which would make other rows:"
                " install the same ones on all machines"
            )
        return load(recipe.pipeline)


def make_shards(job: Job, tasks: Sequence[ShardTask]) -> Iterator[tuple[int, Fates]]:
    """Make, check and commit shards of one split; running it twice is harmless.

    Args:
        job: What is made.
        tasks: The shards, in order; blocks that they share are made once.

    Yields:
        The rows of every shard and the fates of its draws, once it is committed.

    Raises:
        RecipeError: Practically no draw is accepted.
        MachineError: The disk or the backend fails.
        UsageError: The folder was given to another dataset meanwhile.
    """
    started, clock = datetime.now(UTC).isoformat(timespec="seconds"), time.perf_counter()
    prepared = _prepared(job)
    for task, (columns, fates) in zip(tasks, shard_columns(prepared, job.blueprint, tasks), strict=True):
        found = replace(fates, verification=spot_check(prepared, columns, job.blueprint, task))
        require_blueprint(job.folder, job.blueprint)
        seconds = round(time.perf_counter() - clock, 3)
        commit_shard(
            job.folder,
            job.blueprint,
            task,
            columns=columns,
            fates=found,
            started=started,
            seconds=seconds,
            versions=versions(),
        )
        started, clock = datetime.now(UTC).isoformat(timespec="seconds"), time.perf_counter()
        yield task.rows, found


def shard_columns(
    prepared: PreparedPipeline, blueprint: Blueprint, tasks: Sequence[ShardTask]
) -> Iterator[tuple[dict[str, NDArray[Any]], Fates]]:
    """Make the rows of shards of one split from its blocks, each of which is made once.

    Args:
        prepared: The stages.
        blueprint: The dataset.
        tasks: The shards, in order.

    Yields:
        ``(columns, fates)`` of every shard: field name -> values as stored, shape (rows, width) or (rows,), and the
        fates of the draws.
    """
    pieces = _pieces(prepared, blueprint.seed, tasks)
    for task in tasks:
        parts: list[Block] = []
        while sum(part.columns["sample_id"].shape[1] for part in parts) < task.rows:
            parts.append(next(pieces))
        columns = {
            field.name: _stored([part.columns[field.name] for part in parts], field, blueprint)
            for field in blueprint.fields
        }
        yield columns, merge_fates([part.fates for part in parts])


def _pieces(prepared: PreparedPipeline, seed: int, tasks: Sequence[ShardTask]) -> Iterator[Block]:
    """Make the blocks that shards have rows of, in pieces that belong to one shard each."""
    size = prepared.block_rows
    blocks = {index for task in tasks for index in blocks_of(task, size)}
    for index in sorted(blocks):
        begin = index * size
        ranges = [
            (max(task.first_row - begin, 0), min(task.first_row + task.rows - begin, size))
            for task in tasks
            if index in blocks_of(task, size)
        ]
        yield from prepared.pieces(seed, tasks[0].split, index, ranges)


def blocks_of(task: ShardTask, size: int) -> range:
    """List the blocks of ``size`` rows that a shard has rows of."""
    return range(task.first_row // size, (task.first_row + task.rows - 1) // size + 1)


def _stored(parts: list[NDArray[Any]], field: Field, blueprint: Blueprint) -> NDArray[Any]:
    """Join pieces of shape (width, rows) to what is stored of a field, shape (rows, width) or (rows,)."""
    rows = np.concatenate(parts, axis=1).T
    return np.ascontiguousarray(rows if field.width else rows[:, 0], storage_dtype(field, blueprint.dtype))


def spot_check(
    prepared: PreparedPipeline, columns: dict[str, NDArray[Any]], blueprint: Blueprint, task: ShardTask
) -> dict[str, float]:
    """Recompute some rows with Pinocchio and Coal: a wrong compiler must not get a shard past this point.

    Returns:
        The worst violation of every check, in its unit.

    Raises:
        MachineError: A row is not what the kernels said it is.
    """
    from cnpgen.judges.rows.verify import verify_rows

    rows = np.unique(np.linspace(0, task.rows - 1, SPOT_CHECKS).astype(int))
    some = {name: values[rows] for name, values in columns.items()}
    report = verify_rows(prepared.context.problem, prepared.context.robot, some, dtype=blueprint.dtype)
    if len(report.out):
        wrong = ", ".join(f"{check.name} {check.worst:.3g} {check.unit}" for check in report.failed)
        raise MachineError(
            f"row {task.first_row + rows[report.out[0]]} of split {task.split!r} fails Pinocchio's check ({wrong}):"
            f" the {blueprint.backend!r} backend computes wrong numbers on this machine; try another backend="
        )
    return {check.name: check.worst for check in report.checks}


_PREPARED: dict[str, PreparedPipeline] = {}


def _prepared(job: Job) -> PreparedPipeline:
    """Load the stages once per process."""
    key = f"{job.blueprint.fingerprint} {job.cache_folder}"
    if key not in _PREPARED:
        _PREPARED.clear()
        _PREPARED[key] = prepare(job)
    return _PREPARED[key]
