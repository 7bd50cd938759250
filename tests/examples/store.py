"""A small dataset for the tests of the store, and tests of its layout."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from cnpgen.store.dataset_spec import DatasetSpec, ShardTask, shards, write_dataset_spec
from cnpgen.store.field import Field
from cnpgen.store.sampling_statistics import DensityMap, SamplingStatistics
from cnpgen.store.shard_record import ShardRecord, commit_shard
from tests.examples.finalized import finalize

FIELDS = (
    Field(
        "start_q",
        "rad",
        "initial joint positions",
        3,
        ("j1", "j2", "j3"),
        valid_min=(-2.0,) * 3,
        valid_max=(2.0,) * 3,
    ),
    Field(
        "goal_p", "m", "goal of the tip", 2, ("x", "y"), role="context", frame="world"
    ),
    Field(
        "clearance",
        "m",
        "smallest distance",
        role="diagnostic",
        valid_min=(0.0,),
        valid_max=(1.0,),
    ),
    Field(
        "sample_id",
        "1",
        "index of the row in its split",
        role="diagnostic",
        dtype="int64",
    ),
)
SPEC = DatasetSpec(
    name="two-shards",
    version="1.0.0",
    title='A "small" dataset: for tests',
    license="CC-BY-4.0",
    recipe_sha256="ab" * 32,
    recipe={
        "name": "two-shards",
        "pipeline": {"name": "toy", "stage": [{"kind": "draw", "range": (0.1, 0.2)}]},
    },
    seed=2**100 + 7,
    splits={"train": 50, "validation": 10},
    shard_size=32,
    block_rows=16,
    backend="numpy",
    fields=FIELDS,
    robot={
        "name": "toy arm",
        "urdf_sha256": "cd" * 32,
        "joint_names": ["j1", "j2", "j3"],
    },
    versions={"cnpgen": "0.1.0", "python": "3.11.7"},
)


def make_columns(task: ShardTask, dtype: str = "float64") -> dict[str, NDArray[Any]]:
    """Return the rows of a shard, a pure function of the task; the y coordinate of the goal is constant."""
    random = np.random.default_rng([len(task.split), task.index])
    columns: dict[str, NDArray[Any]] = {
        "start_q": random.uniform(-2, 2, (task.rows, 3)),
        "goal_p": np.stack(
            [random.uniform(0.6, 2.0, task.rows), np.full(task.rows, 0.1)], axis=1
        ),
        "clearance": random.uniform(0, 1, task.rows),
    }
    columns = {name: values.astype(dtype) for name, values in columns.items()}
    return columns | {
        "sample_id": np.arange(task.first_row, task.first_row + task.rows)
    }


def make_sampling(task: ShardTask) -> SamplingStatistics:
    density = DensityMap(
        (0.6, 2.0), (-0.45, 0.45), np.full((4, 3), 2), np.full((4, 3), 1)
    )
    return SamplingStatistics(
        tried=2 * task.rows,
        accepted=task.rows,
        rejections={"no IK": task.rows - 1, "collision": 1},
        densities={"goal": density},
        verification={"plane": 1e-9 * (task.index + 1)},
    )


def make_shard(folder: Path, spec: DatasetSpec, task: ShardTask) -> ShardRecord:
    columns, sampling = make_columns(task, spec.dtype), make_sampling(task)
    return commit_shard(
        folder,
        spec,
        task,
        columns=columns,
        sampling=sampling,
        started=f"2026-11-21T02:02:0{2 + task.index}+01:00",
        seconds=0.5,
        versions=dict(spec.versions),
    )


def make_shards(folder: Path, spec: DatasetSpec = SPEC) -> None:
    write_dataset_spec(folder, spec)
    for task in shards(spec):
        make_shard(folder, spec, task)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """A finished dataset."""
    folder = tmp_path / "two-shards-v1"
    make_shards(folder)
    finalize(folder, SPEC, notes="Some notes.")
    return folder


def test_all_datasets_of_a_shard_are_at_the_root_and_have_the_same_leading_dimension(
    dataset: Path,
) -> None:
    for task in shards(SPEC):
        with h5py.File(dataset / task.file) as file:
            assert sorted(file) == sorted(field.name for field in FIELDS)
            for item in file.values():
                assert isinstance(item, h5py.Dataset)
                assert item.shape[0] == task.rows
                assert item.dtype.kind in "fi"


def test_values_are_contiguous_and_aligned_so_that_they_can_be_mapped_into_memory(
    dataset: Path,
) -> None:
    task = shards(SPEC)[0]
    expected = make_columns(task)
    with h5py.File(dataset / task.file) as file:
        found = {
            name: (item.id.get_offset(), item.dtype, item.shape)
            for name, item in file.items()
        }
        assert all(
            item.chunks is None and item.compression is None for item in file.values()
        )
    for name, (offset, dtype, shape) in found.items():
        assert offset % 64 == 0
        mapped = np.memmap(dataset / task.file, dtype, "r", offset, shape)
        assert np.array_equal(mapped, expected[name])


def test_a_finished_dataset_has_the_documented_files_and_no_others(
    dataset: Path,
) -> None:
    found = sorted(
        path.relative_to(dataset).as_posix()
        for path in dataset.rglob("*")
        if path.is_file()
    )
    made = [name for task in shards(SPEC) for name in (task.file, task.sidecar)]
    assert found == sorted(
        [
            *made,
            "README.md",
            "croissant.json",
            "manifest.json",
            "specification.json",
            "stats.json",
        ]
    )
    assert not (dataset / "_work").exists()


def test_no_file_depends_on_where_the_dataset_is_or_when_it_was_finished(
    tmp_path: Path, dataset: Path
) -> None:
    again = tmp_path / "elsewhere" / dataset.name
    make_shards(again, replace(SPEC))
    finalize(again, SPEC, notes="Some notes.")
    for path in dataset.rglob("*"):
        if path.is_file():
            assert (
                again / path.relative_to(dataset)
            ).read_bytes() == path.read_bytes(), path
