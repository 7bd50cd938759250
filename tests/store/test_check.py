"""Shallow check: every change of a dataset is found and named."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import pytest

from cnpgen.store.check import (
    REMAKE_HINT,
    REPLACE_HINT,
    Finding,
    check_content,
    check_dataset,
    check_documents,
)
from cnpgen.store.dataset_spec import shards, write_dataset_spec
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.files.documents import save_document
from cnpgen.store.intact import RERUN_HINT
from cnpgen.store.manifest import load_manifest
from tests.conftest import some
from tests.examples.finalized import finalize
from tests.examples.store import SPEC, dataset, make_shard, make_shards

__all__ = ["dataset"]

TASK = shards(SPEC)[0]
FILES = [
    "train/shard-00000.h5",
    "specification.json",
    "train/shard-00001.json",
    "manifest.json",
    "stats.json",
    "README.md",
    "croissant.json",
    "validation/shard-00000.h5",
]


def problems(folder: Path) -> dict[str, str]:
    """Return the problems, file by file."""
    return {item.file: item.problem for item in check_dataset(folder) if not item.note}


def test_a_huge_sparse_document_is_found_without_reading_it(dataset: Path) -> None:
    os.truncate(dataset / "README.md", 1 << 40)
    assert "has 1099511627776 bytes instead of" in problems(dataset)["README.md"]


def test_a_good_dataset_has_no_findings(dataset: Path) -> None:
    assert check_dataset(dataset) == []


@pytest.mark.parametrize("name", some(FILES, 3, "slow"))
@pytest.mark.parametrize("where", some([0.77, 0.0, 0.3, 1.0], 2))
def test_a_flipped_byte_in_any_file_is_found_and_named(
    dataset: Path, name: str, where: float
) -> None:
    content = bytearray((dataset / name).read_bytes())
    content[round(where * (len(content) - 1))] ^= 1
    (dataset / name).write_bytes(content)
    assert problems(dataset).keys() == {name}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    "action",
    some([lambda old: b"", lambda old: old[: len(old) // 2]], 1, "slow"),
    ids=["empty", "truncated"],
)
def test_empty_and_truncated_files_are_found_and_named(
    dataset: Path, name: str, action: Callable[[bytes], bytes]
) -> None:
    (dataset / name).write_bytes(action((dataset / name).read_bytes()))
    assert problems(dataset).keys() == {name}


def test_a_missing_description_for_catalogues_is_a_remark(dataset: Path) -> None:
    (dataset / "croissant.json").unlink()
    (finding,) = check_dataset(dataset)
    assert (finding.file, finding.note) == ("croissant.json", True)
    assert "missing" in finding.problem


@pytest.mark.parametrize("name", [name for name in FILES if name != "croissant.json"])
def test_missing_files_are_found_and_named(dataset: Path, name: str) -> None:
    (dataset / name).unlink()
    found = problems(dataset)
    assert found.keys() == {name}
    assert "missing" in found[name]


def test_a_byte_that_makes_hdf5_hang_is_found(dataset: Path) -> None:
    """HDF5 2.0 hangs when it reads texts of a damaged heap."""
    content = (dataset / TASK.file).read_bytes()
    for position in range(content.index(b"GCOL"), len(content), 401):
        (dataset / TASK.file).write_bytes(
            content[:position] + b"\xff" + content[position + 1 :]
        )
        if content[position] != 0xFF:
            assert problems(dataset).keys() == {TASK.file}


def test_a_shard_from_another_seed_is_named_as_such(
    tmp_path: Path, dataset: Path
) -> None:
    other = tmp_path / "other"
    make_shards(other, replace(SPEC, seed=5))
    shutil.copy(other / TASK.file, dataset / TASK.file)
    message = f"{TASK.file}: its root_seed is '5', expected '{SPEC.seed}' by specification.json"
    assert message in [str(item) for item in check_dataset(dataset)]
    shutil.copy(other / TASK.sidecar, dataset / TASK.sidecar)
    texts = [str(item) for item in check_dataset(dataset)]
    assert message in texts
    assert any(
        text.startswith(f"{TASK.sidecar}: belongs to another specification")
        for text in texts
    )
    assert {item.file for item in check_dataset(dataset)} == {TASK.file, TASK.sidecar}
    assert {item.hint for item in check_dataset(dataset)} == {REMAKE_HINT}
    (dataset / "manifest.json").unlink()
    assert {item.hint for item in check_dataset(dataset)} == {REMAKE_HINT}


def test_swapped_shards_are_found(dataset: Path) -> None:
    first, last = dataset / TASK.file, dataset / shards(SPEC)[-1].file
    content = first.read_bytes()
    shutil.copy(last, first)
    last.write_bytes(content)
    assert problems(dataset).keys() == {TASK.file, shards(SPEC)[-1].file}
    texts = [str(item) for item in check_content(dataset, SPEC, TASK)]
    assert any(
        "its split is 'validation', expected 'train' by specification.json" in text
        for text in texts
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda file: file["start_q"].attrs.__setitem__("units", "deg"),
            "field 'start_q' has units 'deg'",
        ),
        (
            lambda file: file["start_q"].attrs.__delitem__("valid_max"),
            "field 'start_q' has valid_max '(missing)'",
        ),
        (
            lambda file: file["start_q"].attrs.__setitem__("offset", 3),
            "field 'start_q' has offset",
        ),
        (lambda file: file.move("clearance", "margin"), "lacks the field 'clearance'"),
        (
            lambda file: file.move("clearance", "margin"),
            "has an unknown field 'margin'",
        ),
        (
            lambda file: file.attrs.__setitem__("first_sample_id", 3),
            "its first_sample_id is 3, expected 0 by specification.json",
        ),
    ],
)
def test_shards_that_contradict_the_specification_are_found(
    dataset: Path, change: Callable[[h5py.File], object], message: str
) -> None:
    with h5py.File(dataset / TASK.file, "r+") as file:
        change(file)
    texts = [str(item) for item in check_content(dataset, SPEC, TASK)]
    assert problems(dataset).keys() == {TASK.file}
    assert any(message in text for text in texts)


def test_a_shard_with_other_rows_or_types_is_found(dataset: Path) -> None:
    with h5py.File(dataset / TASK.file, "r+") as file:
        attributes = dict(file["clearance"].attrs)
        del file["clearance"]
        file.create_dataset("clearance", data=[0.0] * 31, dtype="<f4").attrs.update(
            attributes
        )
    texts = [str(item) for item in check_content(dataset, SPEC, TASK)]
    assert any(
        "'clearance' is float32 of shape (31,), not float64" in text for text in texts
    )


def test_files_that_do_not_belong_to_the_dataset_are_notes(dataset: Path) -> None:
    for name in ("notes.txt", "train/shard-00002.h5", "_work/x.tmp", "junk/a/b"):
        (dataset / name).parent.mkdir(parents=True, exist_ok=True)
        (dataset / name).write_text("")
    found = check_dataset(dataset)
    assert {item.file for item in found} == {
        "notes.txt",
        "train/shard-00002.h5",
        "junk",
    }
    assert {item.file for item in found if not item.note} == {
        "train/shard-00002.h5"
    }  # loaders would read it


def test_unfinished_datasets_are_reported_with_a_hint(tmp_path: Path) -> None:
    write_dataset_spec(tmp_path, SPEC)
    for task in shards(SPEC)[:2]:
        make_shard(tmp_path, SPEC, task)
    message = f"is missing: the dataset is unfinished: 2 of 3 shards are finished; {RERUN_HINT}"
    assert check_dataset(tmp_path) == [
        Finding("manifest.json", message, hint=REMAKE_HINT)
    ]
    make_shard(tmp_path, SPEC, shards(SPEC)[2])
    assert (
        "unfinished: all shards are finished, but the manifest is missing"
        in problems(tmp_path)["manifest.json"]
    )


def test_damage_to_an_unfinished_dataset_is_found(tmp_path: Path) -> None:
    make_shards(tmp_path)
    path = tmp_path / TASK.file
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    (tmp_path / shards(SPEC)[1].sidecar).write_bytes(b"{")
    assert problems(tmp_path).keys() == {
        "manifest.json",
        TASK.file,
        shards(SPEC)[1].sidecar,
    }


def test_a_damaged_manifest_does_not_hide_a_damaged_shard(dataset: Path) -> None:
    (dataset / "manifest.json").write_text("{")
    (dataset / TASK.file).unlink()
    (dataset / shards(SPEC)[1].sidecar).unlink()
    assert problems(dataset).keys() == {
        "manifest.json",
        TASK.file,
        shards(SPEC)[1].sidecar,
    }


def test_manifests_that_contradict_the_specification_or_themselves_are_found(
    tmp_path: Path, dataset: Path
) -> None:
    good = load_manifest(dataset)
    cases = [
        ({"specification_fingerprint": "0" * 64}, "another specification"),
        ({"fingerprint": "0" * 64}, "its fingerprint is not"),
        ({"splits": {"train": good["splits"]["train"]}}, "lists other shards"),
    ]
    for change, message in cases:
        save_document(dataset / "manifest.json", good | change)
        assert message in " ".join(str(item) for item in check_dataset(dataset))


def test_a_folder_without_a_specification_is_a_finding(tmp_path: Path) -> None:
    assert check_dataset(tmp_path) == [
        Finding("specification.json", "is missing", hint=REPLACE_HINT)
    ]
    assert check_dataset(tmp_path / "nowhere") == [
        Finding("specification.json", "is missing", hint=REPLACE_HINT)
    ]


@pytest.mark.parametrize("name", some(FILES, 2, "slow"))
def test_every_finding_has_a_hint_and_names_its_file_once(
    dataset: Path, name: str
) -> None:
    for content in (b"", b"{}", None):
        if content is None:
            (dataset / name).unlink()
        else:
            (dataset / name).write_bytes(content)
        for item in check_dataset(dataset):
            assert item.hint
            assert name not in item.problem
            assert str(dataset) not in item.problem


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in FILES
        if not name.endswith(".h5") and name != "specification.json"
    ],
)
def test_changed_documents_are_found_without_reading_a_shard(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    assert check_documents(dataset, SPEC) == []
    content = (dataset / name).read_bytes()
    (dataset / name).write_bytes(content[:-2] + b" " + content[-2:])
    read = []
    monkeypatch.setattr(
        "cnpgen.store.check.file_sha256",
        lambda path: (read.append(path.suffix), file_sha256(path))[1],
    )
    assert [item.file for item in check_documents(dataset, SPEC)] == [name]
    assert ".h5" not in read


def test_a_dataset_that_is_finished_again_has_no_findings(dataset: Path) -> None:
    finalize(dataset, SPEC)
    assert check_dataset(dataset) == []
