"""Repair of datasets: find existing shards, find damaged ones, and delete them."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from cnpgen.errors import DatasetError
from cnpgen.store.checked_shard import Shard, read_rows
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask
from cnpgen.store.files.atomic import machine_errors
from cnpgen.store.layout import MANIFEST
from cnpgen.store.shard_record import check_committed

MAX_THREADS = 8


def existing_shards(folder: Path, tasks: Sequence[ShardTask]) -> list[ShardTask]:
    """List the existing shards: all of a finished dataset, otherwise those with a sidecar.

    Without a manifest, a shard without sidecar is unfinished, not lost: an interrupted run may leave it.
    """
    finished = (folder / MANIFEST).exists()
    return [task for task in tasks if finished or (folder / task.sidecar).exists()]


def find_damaged(
    folder: Path, spec: DatasetSpec, tasks: Sequence[ShardTask], *, progress: Callable[[int, None], None] | None = None
) -> dict[ShardTask, str]:
    """Compare existing shards with their sidecars and the specification; return damaged shard -> description, in order.

    Raises:
        MachineError: A file cannot be read.
    """
    damaged = {}
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_THREADS))  # sha256 releases the GIL
    try:
        for task, problem in zip(tasks, pool.map(partial(_problem, folder, spec), tasks), strict=True):
            if problem:
                damaged[task] = problem
            if progress is not None:
                progress(task.rows, None)
    finally:
        pool.shutdown(cancel_futures=True)
    return damaged


def _problem(folder: Path, spec: DatasetSpec, task: ShardTask) -> str:
    """Return a description of the damage of a shard; empty for an intact shard."""
    try:
        check_committed(folder, spec, task)
        read_rows(Shard(folder, spec, task))
    except DatasetError as error:
        return str(error)
    return ""


def delete_shards(folder: Path, tasks: Sequence[ShardTask]) -> None:
    """Delete shards and the manifest of a dataset, which is unfinished from then on.

    Raises:
        MachineError: A file cannot be deleted.
    """
    # First the manifest and the sidecars, which mark data as complete.
    for name in (MANIFEST, *(name for task in tasks for name in (task.sidecar, task.file))):
        with machine_errors("delete", folder / name):
            (folder / name).unlink(missing_ok=True)
