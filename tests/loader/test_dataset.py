"""Opening a dataset for training: what is in it, its rows at random, and what is refused."""

import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import ANY

import numpy as np
import pytest

import cnpgen
from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.loader import shard_reader
from cnpgen.loader.batch_options import BatchOptions
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.gather import RowError
from cnpgen.loader.load import load_dataset
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import as_problem, as_record, record_problem
from cnpgen.store.dataset_spec import shards, write_dataset_spec
from cnpgen.store.reader import open_dataset
from cnpgen.store.shard import read_placements
from tests.examples.loader import ALL, columns, ids, make
from tests.examples.store import SPEC, make_shard
from tests.refusals import is_refused


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("loader") / "set")


@pytest.fixture(scope="module")
def dataset(folder: Path) -> Dataset:
    return load_dataset(folder)


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """A dataset to be damaged."""
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def test_a_dataset_describes_its_content(dataset: Dataset, folder: Path) -> None:
    assert dataset.splits == {"train": 50, "validation": 10}
    assert list(dataset) == ["train", "validation"]
    assert len(dataset) == 2
    assert "train" in dataset
    assert "test" not in dataset
    assert dataset.fields["start_q"].unit == "rad"
    assert dataset.fields["start_q"].names == ("j1", "j2", "j3")
    assert list(dataset.fields) == list(ALL)
    assert dataset.fingerprint == open_dataset(folder).manifest["fingerprint"]  # type: ignore[index]
    assert repr(dataset) == f"<two-shards 1.0.0 in {folder}: 50 train, 10 validation>"


def test_a_dataset_opened_by_a_relative_path_is_read_in_another_working_folder(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(copy.parent)
    dataset = load_dataset(copy.name)
    monkeypatch.chdir("/")
    assert dataset.arrays("train", fields=["goal_p"])["goal_p"].shape == (50, 2)


def test_the_repr_is_one_line(dataset: Dataset) -> None:
    batches = dataset.batches(8, seed=3, fields=ALL)
    batch = next(iter(batches))
    layout = "start_q[3], goal_p[2], clearance, sample_id"
    assert repr(batch) == f"<batch of 8 rows, float32: {layout}>"
    assert (
        repr(batches)
        == f"<batches of 8 of the 50 rows of split 'train', at seed 3, epoch 0, row 8: {layout}>"
    )
    assert (
        repr(dataset["validation"])
        == "<10 rows of split 'validation': start_q[3], goal_p[2]>"
    )
    assert (
        repr(dataset.normalization)
        == "<means and deviations of start_q, goal_p, clearance>"
    )


def test_an_unknown_split_is_refused_and_the_existing_ones_are_named(
    dataset: Dataset, folder: Path
) -> None:
    message = "has no split 'val'.*only train, validation"
    for read in (
        lambda: dataset["val"],
        lambda: dataset.batches(8, split="val"),
        lambda: dataset.rows("val", [0]),
        lambda: dataset.frame("val"),
        lambda: open_dataset(folder).read("val"),
    ):
        with pytest.raises(DatasetError, match=message) as caught:
            read()
        assert caught.value.argument == "split"
    with is_refused(DatasetError, argument="fields") as caught:
        dataset.batches(8, fields=["start_p"])
    assert caught.value.argument == "fields"


def test_the_problem_of_a_dataset_is_that_of_its_recipe(tiny) -> None:
    found, problem = (
        cnpgen.load_dataset(tiny("airhockey-hit")).problem,
        load_problem("airhockey"),
    )
    assert as_record(found) == record_problem(problem)
    assert as_problem(found).identity == problem.identity
    assert found.urdf == problem.urdf_path.read_text()
    assert repr(found) == "<problem airhockey of a dataset>"


def test_a_dataset_without_a_problem_is_refused(dataset: Dataset) -> None:
    with is_refused(DatasetError):
        _ = dataset.problem


@pytest.mark.extended
@pytest.mark.parametrize("library", ["polars", "pandas"])
def test_a_frame_has_a_column_per_joint_and_axis(
    dataset: Dataset, library: str
) -> None:
    pytest.importorskip(library)
    table, rows = dataset.frame("train", fields=ALL, library=library), columns()
    named = [
        ("start_q", "j1"),
        ("start_q", "j2"),
        ("start_q", "j3"),
        ("goal_p", "x"),
        ("goal_p", "y"),
    ]
    assert list(table.columns) == [
        *(".".join(pair) for pair in named),
        "clearance",
        "sample_id",
    ]
    assert table.shape == (50, 7)
    for place, (name, column) in enumerate(named):
        assert np.array_equal(
            table[f"{name}.{column}"].to_numpy(),
            rows[name][:, place - 3 * (name == "goal_p")],
        )
    assert np.array_equal(table["clearance"].to_numpy(), rows["clearance"])
    assert table["sample_id"].to_numpy().dtype == np.int64
    assert type(table).__module__.startswith(library)
    assert (
        list(dataset.frame("validation", library=library).columns)
        == list(table.columns)[:5]
    )


@pytest.mark.extended
def test_a_frame_of_pandas_contains_its_units(dataset: Dataset) -> None:
    pytest.importorskip("pandas")
    units = dataset.frame(
        "train", fields=["goal_p", "clearance"], library="pandas"
    ).attrs["units"]
    assert units == {"goal_p.x": "m", "goal_p.y": "m", "clearance": "m"}


def test_a_frame_of_another_library_or_of_none_is_refused(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    with is_refused(UsageError, argument="library"):
        dataset.frame("train", library="spark")
    monkeypatch.setattr("cnpgen.loader.dataset.find_spec", lambda name: None)
    with is_refused(MachineError):
        dataset.frame("train")
    with is_refused(MachineError):
        dataset.frame("train", library="pandas")


def test_load_dataset_is_a_public_name() -> None:
    assert cnpgen.load_dataset is load_dataset


def test_arrays_contain_all_rows_in_their_stored_type(dataset: Dataset) -> None:
    found = dataset.arrays("train", fields=dataset.fields)
    for name, values in columns().items():
        assert np.array_equal(found[name], values)
        assert found[name].dtype == values.dtype
        assert found[name].flags.c_contiguous
    assert list(dataset.arrays()) == [
        "start_q",
        "goal_p",
    ]  # no diagnostics, no integers


def test_arrays_are_normalized_and_converted_on_request(dataset: Dataset) -> None:
    raw = dataset.arrays("validation", fields=ALL)
    found = dataset.arrays("validation", fields=ALL, normalize=True, dtype="float32")
    train = columns()
    assert found["start_q"].dtype == np.float32
    expected = (raw["start_q"] - train["start_q"].mean(0)) / train["start_q"].std(0)
    assert np.allclose(found["start_q"], expected, rtol=0, atol=1e-6)
    assert np.array_equal(found["sample_id"], raw["sample_id"])


@pytest.mark.parametrize(
    "indices", [[0], [49, 0, 31, 32, 33, 5, 5], [-1, -50, 3], np.arange(50)[::-7], []]
)
def test_rows_are_returned_in_the_order_of_the_indices(
    dataset: Dataset, indices: list[int]
) -> None:
    found = dataset.rows("train", indices, fields=ALL)
    for name, values in columns().items():
        assert np.array_equal(found[name], values[np.array(indices, int)])


def test_a_split_is_a_sequence_of_rows(dataset: Dataset) -> None:
    split, rows = dataset["train"], columns()
    assert len(split) == 50
    assert np.array_equal(split[3]["start_q"], rows["start_q"][3])
    assert np.array_equal(split[np.int64(-1)]["goal_p"], rows["goal_p"][-1])
    assert np.array_equal(split[30:40:3]["goal_p"], rows["goal_p"][30:40:3])
    assert np.array_equal(split[[40, 2]]["start_q"], rows["start_q"][[40, 2]])
    assert split[3]["start_q"].shape == (3,)
    assert split[60:]["start_q"].shape == (0, 3)
    assert [row["start_q"][0] for row in split] == rows["start_q"][:, 0].tolist()


@pytest.mark.parametrize("row", [50, -51, [3, 50]])
def test_an_invalid_row_index_is_an_index_error_and_a_cnpgen_error(
    dataset: Dataset, row: int | list[int]
) -> None:
    with is_refused(RowError, argument="indices"):
        dataset["train"][row]
    assert issubclass(RowError, IndexError)
    assert issubclass(RowError, cnpgen.CnpgenError)


@pytest.mark.parametrize("indices", [[0.5], [[1, 2]], np.ones(50, bool), ["a"]])
def test_indices_that_are_not_integers_are_refused(
    dataset: Dataset, indices: list[float]
) -> None:
    with is_refused(UsageError, argument="indices"):
        dataset.rows("train", indices)


def test_the_number_of_mapped_shards_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shard_reader, "MAX_MEMORY_MAPS", 3)
    dataset = load_dataset(make(tmp_path, splits={"train": 50}, shard_size=10))
    rows = columns(splits={"train": 50}, shard_size=10)["start_q"]
    for row in np.random.default_rng(0).integers(50, size=60):
        assert np.array_equal(dataset["train"][row]["start_q"], rows[row])
    assert len(dataset.reader._maps) == 3


def test_a_made_dataset_is_loaded(tiny) -> None:
    dataset = cnpgen.load_dataset(tiny("airhockey-hit"))
    batches = dataset.batches(200)
    tables = np.concatenate([batch.table for batch in batches])
    assert tables.shape == (
        600,
        sum(part.stop - part.start for part in next(iter(batches)).columns.values()),
    )
    assert np.isfinite(tables).all()
    assert np.abs(tables.mean(0)).max() < 1e-5
    constant = np.ptp(tables, axis=0) == 0
    assert (tables[:, constant] == 0).all()
    assert np.abs(tables[:, ~constant].std(0) - 1).max() < 1e-5


# Incomplete and damaged datasets are refused.


def test_an_unfinished_dataset_is_refused_unless_allowed(tmp_path: Path) -> None:
    write_dataset_spec(tmp_path, SPEC)
    make_shard(tmp_path, SPEC, shards(SPEC)[1])
    with is_refused(DatasetError):
        load_dataset(tmp_path)
    dataset = load_dataset(tmp_path, allow_incomplete=True)
    assert dataset.splits == {"train": 18, "validation": 0}
    assert [sorted(batch) for batch in ids(dataset.batches(18, fields=ALL))] == [
        list(range(32, 50))
    ]
    assert dataset["train"][0]["start_q"].tolist() == columns()["start_q"][32].tolist()
    rows = columns()["start_q"][32:]
    assert np.allclose(
        dataset.normalization.mean["start_q"], rows.mean(0), rtol=0, atol=1e-15
    )  # type: ignore[union-attr]
    with is_refused(UsageError, argument="batch_size"):
        dataset.batches(1, split="validation")
    assert (
        list(
            dataset.batches(
                1, split="validation", options=BatchOptions(drop_last=False)
            )
        )
        == []
    )
    assert dataset.arrays("validation")["start_q"].shape == (0, 3)


def test_a_dataset_without_training_rows_needs_the_normalization_of_another_one(
    dataset: Dataset, tmp_path: Path
) -> None:
    lonely = load_dataset(make(tmp_path, splits={"test": 9}))
    with is_refused(DatasetError):
        lonely.batches(3, split="test")
    raw = np.concatenate(
        [
            b["start_q"]
            for b in lonely.batches(
                3, split="test", normalize=False, options=BatchOptions(shuffle=False)
            )
        ]
    )
    borrowed = lonely.batches(
        3,
        split="test",
        normalize=dataset.normalization,
        options=BatchOptions(shuffle=False),
    )
    expected = (raw - columns()["start_q"].mean(0)) / columns()["start_q"].std(0)
    assert np.allclose(
        np.concatenate([batch["start_q"] for batch in borrowed]),
        expected,
        rtol=0,
        atol=1e-6,
    )


@pytest.mark.parametrize("option", ["allow_incomplete", "verify"])
def test_options_must_be_bools(tmp_path: Path, option: str) -> None:
    with is_refused(UsageError, argument=ANY):
        load_dataset(make(tmp_path), **{option: "no"})  # type: ignore[arg-type]


def test_folders_without_a_dataset_are_refused(tmp_path: Path) -> None:
    with is_refused(UsageError, argument="folder"):
        load_dataset(tmp_path)
    with is_refused(UsageError, argument="folder"):
        load_dataset(tmp_path / "nowhere")


@pytest.mark.parametrize("damage", ["missing", "cut off"])
def test_missing_and_cut_off_shards_are_detected_when_the_dataset_is_opened(
    copy: Path, damage: str
) -> None:
    path = copy / "train" / "shard-00000.h5"
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-1])
    with is_refused(DatasetError):
        load_dataset(copy)
    dataset = load_dataset(copy, allow_incomplete=True)
    assert dataset.splits == {"train": 18, "validation": 10}
    assert [sorted(batch) for batch in ids(dataset.batches(18, fields=ALL))] == [
        list(range(32, 50))
    ]
    assert (
        dataset.fingerprint
        != load_dataset(copy, allow_incomplete=True).spec.fingerprint
    )


def test_a_changed_byte_is_detected_when_the_shard_is_read(copy: Path) -> None:
    path = copy / "train" / "shard-00001.h5"
    content = bytearray(path.read_bytes())
    content[(read_placements(path)[0]["start_q"].offset or 0) + 3] ^= 1
    path.write_bytes(content)
    dataset = load_dataset(copy)
    with is_refused(DatasetError):
        list(dataset.batches(10))
    with is_refused(DatasetError):
        dataset["train"][-1]
    assert (
        len(dataset["train"][:32]["start_q"]) == 32
    )  # the other shard is as good as it was
    assert len(list(load_dataset(copy, verify=False).batches(10))) == 5


@pytest.mark.parametrize("verify", [True, False])
def test_a_shard_of_another_dataset_is_detected(
    copy: Path, tmp_path: Path, verify: bool
) -> None:
    other = make(tmp_path / "other", splits={"train": 64})
    shutil.copy(other / "train" / "shard-00000.h5", copy / "train" / "shard-00000.h5")
    dataset = load_dataset(copy, verify=verify)
    with pytest.raises(
        DatasetError,
        match="sha256" if verify else "of another dataset or another position",
    ):
        dataset["train"][0]


def test_a_shard_that_is_deleted_during_use_raises_an_error(copy: Path) -> None:
    dataset = load_dataset(copy)
    (copy / "train" / "shard-00001.h5").unlink()
    with is_refused(DatasetError):
        list(dataset.batches(10))


@pytest.mark.parametrize("name", ["manifest.json", "stats.json", "specification.json"])
def test_a_damaged_document_is_refused(copy: Path, name: str) -> None:
    text = (copy / name).read_text()
    (copy / name).write_text(text.replace("0", "1", 1))
    with pytest.raises(DatasetError, match=name):
        load_dataset(copy)


def test_statistics_of_another_specification_are_refused(
    copy: Path, tmp_path: Path
) -> None:
    other = make(tmp_path / "other", seed=3)
    shutil.copy(other / "stats.json", copy / "stats.json")
    with is_refused(DatasetError):
        load_dataset(copy)


def test_another_dataset_has_another_fingerprint(
    dataset: Dataset, tmp_path: Path
) -> None:
    again = load_dataset(make(tmp_path / "again"))
    other = load_dataset(make(tmp_path / "other", seed=3))
    assert dataset.fingerprint == again.fingerprint != other.fingerprint
    assert replace(SPEC, seed=3).fingerprint == other.spec.fingerprint
