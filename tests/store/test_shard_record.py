"""Sidecars and sampling statistics: the commit record of a shard."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import DatasetError, MachineError
from cnpgen.store.check import check_dataset
from cnpgen.store.dataset_spec import shards, write_dataset_spec
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.sampling_statistics import (
    DensityMap,
    SamplingStatistics,
    merge_sampling,
    sampling_from_json,
)
from cnpgen.store.shard_record import (
    commit_shard,
    is_committed,
    load_committed,
    load_record,
    pending,
    record_to_json,
    save_record,
)
from tests.examples.finalized import finalize
from tests.examples.store import (
    SPEC,
    make_columns,
    make_sampling,
    make_shard,
    make_shards,
)
from tests.refusals import is_refused

TASK = shards(SPEC)[0]


def test_a_committed_shard_has_a_record_that_describes_it(tmp_path: Path) -> None:
    record = make_shard(tmp_path, SPEC, TASK)
    assert is_committed(tmp_path, SPEC, TASK)
    assert record_to_json(load_record(tmp_path, TASK)) == record_to_json(record)
    assert record.sha256 == file_sha256(tmp_path / "train/shard-00000.h5")
    assert record.bytes == (tmp_path / "train/shard-00000.h5").stat().st_size
    assert (record.rows, record.first_sample_id, record.seconds) == (32, 0, 0.5)
    assert record.statistics["start_q"].count == 32
    assert list(record.sampling.rejections) == ["no IK", "collision"]


def test_making_a_shard_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    first = make_shard(tmp_path, SPEC, TASK)
    (tmp_path / TASK.sidecar).unlink()
    assert make_shard(tmp_path, SPEC, TASK).sha256 == first.sha256


def test_a_committed_shard_and_its_sidecar_are_not_written_again(
    tmp_path: Path,
) -> None:
    make_shard(tmp_path, SPEC, TASK)
    before = [(tmp_path / name).stat().st_ino for name in (TASK.file, TASK.sidecar)]
    record = commit_shard(
        tmp_path,
        SPEC,
        TASK,
        columns=make_columns(TASK),
        sampling=make_sampling(TASK),
        seconds=9.0,
    )
    assert record.seconds == 0.5
    assert [
        (tmp_path / name).stat().st_ino for name in (TASK.file, TASK.sidecar)
    ] == before


def test_the_shard_is_there_before_its_sidecar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync, calls = os.fsync, iter(range(100))

    def full(descriptor: int) -> None:
        if next(calls) == 2:  # 0 and 1 flush the shard and its folder
            raise OSError(28, "No space left on device")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with is_refused(MachineError):
        make_shard(tmp_path, SPEC, TASK)
    assert [path.name for path in (tmp_path / "train").iterdir()] == ["shard-00000.h5"]
    assert not is_committed(tmp_path, SPEC, TASK)


def test_unusable_columns_leave_neither_shard_nor_sidecar(tmp_path: Path) -> None:
    columns = make_columns(TASK) | {"clearance": np.full(32, np.nan)}
    with is_refused(DatasetError):
        commit_shard(
            tmp_path, SPEC, TASK, columns=columns, sampling=make_sampling(TASK)
        )
    assert not list(tmp_path.rglob("*"))


@pytest.mark.parametrize(
    "flush",
    [0, 1, 2],
    ids=["the shard is flushed", "its folder is flushed", "its record is flushed"],
)
def test_a_run_that_finishes_the_dataset_does_not_stop_another_run_while_it_writes_a_shard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flush: int
) -> None:
    sync, calls = os.fsync, count()
    write_dataset_spec(tmp_path, SPEC)

    def meanwhile(descriptor: int) -> None:
        if next(calls) == flush:
            make_shards(tmp_path)
            finalize(tmp_path, SPEC)
        sync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", meanwhile)
        columns, sampling = make_columns(TASK), make_sampling(TASK)
        record = commit_shard(
            tmp_path, SPEC, TASK, columns=columns, sampling=sampling, seconds=9.0
        )  # the slower one
    assert record.sha256 == file_sha256(tmp_path / TASK.file)
    assert not list(tmp_path.rglob("*.tmp"))
    assert check_dataset(tmp_path) == []


@pytest.mark.parametrize("name", ["train/shard-00000.json", "train/shard-00000.h5"])
@pytest.mark.parametrize(
    "action",
    [lambda old: b"", lambda old: old[:-7], lambda old: old + b"\n"],
    ids=["empty", "truncated", "longer"],
)
def test_a_damaged_shard_or_sidecar_is_not_committed(
    tmp_path: Path, name: str, action: Callable[[bytes], bytes]
) -> None:
    make_shard(tmp_path, SPEC, TASK)
    (tmp_path / name).write_bytes(action((tmp_path / name).read_bytes()))
    assert not is_committed(tmp_path, SPEC, TASK)
    with pytest.raises(DatasetError, match=name.split("/")[1]):
        load_committed(tmp_path, SPEC, TASK)


def test_a_changed_digit_in_a_sidecar_is_detected(tmp_path: Path) -> None:
    make_shard(tmp_path, SPEC, TASK)
    path = tmp_path / TASK.sidecar
    path.write_bytes(path.read_bytes().replace(b'"tried": 64', b'"tried": 65'))
    with is_refused(DatasetError):
        load_record(tmp_path, TASK)


def test_missing_shards_and_shards_of_another_specification_are_not_committed(
    tmp_path: Path,
) -> None:
    assert not is_committed(tmp_path, SPEC, TASK)
    make_shard(tmp_path, SPEC, TASK)
    with is_refused(DatasetError):
        load_committed(tmp_path, replace(SPEC, seed=1), TASK)
    (tmp_path / TASK.file).unlink()
    assert not is_committed(tmp_path, SPEC, TASK)


def test_a_sidecar_of_another_shard_is_refused(tmp_path: Path) -> None:
    make_shards(tmp_path)
    (tmp_path / shards(SPEC)[1].sidecar).replace(tmp_path / TASK.sidecar)
    with is_refused(DatasetError):
        load_record(tmp_path, TASK)


def test_a_sidecar_without_its_keys_is_refused(tmp_path: Path) -> None:
    record = make_shard(tmp_path, SPEC, TASK)
    for change in ({"statistics": {"a": {}}}, {"sampling": {}}, {"sampling": 3}):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                "cnpgen.store.shard_record.record_to_json",
                lambda _, c=change: record_to_json(record) | c,
            )
            save_record(tmp_path, TASK, record)
        with is_refused(DatasetError):
            load_record(tmp_path, TASK)


def test_pending_lists_the_shards_that_are_not_committed(tmp_path: Path) -> None:
    assert pending(tmp_path, SPEC) == shards(SPEC)
    make_shards(tmp_path)
    assert pending(tmp_path, SPEC) == []
    (tmp_path / TASK.sidecar).unlink()
    assert pending(tmp_path, SPEC) == [TASK]


def test_sampling_statistics_round_trip_through_json() -> None:
    content: dict[str, Any] = make_sampling(TASK).to_json()
    assert sampling_from_json(json.loads(json.dumps(content))).to_json() == content


def test_merged_sampling_statistics_have_summed_counts_the_worst_violation_and_the_order_of_the_pipeline() -> (
    None
):
    grid = DensityMap(
        (0.0, 1.0), (0.0, 1.0), np.ones((2, 2), np.int64), np.zeros((2, 2), np.int64)
    )
    parts = [
        SamplingStatistics(
            tried=5, accepted=2, rejections={"a": 2, "c": 1}, verification={"g": 0.1}
        ),
        SamplingStatistics(
            tried=9,
            accepted=3,
            rejections={"a": 1, "b": 2, "c": 0, "d": 3},
            verification={"g": 0.3, "h": 0.2},
        ),
        SamplingStatistics(
            tried=2,
            accepted=1,
            rejections={"z": 1},
            densities={"goal": grid},
            verification={"g": 0.2},
        ),
        SamplingStatistics(tried=0, accepted=0, densities={"goal": grid}),
    ]
    merged = merge_sampling(parts)
    assert (merged.tried, merged.accepted) == (16, 6)
    assert list(merged.rejections.items()) == [
        ("z", 1),
        ("a", 3),
        ("b", 2),
        ("c", 1),
        ("d", 3),
    ]
    assert merged.verification == {"g": 0.3, "h": 0.2}
    assert merged.densities["goal"].candidates.tolist() == [[2, 2], [2, 2]]


def test_inconsistent_counts_and_non_finite_violations_are_refused() -> None:
    with is_refused(DatasetError):
        SamplingStatistics(tried=5, accepted=2, rejections={"a": 2})
    with is_refused(DatasetError):
        SamplingStatistics(tried=1, accepted=1, verification={"plane": float("nan")})


def test_density_maps_of_different_grids_are_not_merged() -> None:
    counts = np.zeros((2, 2), np.int64)
    a, b = (DensityMap((0.0, high), (0.0, 1.0), counts, counts) for high in (1.0, 2.0))
    with is_refused(DatasetError):
        a.merge(b)
