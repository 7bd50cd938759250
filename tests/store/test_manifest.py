"""Finishing a dataset: statistics, card, Croissant and, last, the manifest."""

import contextlib
import hashlib
import io
import json
import multiprocessing
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.store import manifest as manifest_module
from cnpgen.store.check import check_dataset
from cnpgen.store.dataset_spec import shards, write_dataset_spec
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.manifest import load_manifest
from cnpgen.store.shard_record import commit_shard
from tests.examples.finalized import finalize
from tests.examples.store import (
    FIELDS,
    SPEC,
    dataset,
    make_columns,
    make_sampling,
    make_shard,
    make_shards,
)
from tests.refusals import is_refused

__all__ = ["dataset"]


def test_the_manifest_describes_the_dataset(dataset: Path) -> None:
    manifest = load_manifest(dataset)
    assert manifest["name"] == "two-shards"
    assert manifest["pipeline"] == "toy"
    assert manifest["recipe"] == SPEC.recipe
    assert manifest["seed"] == str(SPEC.seed)
    assert manifest["specification_fingerprint"] == SPEC.fingerprint
    assert manifest["features"]["start_q"]["shape"] == [3]
    assert manifest["features"]["start_q"]["units"] == "rad"
    assert manifest["features"]["clearance"]["shape"] == []
    assert manifest["features"]["sample_id"]["dtype"] == "int64"
    assert manifest["yield"] == {
        "tried": 120,
        "accepted": 60,
        "rejections": {"no IK": 57, "collision": 3},
    }
    assert manifest["verification"] == {"plane": 2e-9}
    assert manifest["splits"]["train"]["rows"] == 50
    assert manifest["seconds"] == 1.5
    assert manifest["environments"] == [dict(SPEC.versions)]


def test_the_manifest_lists_every_other_file_with_its_digest(dataset: Path) -> None:
    manifest = load_manifest(dataset)
    listed = {name: entry["sha256"] for name, entry in manifest["files"].items()}
    for split in manifest["splits"].values():
        for entry in split["shards"]:
            listed |= {
                entry["file"]: entry["sha256"],
                entry["sidecar"]["file"]: entry["sidecar"]["sha256"],
            }
    found = {
        path.relative_to(dataset).as_posix()
        for path in dataset.rglob("*")
        if path.is_file()
    }
    assert found - {"manifest.json"} == listed.keys()
    assert all(file_sha256(dataset / name) == sha256 for name, sha256 in listed.items())


def test_the_fingerprint_equals_the_output_of_sha256sum(dataset: Path) -> None:
    command = "LC_ALL=C; export LC_ALL; sha256sum */shard-*.h5 | sha256sum"
    output = subprocess.run(
        command, shell=True, cwd=dataset, capture_output=True, text=True, check=True
    ).stdout
    assert load_manifest(dataset)["fingerprint"] == output.split()[0]


def test_stats_are_those_of_all_rows_of_a_split(dataset: Path) -> None:
    stats = json.loads((dataset / "stats.json").read_text())
    rows = np.concatenate(
        [
            make_columns(task)["start_q"]
            for task in shards(SPEC)
            if task.split == "train"
        ]
    )
    found = stats["splits"]["train"]["start_q"]
    np.testing.assert_allclose(found["mean"], rows.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found["std"], rows.std(axis=0), rtol=1e-12)
    assert found["count"] == 50
    assert stats["splits"]["train"]["goal_p"]["constant"] == [False, True]
    assert stats["splits"]["validation"]["start_q"]["count"] == 10
    assert stats["densities"]["train"]["goal"]["candidates"] == [[4] * 3] * 4


def test_finishing_twice_gives_the_same_files(dataset: Path) -> None:
    before = {path: path.read_bytes() for path in dataset.rglob("*") if path.is_file()}
    finalize(dataset, SPEC, notes="Some notes.")
    assert {
        path: path.read_bytes() for path in dataset.rglob("*") if path.is_file()
    } == before
    assert load_manifest(dataset)["created"] == "2026-11-21T01:02:03Z"


@pytest.mark.slow
def test_finishing_in_several_processes_at_once_gives_a_good_dataset(
    dataset: Path,
) -> None:
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        manifests = pool.starmap(finalize, [(dataset, SPEC)] * 9)
    assert check_dataset(dataset) == []
    assert manifests == [load_manifest(dataset)] * 9


def test_records_without_a_start_are_dated_by_the_clock_and_nonsense_is_refused(
    tmp_path: Path,
) -> None:
    spec = replace(SPEC, splits={"train": 10})
    task = shards(spec)[0]
    for started, good in (("", True), ("yesterday", False)):
        folder = tmp_path / str(good)
        write_dataset_spec(folder, spec)
        commit_shard(
            folder,
            spec,
            task,
            columns=make_columns(task),
            sampling=make_sampling(task),
            started=started,
        )
        if good:
            assert finalize(folder, spec)["created"].endswith("Z")
        else:
            with is_refused(DatasetError):
                finalize(folder, spec)


def test_the_creation_time_follows_source_date_epoch(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1763690000")
    assert finalize(dataset, SPEC)["created"] == "2025-11-21T01:53:20Z"
    first = (dataset / "manifest.json").read_bytes()
    finalize(dataset, SPEC)
    assert (dataset / "manifest.json").read_bytes() == first
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with is_refused(UsageError):
        finalize(dataset, SPEC)


def test_unfinished_datasets_are_refused_and_every_missing_shard_is_named(
    tmp_path: Path,
) -> None:
    write_dataset_spec(tmp_path, SPEC)
    make_shard(tmp_path, SPEC, shards(SPEC)[1])
    with pytest.raises(DatasetError) as caught:
        finalize(tmp_path, SPEC)
    assert (
        "1 of 3 shards are finished; run make_dataset or 'cnpgen make-dataset' again with the same arguments"
        in str(caught.value)
    )
    assert "train/shard-00000.json is missing" in str(caught.value)
    assert "validation/shard-00000.json is missing" in str(caught.value)
    assert "shard-00001" not in str(caught.value)
    assert not (tmp_path / "manifest.json").exists()


def test_a_long_list_of_missing_shards_is_cut_short(tmp_path: Path) -> None:
    with is_refused(DatasetError):
        finalize(tmp_path, replace(SPEC, splits={"train": 320}))


def test_shards_of_another_seed_and_cut_off_shards_are_refused(tmp_path: Path) -> None:
    make_shards(tmp_path)
    make_shard(tmp_path, replace(SPEC, seed=1), shards(SPEC)[0])
    path = tmp_path / shards(SPEC)[1].file
    path.write_bytes(path.read_bytes()[:-1])
    with is_refused(DatasetError):
        finalize(tmp_path, SPEC)


@pytest.mark.parametrize("step", ["save_document", "write_file", "_manifest"])
def test_a_finalize_that_is_killed_leaves_no_manifest(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    def killed(*_arguments: object, **_options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(manifest_module, step, killed)
    with pytest.raises(KeyboardInterrupt):
        finalize(dataset, SPEC)
    assert not (dataset / "manifest.json").exists()
    monkeypatch.undo()
    finalize(dataset, SPEC)
    assert (dataset / "manifest.json").exists()


def test_a_full_disk_while_finishing_is_a_machine_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    make_shards(tmp_path)
    monkeypatch.setattr("os.fsync", full)
    with is_refused(MachineError):
        finalize(tmp_path, SPEC)
    assert not (tmp_path / "manifest.json").exists()


@pytest.mark.parametrize(
    "damage", [b"", b"{", b'{"format": "cnpgen-dataset", "format_version": 2}\n']
)
def test_damaged_manifests_are_refused(dataset: Path, damage: bytes) -> None:
    (dataset / "manifest.json").write_bytes(damage)
    with is_refused(DatasetError):
        load_manifest(dataset)


def test_datasets_with_an_empty_split_are_finished_like_any_other(
    tmp_path: Path,
) -> None:
    spec = replace(SPEC, splits={"train": 20, "validation": 0})
    make_shards(tmp_path, spec)
    manifest = finalize(tmp_path, spec)
    assert manifest["splits"]["validation"]["shards"] == []
    assert "validation/*.h5" not in (tmp_path / "README.md").read_text()


def test_croissant_lists_the_files_of_a_record_set_of_each_split(dataset: Path) -> None:
    croissant = json.loads((dataset / "croissant.json").read_text())
    assert [item["name"] for item in croissant["recordSet"]] == list(SPEC.splits)
    assert croissant["license"] == "https://spdx.org/licenses/CC-BY-4.0"
    files = [
        item for item in croissant["distribution"] if item["@type"] == "cr:FileObject"
    ]
    assert [item["contentUrl"] for item in files] == [
        task.file for task in shards(SPEC)
    ]
    for item in files:
        content = (dataset / item["contentUrl"]).read_bytes()
        assert item["encodingFormat"] == "application/x-hdf5"
        assert item["contentSize"] == f"{len(content)} B"
        assert item["sha256"] == hashlib.sha256(content).hexdigest()


def test_croissant_contains_unit_and_limits_of_every_component(dataset: Path) -> None:
    croissant = json.loads((dataset / "croissant.json").read_text())
    vocabulary = croissant["@context"]["@vocab"]
    assert vocabulary == croissant["@context"]["sc"] == "https://schema.org/"
    variables = {item["name"]: item for item in croissant["variableMeasured"]}
    assert {item["@type"] for item in variables.values()} == {"sc:PropertyValue"}
    assert {name: item["unitText"] for name, item in variables.items()} == {
        name: unit
        for field in SPEC.fields
        for name, unit in zip(field.columns, field.units, strict=True)
    }
    start, clearance = variables["start_q.j2"], variables["clearance"]
    assert start["description"] == "initial joint positions"
    assert (start["minValue"], start["maxValue"]) == (-2.0, 2.0)
    assert (clearance["description"], clearance["minValue"]) == (
        "smallest distance",
        0.0,
    )
    without = variables["goal_p.x"].keys() | variables["sample_id"].keys()
    assert not {"minValue", "maxValue"} & without


def test_the_card_describes_fields_and_rejections(dataset: Path) -> None:
    card = (dataset / "README.md").read_text()
    assert card.startswith(
        '---\nlicense: "cc-by-4.0"\npretty_name: "A \\"small\\" dataset: for tests"\n'
    )
    assert (
        '  - split: train\n    path: "train/*.h5"\n  - split: validation\n    path: "validation/*.h5"\n---'
        in card
    )
    assert "\n\nSome notes.\n\n" in card
    for field in FIELDS:
        assert f"| `{field.name}` | {field.unit} |" in card
    assert "| no IK | 57 | 47.500 % |" in card
    assert "| `plane` | 2e-09 |" in card
    assert "| `start_q.j1` | rad |" in card
    assert "cnpgen validate . --deep" in card


def test_the_code_in_the_card_loads_the_dataset(dataset: Path) -> None:
    code = (dataset / "README.md").read_text().split("```python\n")[1].split("```")[0]
    names: dict[str, object] = {}
    with contextlib.chdir(dataset), contextlib.redirect_stdout(io.StringIO()):
        exec(code, names)
    rows = names["rows"]
    assert isinstance(rows, dict)
    assert rows["start_q"].shape == (50, 3)
    assert rows["sample_id"].tolist() == list(range(50))
