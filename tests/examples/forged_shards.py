"""Shards that are changed together with every checksum, count and statistic that would reveal the change."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from cnpgen.errors import CnpgenError
from cnpgen.store.dataset_spec import ShardTask, load_dataset_spec, shards
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.shard import read_shard
from cnpgen.store.shard_record import load_record, save_record
from cnpgen.store.statistics import column_statistics
from tests.examples.finalized import finalize


def task_of(folder: Path, file: str) -> ShardTask:
    return next(task for task in shards(load_dataset_spec(folder)) if task.file == file)


def edit(folder: Path, file: str, change: Callable[[h5py.File], None]) -> None:
    """Change a shard and every checksum, count and statistic that would reveal it."""
    task = task_of(folder, file)
    with h5py.File(folder / file, "r+") as shard:
        change(shard)
    record, spec = load_record(folder, task), load_dataset_spec(folder)
    columns, statistics = read_shard(folder / file), record.statistics
    if len(columns) == len(spec.fields) and all(
        np.isfinite(values).all() for values in columns.values()
    ):
        with suppress(
            CnpgenError, ValueError, IndexError, TypeError
        ):  # of other shapes
            statistics = column_statistics(columns, spec.fields)
    size, digest = (folder / file).stat().st_size, file_sha256(folder / file)
    save_record(
        folder, task, replace(record, bytes=size, sha256=digest, statistics=statistics)
    )
    finalize(folder, spec)
