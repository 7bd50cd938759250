"""Small datasets for the tests of the loader, with any number of rows, shards and splits and known row ids."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader.batch import Batch
from cnpgen.store.dataset_spec import shards, write_dataset_spec
from tests.examples.finalized import finalize
from tests.examples.store import SPEC, make_columns, make_shard

ALL = ("start_q", "goal_p", "clearance", "sample_id")


def make(folder: Path, *, finished: bool = True, **changes: Any) -> Path:
    """Make the example dataset with other splits, shards, seed or dtype."""
    spec = replace(SPEC, **changes)
    write_dataset_spec(folder, spec)
    for task in shards(spec):
        make_shard(folder, spec, task)
    if finished:
        finalize(folder, spec)
    return folder


def columns(split: str = "train", **changes: Any) -> dict[str, NDArray[Any]]:
    """Return all rows of a split of :func:`make`, without reading a file."""
    spec = replace(SPEC, **changes)
    parts = [
        make_columns(task, spec.dtype) for task in shards(spec) if task.split == split
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def ids(batches: Iterable[Batch]) -> list[list[int]]:
    """Return the row ids of every batch."""
    return [batch["sample_id"].tolist() for batch in batches]


def same(one: Batch, other: Batch) -> bool:
    """Return whether two batches are bitwise equal."""
    return list(one) == list(other) and all(
        np.array_equal(one[name], other[name]) for name in one
    )
