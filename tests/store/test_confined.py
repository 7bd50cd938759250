"""A dataset whose documents were written by a forger under right seals: what they name is in the folder, or refused."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cnpgen.errors import CnpgenError, DatasetError, UsageError
from cnpgen.loader.load import load_dataset
from cnpgen.store.blueprint import load_blueprint, shards
from cnpgen.store.check import check_dataset
from cnpgen.store.files.documents import canonical_sha256
from cnpgen.store.inspection import inspect_dataset
from cnpgen.store.reader import open_dataset
from tests.examples.documents import rewritten
from tests.examples.store import BLUEPRINT, dataset  # noqa: F401 - a fixture

Change = Callable[[dict[str, Any]], None]


def first_shard(manifest: dict[str, Any]) -> dict[str, Any]:
    entry: dict[str, Any] = manifest["splits"]["train"]["shards"][0]
    return entry


def absolute(manifest: dict[str, Any]) -> None:
    first_shard(manifest)["file"] = "/etc/passwd"


def upwards(manifest: dict[str, Any]) -> None:
    first_shard(manifest)["sidecar"]["file"] = "../secret.json"


def elsewhere(manifest: dict[str, Any]) -> None:
    first_shard(manifest)["file"] = "validation/shard-00000.h5"


def more_rows(manifest: dict[str, Any]) -> None:
    first_shard(manifest)["rows"] = 10**12


def more_splits(manifest: dict[str, Any]) -> None:
    manifest["splits"]["test"] = manifest["splits"]["train"]


def fewer_shards(manifest: dict[str, Any]) -> None:
    del manifest["splits"]["train"]["shards"][0]


@pytest.mark.parametrize("change", [absolute, upwards, elsewhere, more_rows, more_splits, fewer_shards])
def test_a_manifest_names_the_shards_of_its_plan_and_no_other_file(dataset: Path, change: Change) -> None:  # noqa: F811
    rewritten(dataset / "manifest.json", change)
    for read in (open_dataset, load_dataset):
        with pytest.raises(DatasetError, match=r"manifest\.json lists other shards than plan\.json"):
            read(dataset)
    assert "lists other shards than plan.json" in {finding.problem for finding in check_dataset(dataset)}
    assert not inspect_dataset(dataset).complete


@pytest.mark.parametrize("name", ["train/shard-00000.h5", "train/shard-00000.json", "train"])
def test_a_link_out_of_the_folder_is_not_followed(dataset: Path, tmp_path: Path, name: str) -> None:  # noqa: F811
    outside = tmp_path / "outside"
    (dataset / name).rename(outside)
    (dataset / name).symlink_to(outside)
    found = [finding.file for finding in check_dataset(dataset) if "leads out of" in finding.problem]
    assert found
    assert all(file.startswith("train/shard-0000") for file in found)
    if name != "train/shard-00000.json":
        for read in (lambda: load_dataset(dataset).arrays("train"), lambda: open_dataset(dataset).read("train")):
            with pytest.raises(DatasetError, match="is a link that leads out of the dataset's folder"):
                read()


def test_a_link_within_the_folder_is_a_file(dataset: Path) -> None:  # noqa: F811
    (dataset / "train" / "shard-00000.h5").rename(dataset / "kept.h5")
    (dataset / "train" / "shard-00000.h5").symlink_to("../kept.h5")
    assert load_dataset(dataset).arrays("train")["start_q"].shape == (50, 3)
    assert [finding.file for finding in check_dataset(dataset)] == ["kept.h5"]


def many_shards(plan: dict[str, Any]) -> None:
    plan["splits"], plan["shard_size"] = {"train": 10**9}, 1


def wide_field(plan: dict[str, Any]) -> None:
    plan["fields"][0] |= {"width": 10**9, "names": [], "valid_min": None, "valid_max": None}


def fewer_limits(plan: dict[str, Any]) -> None:
    plan["fields"][0]["valid_min"] = [1.0]


def no_rows(plan: dict[str, Any]) -> None:
    plan["splits"] = {"train": -1}


def rows_in_words(plan: dict[str, Any]) -> None:
    plan["splits"] = {"train": "many"}


def path_as_split(plan: dict[str, Any]) -> None:
    plan["splits"] = {"../../train": 50}


@pytest.mark.parametrize("change", [many_shards, wide_field, fewer_limits, no_rows, rows_in_words, path_as_split])
def test_a_plan_that_no_dataset_has_is_refused_at_once(dataset: Path, change: Change) -> None:  # noqa: F811
    rewritten(dataset / "plan.json", change)
    begun = time.process_time()
    for read in (load_blueprint, open_dataset, load_dataset, inspect_dataset):
        with pytest.raises(DatasetError, match=r"plan\.json is damaged: "):
            read(dataset)
    assert [finding.file for finding in check_dataset(dataset)] == ["plan.json"]
    assert time.process_time() - begun < 1


def test_too_many_shards_are_refused_where_they_are_asked_for() -> None:
    with pytest.raises(UsageError, match=r"^1,000,000,000 shards of 1 rows are too many, .* a larger shard_size=$"):
        replace(BLUEPRINT, splits={"train": 10**9}, shard_size=1)


STATISTICS = "of other fields|must be of rows|must have|is missing|is damaged"


def other_columns(part: dict[str, Any]) -> None:
    for name in ("mean", "m2", "min", "max"):
        part["start_q"][name] = [0.0]
    del part["start_q"]["histogram"]


def uneven(part: dict[str, Any]) -> None:
    part["start_q"]["mean"] = [0.0]


def nobody(part: dict[str, Any]) -> None:
    part["start_q"]["count"] = 0


def ragged(part: dict[str, Any]) -> None:
    part["start_q"]["histogram"]["counts"][0] = [1]


def other_field(part: dict[str, Any]) -> None:
    part["x"] = part.pop("start_q")


@pytest.mark.parametrize("change", [other_columns, uneven, nobody, ragged, other_field])
def test_statistics_of_other_fields_are_refused(dataset: Path, change: Change) -> None:  # noqa: F811
    rewritten(dataset / "stats.json", lambda stats: change(stats["splits"]["train"]))
    with pytest.raises(DatasetError, match=rf"stats\.json.*({STATISTICS})"):
        load_dataset(dataset)
    task = shards(BLUEPRINT)[0]
    rewritten(dataset / task.sidecar, lambda record: change(record["statistics"]))
    found = inspect_dataset(dataset)
    assert len(found.summary.problems) == 1
    assert any(part in found.summary.problems[0] for part in STATISTICS.split("|"))


def test_a_forged_fingerprint_is_noticed(dataset: Path) -> None:  # noqa: F811
    rewritten(dataset / "plan.json", lambda plan: plan.update(fingerprint=canonical_sha256({})))
    with pytest.raises(CnpgenError, match="fingerprint does not match"):
        load_blueprint(dataset)
