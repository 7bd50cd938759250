"""Going on with a dataset: what of it was made already, what of that is damaged, and taking the latter out."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from cnpgen.errors import DatasetError
from cnpgen.store.blueprint import Blueprint, ShardTask
from cnpgen.store.files.atomic import machine_error
from cnpgen.store.layout import MANIFEST
from cnpgen.store.record import check_committed

MOST_THREADS = 8


def made_already(folder: Path, tasks: Sequence[ShardTask]) -> list[ShardTask]:
    """List the shards that were made: all of a finished dataset, else those with a sidecar.

    Without a manifest a shard that has no sidecar is unfinished, not lost: a run that ends between the two leaves it.
    """
    finished = (folder / MANIFEST).exists()
    return [task for task in tasks if finished or (folder / task.sidecar).exists()]


def find_damaged(
    folder: Path,
    blueprint: Blueprint,
    tasks: Sequence[ShardTask],
    *,
    progress: Callable[[ShardTask], None] | None = None,
) -> dict[ShardTask, str]:
    """Compare shards with their sidecars, to the bit.

    Args:
        folder: The dataset's folder.
        blueprint: Its blueprint.
        tasks: Shards that were made.
        progress: Called with every shard that was compared.

    Returns:
        The damaged ones, in order, and why they are.

    Raises:
        MachineError: The system would not let us read something.
    """
    damaged = {}
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, MOST_THREADS))  # sha256 runs without Python's lock
    try:
        for task, problem in zip(tasks, pool.map(partial(_problem, folder, blueprint), tasks), strict=True):
            if problem:
                damaged[task] = problem
            if progress is not None:
                progress(task)
    finally:
        pool.shutdown(cancel_futures=True)
    return damaged


def _problem(folder: Path, blueprint: Blueprint, task: ShardTask) -> str:
    """Say what is wrong with a shard, or nothing."""
    try:
        check_committed(folder, blueprint, task)
    except DatasetError as error:
        return str(error)
    return ""


def discard(folder: Path, tasks: Sequence[ShardTask]) -> None:
    """Take shards out of a dataset, which is unfinished from then on.

    Raises:
        MachineError: The system would not let us delete them.
    """
    names = [MANIFEST, *(name for task in tasks for name in (task.sidecar, task.file))] if tasks else []
    for name in names:  # the manifest says that all is there, a sidecar that its shard is: they go first
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise machine_error("delete", folder / name, error) from error
