"""Shards: round trip, reproducible bytes and detection of damage."""

import json
import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, MachineError
from cnpgen.store.dataset_spec import shard_attributes, shards
from cnpgen.store.field import Field
from cnpgen.store.shard import (
    read_attributes,
    read_schema,
    read_shard,
    storage_dtype,
    write_shard,
)
from tests.examples.store import FIELDS, SPEC, make_columns
from tests.refusals import is_refused

TASK = shards(SPEC)[0]
ATTRIBUTES = shard_attributes(SPEC, TASK)


def write(path: Path, *, dtype: str = "float64", **changes: NDArray[Any]) -> int:
    return write_shard(
        path, make_columns(TASK, dtype) | changes, FIELDS, ATTRIBUTES, dtype=dtype
    )


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_shards_round_trip(tmp_path: Path, dtype: str) -> None:
    path = tmp_path / "train" / "shard-00000.h5"
    size = write(path, dtype=dtype)
    assert size == path.stat().st_size
    expected = make_columns(TASK, dtype)
    found = read_shard(path)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        assert np.array_equal(found[name], values)
    assert list(read_shard(path, ["clearance", "start_q"])) == ["clearance", "start_q"]
    assert read_shard(path, []) == {}
    assert list(path.parent.iterdir()) == [path]


def test_attributes_describe_the_file_and_its_fields(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write(path)
    assert read_attributes(path) == {
        "format": "cnpgen-shard",
        "format_version": 2,
        **ATTRIBUTES,
    }
    assert read_attributes(path, ["rows", "split"]) == {"rows": 32, "split": "train"}
    schema = read_schema(path)
    start, goal = schema["start_q"].attributes, schema["goal_p"].attributes
    assert schema["start_q"].shape == (32, 3)
    assert schema["start_q"].dtype == np.dtype("<f8")
    assert (start["units"], start["role"], start["long_name"]) == (
        "rad",
        "input",
        "initial joint positions",
    )
    assert json.loads(start["names"]) == ["j1", "j2", "j3"]
    assert start["valid_max"].tolist() == [2.0, 2.0, 2.0]
    assert goal["frame"] == "world"
    assert "valid_max" not in goal


def test_numbers_are_stored_little_endian_in_the_dataset_s_type() -> None:
    assert storage_dtype(FIELDS[0], "float32") == np.dtype("<f4")
    assert storage_dtype(FIELDS[3], "float32") == np.dtype("<i8")
    with is_refused(DatasetError):
        storage_dtype(Field("a", "1", "a", dtype="complex64"), "float64")


def test_the_bytes_of_a_shard_do_not_depend_on_time_and_place(tmp_path: Path) -> None:
    first, second = tmp_path / "a.h5", tmp_path / "other" / "b.h5"
    write(first)
    time.sleep(1.1)  # HDF5 stores times in seconds
    write(second)
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"start_q": np.zeros((32, 2))},
            r"'start_q' must be float64 of shape \(32, 3\), got float64 of shape \(32, 2\)",
        ),
        ({"clearance": np.zeros((32, 1))}, "clearance"),
        ({"clearance": np.zeros(31)}, "clearance"),
        ({"clearance": np.zeros(32, np.float32)}, "float32"),
        ({"start_q": np.zeros((32, 3), ">f8")}, ">f8"),
        ({"sample_id": np.zeros(32)}, "int64"),
        ({"surprise": np.zeros(32)}, "surprise"),
        (
            {"clearance": np.array([0.0] * 30 + [np.nan, 0.0])},
            "not finite in 1 rows, first in row 30",
        ),
        (
            {"start_q": np.full((32, 3), np.inf)},
            "not finite in 32 rows, first in row 0",
        ),
    ],
)
def test_columns_that_do_not_fit_are_refused(
    tmp_path: Path, changes: dict[str, NDArray[Any]], message: str
) -> None:
    with pytest.raises(DatasetError, match=message):
        write(tmp_path / "a.h5", **changes)
    assert not list(tmp_path.iterdir())


def test_missing_columns_and_shards_without_rows_are_refused(tmp_path: Path) -> None:
    columns = make_columns(TASK)
    del columns["goal_p"]
    with is_refused(DatasetError):
        write_shard(tmp_path / "a.h5", columns, FIELDS, ATTRIBUTES)
    nothing = {name: values[:0] for name, values in make_columns(TASK).items()}
    with is_refused(DatasetError):
        write_shard(tmp_path / "a.h5", nothing, FIELDS, ATTRIBUTES | {"rows": 0})


def test_a_full_disk_leaves_neither_shard_nor_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with is_refused(MachineError):
        write_shard(
            tmp_path / "shard-00000.h5",
            make_columns(TASK),
            FIELDS,
            ATTRIBUTES,
            work=tmp_path / "_work",
        )
    assert [path.name for path in tmp_path.rglob("*")] == ["_work"]


def test_a_shard_that_cannot_be_read_after_writing_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bytes = Path.write_bytes
    monkeypatch.setattr(
        Path,
        "write_bytes",
        lambda self, content: write_bytes(self, bytes(content)[:-100]),
    )
    with pytest.raises(DatasetError, match="damaged or cut off"):
        write(tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "action",
    [
        lambda old: b"",
        lambda old: old[:1000],
        lambda old: old[:-1],
        lambda old: bytes(100) + old[100:],
    ],
    ids=["empty", "truncated", "one byte short", "overwritten"],
)
@pytest.mark.parametrize("read", [read_shard, read_attributes, read_schema])
def test_damaged_shards_are_refused_by_name(
    tmp_path: Path, action: Callable[[bytes], bytes], read: Callable[[Path], object]
) -> None:
    path = tmp_path / "shard-00000.h5"
    write(path)
    path.write_bytes(action(path.read_bytes()))
    # The HDF5 library words what follows.
    with pytest.raises(
        DatasetError, match=r"shard-00000.h5 is (damaged or cut|not an)"
    ):
        read(path)


def test_missing_shards_and_fields_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "shard-00000.h5"
    with is_refused(DatasetError):
        read_shard(path)
    write(path)
    with is_refused(DatasetError):
        read_shard(path, ["start_dq"])


def test_an_unreadable_shard_is_a_machine_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_arguments: object, **_options: object) -> None:
        raise PermissionError(13, "Permission denied")

    write(tmp_path / "a.h5")
    monkeypatch.setattr(h5py, "File", refuse)
    with is_refused(MachineError):
        read_shard(tmp_path / "a.h5")


@pytest.mark.slow
def test_several_processes_read_the_same_shard_at_the_same_time(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write(path)
    expected = make_columns(TASK)["start_q"].sum()
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        found = pool.map(read_shard, [path] * 4)
    assert [item["start_q"].sum() for item in found] == [expected] * 4
