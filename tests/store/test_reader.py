"""Reading rows of stored datasets."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.loader.load import load_dataset
from cnpgen.store import intact
from cnpgen.store.dataset_spec import shards, write_dataset_spec
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.reader import open_dataset
from tests.examples.store import SPEC, dataset, make_columns, make_shard
from tests.refusals import is_refused

__all__ = ["dataset"]

TRAIN = [make_columns(task) for task in shards(SPEC) if task.split == "train"]


def test_rows_and_fields_are_read_in_the_order_of_the_specification(
    dataset: Path,
) -> None:
    rows = open_dataset(dataset).read("train")
    assert list(rows) == [field.name for field in SPEC.fields]
    for name, values in rows.items():
        assert np.array_equal(values, np.concatenate([part[name] for part in TRAIN]))


@pytest.mark.parametrize(
    ("start", "stop"),
    [(0, 50), (0, 0), (50, 50), (31, 33), (5, 7), (32, None), (40, 50)],
)
def test_a_range_of_rows_equals_the_slice(
    dataset: Path, start: int, stop: int | None
) -> None:
    rows = open_dataset(dataset).read(
        "train", fields=["clearance", "goal_p"], start=start, stop=stop
    )
    assert list(rows) == ["clearance", "goal_p"]
    for name, values in rows.items():
        assert np.array_equal(
            values, np.concatenate([part[name] for part in TRAIN])[start:stop]
        )


def test_shards_are_listed_and_read_by_a_copy(dataset: Path) -> None:
    opened = pickle.loads(pickle.dumps(open_dataset(dataset)))
    assert [
        (task.index, task.first_row, task.rows) for task in opened.tasks("train")
    ] == [(0, 0, 32), (1, 32, 18)]
    rows = opened.read("train", fields=["start_q"], start=32)
    assert (list(rows), len(rows["start_q"])) == (["start_q"], 18)


@pytest.mark.parametrize(("start", "stop"), [(-1, 5), (6, 5), (0, 51)])
def test_rows_that_do_not_exist_are_refused(
    dataset: Path, start: int, stop: int
) -> None:
    with is_refused(DatasetError):
        open_dataset(dataset).read("train", start=start, stop=stop)


def test_unknown_splits_and_fields_are_refused(dataset: Path) -> None:
    opened = open_dataset(dataset)
    for split in ("val", "valid"):
        message = rf"has no split '{split}' \(did you mean 'validation'\?\), only train, validation$"
        with pytest.raises(DatasetError, match=message):
            opened.read(split)
    with is_refused(DatasetError, argument="fields"):
        opened.read("train", fields=["start_dq"])


def test_unfinished_datasets_are_refused_unless_allowed(tmp_path: Path) -> None:
    write_dataset_spec(tmp_path, SPEC)
    make_shard(tmp_path, SPEC, shards(SPEC)[1])
    with is_refused(DatasetError):
        open_dataset(tmp_path)
    opened = open_dataset(tmp_path, allow_incomplete=True)
    assert opened.manifest is None
    assert opened.read("train")["sample_id"].tolist() == list(range(32, 50))
    assert opened.read("validation")["start_q"].shape == (0, 3)


def test_damaged_parts_are_refused(dataset: Path) -> None:
    path = dataset / shards(SPEC)[0].file
    path.write_bytes(path.read_bytes()[:-1])
    with is_refused(DatasetError):
        open_dataset(dataset).read("train")
    (dataset / "manifest.json").write_text("{")
    with is_refused(DatasetError):
        open_dataset(dataset)


def change_a_number(path: Path, field: str = "start_q") -> None:
    """Overwrite bytes of a value in a committed shard: HDF5 does not detect it."""
    with h5py.File(path) as file:
        offset = file[field].id.get_offset()
    content = bytearray(path.read_bytes())
    content[offset + 3] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("finished", [True, False])
def test_all_readers_refuse_changed_values_with_the_same_message(
    dataset: Path, finished: bool
) -> None:
    second = shards(SPEC)[1]
    change_a_number(dataset / second.file)
    if not finished:
        (dataset / "manifest.json").unlink()
    opened = open_dataset(dataset, allow_incomplete=not finished)
    assert (
        len(opened.read("train", stop=32)["start_q"]) == 32
    )  # the other shard is good
    with pytest.raises(DatasetError) as by_rows:
        opened.read("train", start=40)
    with pytest.raises(DatasetError) as by_shards:
        opened.read("train", fields=["start_q"])
    with pytest.raises(DatasetError) as by_loader:
        load_dataset(dataset, allow_incomplete=not finished).arrays("train")
    assert str(by_rows.value) == str(by_shards.value) == str(by_loader.value)
    assert (
        "shard-00001.h5 is damaged: its sha256 is not the recorded one; run make_dataset or"
        in str(by_rows.value)
    )


def test_a_shard_is_hashed_once_unless_it_changes(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed: list[str] = []
    monkeypatch.setattr(
        intact,
        "file_sha256",
        lambda path: (hashed.append(path.name), file_sha256(path))[1],
    )
    for _ in range(3):
        open_dataset(dataset).read("train", stop=1)
    assert hashed == ["shard-00000.h5"]
    path = dataset / shards(SPEC)[0].file
    change_a_number(path)
    os.utime(path, ns=(0, 0))
    with is_refused(DatasetError):
        open_dataset(dataset).read("train", stop=1)
    assert hashed == ["shard-00000.h5"] * 2


def test_a_folder_that_mixes_two_datasets_is_refused(
    tmp_path: Path, dataset: Path
) -> None:
    from dataclasses import replace

    write_dataset_spec(tmp_path / "other", replace(SPEC, seed=1))
    (dataset / "specification.json").write_bytes(
        (tmp_path / "other" / "specification.json").read_bytes()
    )
    with is_refused(DatasetError):
        open_dataset(dataset)


def test_importing_the_store_does_not_import_h5py() -> None:
    modules = ", ".join(
        f"cnpgen.store.{name}"
        for name in ("manifest", "check", "reader", "shard_record", "shard")
    )
    code = f"import sys, {modules}; sys.exit('h5py' in sys.modules)"
    subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2]
    )
