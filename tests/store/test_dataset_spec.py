"""The specification: round trip, identity and the list of shards."""

import json
import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.store.dataset_spec import (
    DatasetSpec,
    default_shard_size,
    from_json,
    load_dataset_spec,
    shard_attributes,
    shards,
    to_json,
    write_dataset_spec,
)
from cnpgen.store.field import Field
from cnpgen.store.files.documents import save_document
from tests.examples.store import SPEC
from tests.refusals import is_refused


def test_a_specification_round_trips_through_json_disk_and_pickle(
    tmp_path: Path,
) -> None:
    write_dataset_spec(tmp_path, SPEC)
    assert load_dataset_spec(tmp_path) == SPEC
    assert from_json(json.loads(json.dumps(to_json(SPEC)))) == SPEC
    assert pickle.loads(pickle.dumps(SPEC)).fingerprint == SPEC.fingerprint


def test_integer_limits_are_equal_after_reading(tmp_path: Path) -> None:
    field = Field("count", "1", "a number", valid_min=(0,), valid_max=(3,))
    spec = replace(SPEC, fields=(*SPEC.fields, field))
    write_dataset_spec(tmp_path, spec)
    assert load_dataset_spec(tmp_path) == spec


def test_the_seed_is_stored_as_text_because_json_numbers_of_other_readers_have_53_bits() -> (
    None
):
    assert to_json(SPEC)["seed"] == str(2**100 + 7)


@pytest.mark.parametrize("key", ["title", "license", "versions", "recipe"])
def test_settings_that_do_not_change_the_rows_do_not_change_the_fingerprint(
    key: str,
) -> None:
    other: dict[str, Any] = {
        key: {"cnpgen": "9"} if key in {"versions", "recipe"} else "other"
    }
    assert replace(SPEC, **other).fingerprint == SPEC.fingerprint


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
        {"fields": SPEC.fields[:2]},
        {"robot": {}},
    ],
)
def test_settings_that_change_the_bytes_change_the_fingerprint(
    change: dict[str, Any],
) -> None:
    assert replace(SPEC, **change).fingerprint != SPEC.fingerprint


def test_shards_partition_every_split_in_order_and_the_last_one_is_shorter() -> None:
    found = [
        (task.split, task.index, task.first_row, task.rows) for task in shards(SPEC)
    ]
    assert found == [
        ("train", 0, 0, 32),
        ("train", 1, 32, 18),
        ("validation", 0, 0, 10),
    ]
    assert shards(SPEC)[1].file == "train/shard-00001.h5"
    assert shards(SPEC)[1].sidecar == "train/shard-00001.json"


def test_an_empty_split_has_no_shards() -> None:
    assert {
        task.split
        for task in shards(replace(SPEC, splits={"train": 5, "validation": 0}))
    } == {"train"}


def test_a_larger_dataset_begins_with_the_shards_of_a_smaller_one() -> None:
    small = shards(replace(SPEC, splits={"train": 64}))
    large = shards(replace(SPEC, splits={"train": 1000}))
    assert large[: len(small)] == small


@pytest.mark.parametrize(
    ("rows", "size"),
    [
        (0, 8192),
        (1, 8192),
        (120_000, 8192),
        (500_000, 32768),
        (10**6, 65536),
        (10**8, 65536),
    ],
)
def test_default_shard_sizes_are_powers_of_two_within_bounds(
    rows: int, size: int
) -> None:
    assert default_shard_size(rows) == size


@pytest.mark.parametrize(
    ("rows", "size"), [(1, 64), (300, 64), (5000, 256), (120_000, 1024)]
)
def test_default_shards_of_expensive_samples_are_small(rows: int, size: int) -> None:
    assert default_shard_size(rows, block_rows=64) == size


def test_120000_rows_make_15_shards() -> None:
    splits = {"train": 112_000, "validation": 8_000}
    assert (
        len(
            shards(
                replace(
                    SPEC,
                    splits=splits,
                    shard_size=default_shard_size(120_000),
                    block_rows=4096,
                )
            )
        )
        == 15
    )


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
        ({"fields": SPEC.fields + SPEC.fields[:1]}, "different names"),
    ],
)
def test_invalid_specifications_are_refused(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        replace(SPEC, **change)


def test_an_unwritable_folder_is_a_machine_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_arguments: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "fsync", refuse)
    with is_refused(MachineError):
        write_dataset_spec(tmp_path / "new", SPEC)


def damage(action: Callable[[bytes], bytes], folder: Path) -> None:
    path = folder / "specification.json"
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
def test_damaged_specifications_are_refused_and_named(
    tmp_path: Path, action: Callable[[bytes], bytes]
) -> None:
    write_dataset_spec(tmp_path, SPEC)
    damage(action, tmp_path)
    with is_refused(DatasetError):
        load_dataset_spec(tmp_path)


def test_missing_newer_and_inconsistent_specifications_are_refused(
    tmp_path: Path,
) -> None:
    with is_refused(DatasetError):
        load_dataset_spec(tmp_path)
    path = tmp_path / "specification.json"
    save_document(path, {"format": "cnpgen-specification", "format_version": 4})
    with is_refused(DatasetError):
        load_dataset_spec(tmp_path)
    document = {
        "format": "cnpgen-specification",
        "format_version": 3,
        "fingerprint": SPEC.fingerprint,
    }
    for change in ({"fields": [{}]}, {"seed": "x"}, {"splits": 3}, {"shard_size": "x"}):
        save_document(path, document | to_json(SPEC) | change)
        with is_refused(DatasetError):
            load_dataset_spec(tmp_path)
    save_document(path, document | to_json(SPEC) | {"backend": "other"})
    with is_refused(DatasetError):
        load_dataset_spec(tmp_path)


@pytest.mark.parametrize(
    ("content", "version"),
    [('{"format": "cnpgen-plan", "format_version": 2}', "2"), ("{", "1 or 2")],
)
def test_a_folder_with_a_specification_of_an_older_format_is_refused(
    tmp_path: Path, content: str, version: str
) -> None:
    (tmp_path / "plan.json").write_text(content)
    message = rf"plan\.json has format version {version}, this cnpgen reads version 3 \(specification\.json\): make"
    with pytest.raises(DatasetError, match=message):
        load_dataset_spec(tmp_path)
    write_dataset_spec(tmp_path, SPEC)
    assert load_dataset_spec(tmp_path) == SPEC


def test_shard_attributes_identify_the_shard_and_the_seed() -> None:
    first, second = (shard_attributes(SPEC, task) for task in shards(SPEC)[:2])
    assert first["first_sample_id"] == 0
    assert second["first_sample_id"] == 32
    assert first["root_seed"] == str(2**100 + 7)
    other: DatasetSpec = replace(SPEC, seed=8)
    assert (
        shard_attributes(other, shards(other)[0])["specification_fingerprint"]
        != first["specification_fingerprint"]
    )


def test_unknown_fields_are_named_with_the_nearest_known_one() -> None:
    assert SPEC.field_named("goal_p").unit == "m"
    with is_refused(DatasetError, argument="fields"):
        SPEC.field_named("start_p_q")


@pytest.mark.parametrize(
    "recipe",
    [{}, {"pipeline": 1}, {"pipeline": {"problem": []}}, {"pipeline": {"stage": [1]}}],
)
def test_an_incomplete_recipe_is_refused_when_its_problem_or_stages_are_read(
    recipe: dict[str, Any],
) -> None:
    spec = replace(SPEC, recipe=recipe)
    with is_refused(DatasetError):
        _ = spec.problem
    with is_refused(DatasetError):
        _ = spec.stages
