"""Small datasets for the tests of the loader: any number of rows, shards and splits, every row known by its number."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.batch import Batch
from cnpgen.store.blueprint import shards, write_blueprint
from cnpgen.store.manifest import finalize
from tests.examples.store import PLAN, make_columns, make_shard

ALL = ("start_q", "goal_p", "clearance", "sample_id")


def make(folder: Path, *, finished: bool = True, **changes: Any) -> Path:
    """Make the store's example with other splits, shards, seed or dtype."""
    plan = replace(PLAN, **changes)
    write_blueprint(folder, plan)
    for task in shards(plan):
        make_shard(folder, plan, task)
    if finished:
        finalize(folder, plan)
    return folder


def columns(split: str = "train", **changes: Any) -> dict[str, NDArray[Any]]:
    """All rows of a split of :func:`make`, from where they were drawn and not from any file."""
    plan = replace(PLAN, **changes)
    parts = [make_columns(task, plan.dtype) for task in shards(plan) if task.split == split]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def ids(batches: Iterable[Batch]) -> list[list[int]]:
    """The row numbers of every batch."""
    return [batch["sample_id"].tolist() for batch in batches]


def same(one: Batch, other: Batch) -> bool:
    """Whether two batches are equal to the bit."""
    return list(one) == list(other) and all(np.array_equal(one[name], other[name]) for name in one)
