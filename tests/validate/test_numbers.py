"""Checks of stored values: ranges, order, counts and statistics, each with a violated case."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.make.generation_options import GenerationOptions
from cnpgen.make.make_dataset import make_dataset
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask, load_dataset_spec, shards
from cnpgen.store.shard import read_shard
from cnpgen.store.shard_record import ShardRecord, load_record
from cnpgen.store.statistics import column_statistics
from cnpgen.validate.validate_rows import check_numbers
from tests.conftest import SHIPPED, TINY_SHARD, some, tiny_recipe

Columns = dict[str, np.ndarray]
Parts = tuple[DatasetSpec, ShardTask, Columns, ShardRecord]


def parts(folder: Path, index: int = 1) -> Parts:
    spec = load_dataset_spec(folder)
    task = shards(spec)[index]
    return spec, task, read_shard(folder / task.file), load_record(folder, task)


@pytest.fixture
def shard(tiny: Callable[[str], Path]) -> Parts:
    """Rows 250 to 499 of air-hockey replanning."""
    return parts(tiny("airhockey-replan"))


def changed(shard: Parts, name: str, where: Any, value: Any) -> list[str]:
    """Return the problems after a change that the statistics contain, too."""
    spec, task, columns, record = shard
    columns[name][where] = value
    return check_numbers(
        spec,
        task,
        columns,
        replace(record, statistics=column_statistics(columns, spec.fields)),
    )


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("dtype", some(["float64", "float32"], 1, "slow"))
def test_made_datasets_have_no_findings(tiny, tmp_path, name, dtype):
    folder = tiny(name)
    if dtype == "float32":
        folder = tmp_path / name
        make_dataset(
            tiny_recipe(name),
            folder,
            shard_size=TINY_SHARD,
            workers=1,
            options=GenerationOptions(dtype=dtype),
        )
    for index in range(4):
        assert check_numbers(*parts(folder, index)) == []


@pytest.mark.parametrize(
    ("name", "column"),
    [("start_q", 2), ("start_dq", 0), ("start_ddq", 5), ("goal_xyz", 1)],
)
@pytest.mark.parametrize("side", ["valid_min", "valid_max"])
def test_a_value_outside_its_range_is_named(shard, name, column, side):
    bound = getattr(shard[0].field_named(name), side)[column]
    outwards = 1 if side == "valid_max" else -1
    assert changed(shard, name, (17, column), bound + outwards * 1e-13) == []
    (problem,) = changed(shard, name, (17, column), bound + outwards * 1e-6)
    assert problem.startswith(f"{name} is outside its {side} by up to 1e-06 ")
    assert problem.endswith(": 1 of 250 rows, the first one is row 267")


def test_float32_values_may_exceed_a_bound_by_one_rounding_error(tmp_path):
    make_dataset(
        tiny_recipe("airhockey-replan"),
        tmp_path,
        shard_size=TINY_SHARD,
        workers=1,
        options=GenerationOptions(dtype="float32"),
    )
    shard = parts(tmp_path)
    height = np.float32(0.16)
    assert changed(shard, "goal_xyz", (3, 2), height) == []
    assert changed(shard, "goal_xyz", (3, 2), np.nextafter(height, np.float32(1))) == []
    assert len(changed(shard, "goal_xyz", (3, 2), height + np.float32(1e-6))) == 1


def test_a_hit_above_its_maximum_speed_is_named(shard):
    fastest = float(shard[2]["hit_speed_max"][7])
    (problem,) = changed(shard, "hit_speed", 7, np.nextafter(fastest, 9.0))
    assert (
        problem
        == "hit_speed is above hit_speed_max: 1 of 250 rows, the first one is row 257"
    )
    assert changed(shard, "hit_speed", 7, fastest) == []


def test_sample_ids_and_the_number_of_candidates_are_checked(shard):
    (first,) = changed(shard, "sample_id", 4, 3)
    assert first == "sample_id is not the index of the row in the split"
    shard[2]["sample_id"][4] = 254
    tried = shard[3].sampling.tried
    (second,) = changed(shard, "attempts", 4, shard[2]["attempts"][4] + 1)
    assert second == f"attempts sum to {tried + 1}, but {tried} candidates are recorded"


def test_statistics_must_be_those_of_the_values(shard):
    spec, task, columns, record = shard
    columns["hit_angle"][9] *= 0.99
    assert check_numbers(spec, task, columns, record) == [
        "the recorded statistics of hit_angle are not those of its values"
    ]


@pytest.mark.parametrize(
    ("what", "by", "wrong"),
    [("mean", 1e-12, 0), ("mean", 1e-6, 1), ("m2", 1e-12, 0), ("m2", 1e-6, 1)],
)
def test_sums_may_differ_by_rounding_errors_only(shard, what, by, wrong):
    spec, task, columns, record = shard
    item = record.statistics["hit_speed"]
    record = replace(
        record,
        statistics={
            **record.statistics,
            "hit_speed": replace(item, **{what: getattr(item, what) * (1 + by)}),
        },
    )
    assert len(check_numbers(spec, task, columns, record)) == wrong
