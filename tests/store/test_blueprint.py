"""The blueprint: round trip, identity and the list of shards."""

import json
import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.store.blueprint import (
    Blueprint,
    default_shard_size,
    from_json,
    load_blueprint,
    shard_attributes,
    shards,
    to_json,
    write_blueprint,
)
from cnpgen.store.field import Field
from cnpgen.store.files.documents import save_document
from tests.examples.store import BLUEPRINT


def test_a_blueprint_survives_json_disk_and_pickle(tmp_path: Path) -> None:
    write_blueprint(tmp_path, BLUEPRINT)
    assert load_blueprint(tmp_path) == BLUEPRINT
    assert from_json(json.loads(json.dumps(to_json(BLUEPRINT)))) == BLUEPRINT
    assert pickle.loads(pickle.dumps(BLUEPRINT)).fingerprint == BLUEPRINT.fingerprint


def test_limits_that_are_integers_in_python_are_the_same_after_reading(tmp_path: Path) -> None:
    field = Field("count", "1", "a number", valid_min=(0,), valid_max=(3,))
    blueprint = replace(BLUEPRINT, fields=(*BLUEPRINT.fields, field))
    write_blueprint(tmp_path, blueprint)
    assert load_blueprint(tmp_path) == blueprint


def test_the_seed_is_stored_as_text_because_json_numbers_of_other_readers_have_53_bits() -> None:
    assert to_json(BLUEPRINT)["seed"] == str(2**100 + 7)


@pytest.mark.parametrize("key", ["title", "license", "versions", "recipe"])
def test_what_does_not_change_the_rows_does_not_change_the_fingerprint(key: str) -> None:
    other: dict[str, Any] = {key: {"cnpgen": "9"} if key in {"versions", "recipe"} else "other"}
    assert replace(BLUEPRINT, **other).fingerprint == BLUEPRINT.fingerprint


@pytest.mark.parametrize(
    "change",
    [
        {"name": "other"},
        {"version": "2.0.0"},
        {"recipe_sha256": "ef" * 32},
        {"seed": 8},
        {"splits": {"train": 51, "validation": 10}},
        {"shard_size": 16},
        {"block_rows": 8},
        {"dtype": "float32"},
        {"backend": "compiled"},
        {"generator": "other"},
        {"fields": BLUEPRINT.fields[:2]},
        {"robot": {}},
    ],
)
def test_what_changes_the_bytes_changes_the_fingerprint(change: dict[str, Any]) -> None:
    assert replace(BLUEPRINT, **change).fingerprint != BLUEPRINT.fingerprint


def test_shards_cover_every_split_once_in_order_and_the_last_is_short() -> None:
    found = [(task.split, task.index, task.first_row, task.rows) for task in shards(BLUEPRINT)]
    assert found == [("train", 0, 0, 32), ("train", 1, 32, 18), ("validation", 0, 0, 10)]
    assert shards(BLUEPRINT)[1].file == "train/shard-00001.h5"
    assert shards(BLUEPRINT)[1].sidecar == "train/shard-00001.json"


def test_an_empty_split_has_no_shards() -> None:
    assert {task.split for task in shards(replace(BLUEPRINT, splits={"train": 5, "validation": 0}))} == {"train"}


def test_a_larger_dataset_begins_with_the_shards_of_a_smaller_one() -> None:
    small = shards(replace(BLUEPRINT, splits={"train": 64}))
    large = shards(replace(BLUEPRINT, splits={"train": 1000}))
    assert large[: len(small)] == small


@pytest.mark.parametrize(
    ("rows", "size"), [(0, 8192), (1, 8192), (120_000, 8192), (500_000, 32768), (10**6, 65536), (10**8, 65536)]
)
def test_default_shard_sizes_are_powers_of_two_within_bounds(rows: int, size: int) -> None:
    assert default_shard_size(rows) == size


@pytest.mark.parametrize(("rows", "size"), [(1, 64), (300, 64), (5000, 256), (120_000, 1024)])
def test_shards_of_slow_rows_are_small_so_that_interruptions_lose_little(rows: int, size: int) -> None:
    assert default_shard_size(rows, block_rows=64) == size


def test_120000_rows_make_15_shards() -> None:
    splits = {"train": 112_000, "validation": 8_000}
    assert len(shards(replace(BLUEPRINT, splits=splits, shard_size=default_shard_size(120_000), block_rows=4096))) == 15


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shard_size": 0}, "shard size"),
        ({"seed": -1}, "negative"),
        ({"dtype": "float16"}, "float16"),
        ({"splits": {"train": 0}}, "must have rows"),
        ({"splits": {"train": -1, "validation": 5}}, "must have rows"),
        ({"splits": {"../train": 1}}, "letters, digits"),
        ({"splits": {"_work": 1}}, "letters, digits"),
        ({"fields": ()}, "fields"),
        ({"fields": BLUEPRINT.fields + BLUEPRINT.fields[:1]}, "different names"),
    ],
)
def test_impossible_blueprints_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        replace(BLUEPRINT, **change)


def test_an_unwritable_folder_is_a_machine_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_arguments: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(MachineError, match="may write"):
        write_blueprint(tmp_path / "new", BLUEPRINT)


def damage(action: Callable[[bytes], bytes], folder: Path) -> None:
    path = folder / "plan.json"
    path.write_bytes(action(path.read_bytes()))


@pytest.mark.parametrize(
    "action",
    [
        lambda old: b"",
        lambda old: old[: len(old) // 2],
        lambda old: old.replace(b'"shard_size": 32', b'"shard_size": 33'),
    ],
    ids=["empty", "truncated", "flipped"],
)
def test_damaged_blueprints_are_refused_by_name(tmp_path: Path, action: Callable[[bytes], bytes]) -> None:
    write_blueprint(tmp_path, BLUEPRINT)
    damage(action, tmp_path)
    with pytest.raises(DatasetError, match=r"plan\.json is damaged"):
        load_blueprint(tmp_path)


def test_missing_newer_and_nonsensical_blueprints_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="missing"):
        load_blueprint(tmp_path)
    path = tmp_path / "plan.json"
    save_document(path, {"format": "cnpgen-plan", "format_version": 3})
    with pytest.raises(DatasetError, match="upgrade"):
        load_blueprint(tmp_path)
    document = {"format": "cnpgen-plan", "format_version": 1, "fingerprint": BLUEPRINT.fingerprint}
    for change in ({"fields": [{}]}, {"seed": "x"}, {"splits": 3}, {"shard_size": "x"}):
        save_document(path, document | to_json(BLUEPRINT) | change)
        with pytest.raises(DatasetError, match="damaged"):
            load_blueprint(tmp_path)
    save_document(path, document | to_json(BLUEPRINT) | {"backend": "other"})
    with pytest.raises(DatasetError, match="fingerprint"):
        load_blueprint(tmp_path)


def test_shard_attributes_tell_a_shard_from_its_neighbours_and_from_another_seed() -> None:
    first, second = (shard_attributes(BLUEPRINT, task) for task in shards(BLUEPRINT)[:2])
    assert first["first_sample_id"] == 0
    assert second["first_sample_id"] == 32
    assert first["root_seed"] == str(2**100 + 7)
    other: Blueprint = replace(BLUEPRINT, seed=8)
    assert shard_attributes(other, shards(other)[0])["plan_fingerprint"] != first["plan_fingerprint"]


def test_unknown_fields_are_named_with_the_nearest_known_one() -> None:
    assert BLUEPRINT.field_named("goal_p").unit == "m"
    with pytest.raises(DatasetError, match="did you mean 'start_q'"):
        BLUEPRINT.field_named("start_p_q")
