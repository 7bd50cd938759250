"""Forged documents with valid checksums: paths outside the folder of the dataset are refused."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cnpgen.errors import CnpgenError, DatasetError, UsageError
from cnpgen.loader.load import load_dataset
from cnpgen.store.check import check_dataset
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.files.documents import canonical_sha256
from cnpgen.store.inspection import inspect_dataset
from cnpgen.store.reader import open_dataset
from tests.examples.documents import rewritten
from tests.examples.store import SPEC, dataset  # noqa: F401 - a fixture
from tests.refusals import is_refused

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


@pytest.mark.parametrize(
    "change", [absolute, upwards, elsewhere, more_rows, more_splits, fewer_shards]
)
def test_a_manifest_with_other_files_than_the_shards_is_refused(
    dataset: Path,  # noqa: F811
    change: Change,
) -> None:
    rewritten(dataset / "manifest.json", change)
    for read in (open_dataset, load_dataset):
        with is_refused(DatasetError):
            read(dataset)
    assert "lists other shards than specification.json" in {
        finding.problem for finding in check_dataset(dataset)
    }
    assert not inspect_dataset(dataset).complete


@pytest.mark.parametrize(
    "name", ["train/shard-00000.h5", "train/shard-00000.json", "train"]
)
def test_a_link_out_of_the_folder_is_not_followed(
    dataset: Path,  # noqa: F811
    tmp_path: Path,
    name: str,
) -> None:
    outside = tmp_path / "outside"
    (dataset / name).rename(outside)
    (dataset / name).symlink_to(outside)
    found = [
        finding.file
        for finding in check_dataset(dataset)
        if "leads outside" in finding.problem
    ]
    assert found
    assert all(file.startswith("train/shard-0000") for file in found)
    if name != "train/shard-00000.json":
        for read in (
            lambda: load_dataset(dataset).arrays("train"),
            lambda: open_dataset(dataset).read("train"),
        ):
            with is_refused(DatasetError):
                read()


def test_a_link_within_the_folder_is_a_file(dataset: Path) -> None:  # noqa: F811
    (dataset / "train" / "shard-00000.h5").rename(dataset / "kept.h5")
    (dataset / "train" / "shard-00000.h5").symlink_to("../kept.h5")
    assert load_dataset(dataset).arrays("train")["start_q"].shape == (50, 3)
    assert [finding.file for finding in check_dataset(dataset)] == ["kept.h5"]


def many_shards(specification: dict[str, Any]) -> None:
    specification["splits"], specification["shard_size"] = {"train": 10**9}, 1


def wide_field(specification: dict[str, Any]) -> None:
    specification["fields"][0] |= {
        "width": 10**9,
        "names": [],
        "valid_min": None,
        "valid_max": None,
    }


def fewer_limits(specification: dict[str, Any]) -> None:
    specification["fields"][0]["valid_min"] = [1.0]


def no_rows(specification: dict[str, Any]) -> None:
    specification["splits"] = {"train": -1}


def rows_in_words(specification: dict[str, Any]) -> None:
    specification["splits"] = {"train": "many"}


def path_as_split(specification: dict[str, Any]) -> None:
    specification["splits"] = {"../../train": 50}


@pytest.mark.parametrize(
    "change",
    [many_shards, wide_field, fewer_limits, no_rows, rows_in_words, path_as_split],
)
def test_an_impossible_specification_is_refused_at_once(
    dataset: Path,  # noqa: F811
    change: Change,
) -> None:
    rewritten(dataset / "specification.json", change)
    begun = time.process_time()
    for read in (load_dataset_spec, open_dataset, load_dataset, inspect_dataset):
        with is_refused(DatasetError):
            read(dataset)
    assert [finding.file for finding in check_dataset(dataset)] == [
        "specification.json"
    ]
    assert time.process_time() - begun < 1


def test_too_many_shards_are_refused() -> None:
    with is_refused(UsageError, argument="shard_size"):
        replace(SPEC, splits={"train": 10**9}, shard_size=1)


STATISTICS = "of other fields|has other fields|must be of at least 1 row|must have|is missing|is damaged"


def other_columns(part: dict[str, Any]) -> None:
    for name in ("mean", "m2", "min", "max"):
        part["start_q"][name] = [0.0]
    del part["start_q"]["histogram"]


def uneven(part: dict[str, Any]) -> None:
    part["start_q"]["mean"] = [0.0]


def no_rows_in_statistics(part: dict[str, Any]) -> None:
    part["start_q"]["count"] = 0


def ragged(part: dict[str, Any]) -> None:
    part["start_q"]["histogram"]["counts"][0] = [1]


def other_field(part: dict[str, Any]) -> None:
    part["x"] = part.pop("start_q")


@pytest.mark.parametrize(
    "change", [other_columns, uneven, no_rows_in_statistics, ragged, other_field]
)
def test_statistics_of_other_fields_are_refused(dataset: Path, change: Change) -> None:  # noqa: F811
    rewritten(dataset / "stats.json", lambda stats: change(stats["splits"]["train"]))
    with is_refused(DatasetError):
        load_dataset(dataset)
    task = shards(SPEC)[0]
    rewritten(dataset / task.sidecar, lambda record: change(record["statistics"]))
    found = inspect_dataset(dataset)
    assert len(found.summary.problems) == 1
    assert any(part in found.summary.problems[0] for part in STATISTICS.split("|"))


def test_a_forged_fingerprint_is_detected(dataset: Path) -> None:  # noqa: F811
    forged = {"fingerprint": canonical_sha256({})}
    rewritten(
        dataset / "specification.json",
        lambda specification: specification.update(forged),
    )
    with is_refused(CnpgenError):
        load_dataset_spec(dataset)
