"""Batches: every row once per epoch, equal on all ranks, and resumable at any batch."""

import json
import threading
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader import windows
from cnpgen.loader.batch import Batch
from cnpgen.loader.batch_options import BatchOptions
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from cnpgen.loader.shard_reader import ShardReader
from cnpgen.store.checked_shard import Shard
from tests.conftest import HANGING
from tests.examples.grouped import grouped
from tests.examples.loader import ALL, columns, ids, make, same
from tests.refusals import is_refused

SIZES = {  # rows and rows per shard
    "one row": ({"train": 1}, 4),
    "one shard": ({"train": 23, "validation": 5}, 32),
    "last shard short": ({"train": 50, "validation": 17, "test": 1}, 16),
    "last shard of one row": ({"train": 65, "validation": 33}, 8),
    "shards of one row": ({"train": 9, "validation": 2}, 1),
    "even": ({"train": 64, "validation": 16}, 16),
}


@pytest.fixture(scope="module", params=SIZES)
def dataset(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Dataset:
    splits, shard_size = SIZES[request.param]
    return load_dataset(
        make(tmp_path_factory.mktemp("loader"), splits=splits, shard_size=shard_size)
    )


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    splits, shard_size = SIZES["last shard short"]
    return load_dataset(
        make(tmp_path_factory.mktemp("loader"), splits=splits, shard_size=shard_size)
    )


@pytest.fixture(autouse=True, params=["kept in memory", "read in every epoch"])
def _small_windows(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.setattr(windows, "WINDOW_ROWS", 20)
    monkeypatch.setattr(
        windows,
        "MAX_IN_MEMORY_BYTES",
        1 << 20 if request.param == "kept in memory" else 0,
    )


def cases(dataset: Dataset, count: int = 12) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield random splits and options: batches of one row to more than all rows, one to four ranks."""
    random = np.random.default_rng(list(dataset.splits.values()))
    for _ in range(count):
        split = str(random.choice(list(dataset.splits)))
        rows, world = dataset.splits[split], int(random.integers(1, 5))
        batch_size = world * int(random.integers(1, 2 * rows // world + 2))
        drop_last = bool(random.integers(2)) and batch_size <= rows
        yield (
            split,
            {
                "batch_size": batch_size,
                "world": 1
                if not drop_last and 0 < rows % batch_size < world
                else world,  # refused, see below
                "drop_last": drop_last,
                "seed": int(random.integers(5)),
                "epoch": int(random.integers(3)),
                "shuffle": bool(random.integers(4)),
            },
        )


def test_every_row_is_returned_once_per_epoch(dataset: Dataset) -> None:
    for split, options in cases(dataset):
        everything = dataset.arrays(split, fields=ALL, normalize=True)
        batches = grouped(
            dataset.batches,
            BatchOptions,
            split=split,
            fields=ALL,
            **options | {"world": 1},
        )
        found = list(batches)
        rows = np.concatenate([batch["sample_id"] for batch in found])
        dropped = (
            dataset.splits[split] % options["batch_size"] if options["drop_last"] else 0
        )
        assert len(found) == len(batches)
        assert len(set(rows.tolist())) == len(rows) == dataset.splits[split] - dropped
        for batch in found:
            for name, values in batch.items():
                assert np.array_equal(
                    values, everything[name][batch["sample_id"]].astype(values.dtype)
                )


def test_only_the_last_batch_may_be_incomplete(dataset: Dataset) -> None:
    for split, options in cases(dataset):
        sizes = [
            batch.rows
            for batch in grouped(
                dataset.batches, BatchOptions, split=split, **options | {"world": 1}
            )
        ]
        assert set(sizes[:-1]) <= {options["batch_size"]}
        assert (
            sizes[-1] == options["batch_size"]
            if options["drop_last"]
            else 0 < sizes[-1] <= options["batch_size"]
        )


def test_the_batches_of_all_ranks_together_are_those_of_one_rank(
    dataset: Dataset,
) -> None:
    for split, options in cases(dataset):
        world = options["world"]
        whole = list(
            grouped(
                dataset.batches,
                BatchOptions,
                split=split,
                fields=ALL,
                **options | {"world": 1},
            )
        )
        ranks = [
            list(
                grouped(
                    dataset.batches,
                    BatchOptions,
                    split=split,
                    fields=ALL,
                    rank=r,
                    **options,
                )
            )
            for r in range(world)
        ]
        assert {len(rank) for rank in ranks} == {len(whole)}
        for number, batch in enumerate(whole):
            for rank in range(world):
                for name, values in ranks[rank][number].items():
                    assert np.array_equal(values, batch[name][rank::world])


def test_a_resumed_run_equals_the_uninterrupted_run(dataset: Dataset) -> None:
    """Over two epochs, through JSON, in new objects, one of them with another seed and epoch."""
    for split, options in cases(dataset, 6):
        uncut = grouped(
            dataset.batches, BatchOptions, split=split, fields=ALL, **options
        )
        expected = [batch for _ in range(2) for batch in uncut]
        batches = len(uncut)
        for cut in {0, 1, batches // 2, batches - 1, batches, batches + 1, 2 * batches}:
            first = grouped(
                dataset.batches, BatchOptions, split=split, fields=ALL, **options
            )
            head = take(first, cut)
            state = json.loads(json.dumps(first.state()))
            second = grouped(
                dataset.batches,
                BatchOptions,
                split=split,
                fields=ALL,
                **options | {"seed": 99, "epoch": 7},
            )
            second.load_state(state)
            tail = take(second, 2 * batches - cut)
            assert all(
                same(one, other)
                for one, other in zip(head + tail, expected, strict=True)
            )


def take(batches: Any, count: int) -> list[Batch]:
    """Return the next batches, over as many epochs as needed."""
    found: list[Batch] = []
    while len(found) < count:
        for batch in batches:
            found.append(batch)
            if len(found) == count:
                break
    return found


def test_the_state_is_the_same_on_every_rank_and_may_be_loaded_with_another_world(
    plain: Dataset,
) -> None:
    ranks = [
        plain.batches(6, fields=ALL, options=BatchOptions(rank=rank, world=3))
        for rank in range(3)
    ]
    for rank in ranks:
        take(rank, 4)
    states = [rank.state() for rank in ranks]
    assert states[0] == states[1] == states[2]
    alone = plain.batches(13, fields=ALL)
    alone.load_state(states[0])
    reference = [row for batch in ids(plain.batches(1, fields=ALL)) for row in batch]
    assert ids(alone) == [reference[24:37], reference[37:50]]


def test_the_state_is_a_small_dict(plain: Dataset) -> None:
    batches = plain.batches(10, seed=3, epoch=2)
    take(batches, 3)
    assert batches.state() == {
        "format": "cnpgen-loader-state",
        "format_version": 1,
        "fingerprint": plain.fingerprint,
        "split": "train",
        "seed": 3,
        "shuffle": True,
        "epoch": 2,
        "row": 30,
    }


def test_the_state_after_a_number_of_used_batches_is_computed_without_reading_them(
    plain: Dataset,
) -> None:
    for drop_last in (True, False):
        batches, ahead = (
            plain.batches(8, epoch=1, options=BatchOptions(drop_last=drop_last)),
            plain.batches(8, options=BatchOptions(drop_last=drop_last)),
        )
        for used in range(len(batches)):
            assert ahead.state(epoch=1, batch=used) == batches.state()
            take(batches, 1)
        assert ahead.state(epoch=1, batch=len(batches)) == batches.state()
        assert (batches.state()["epoch"], batches.state()["row"]) == (2, 0)
        with is_refused(UsageError, argument="batch"):
            ahead.state(batch=8)


def test_shapes_and_types_are_known_before_the_first_batch(plain: Dataset) -> None:
    batches = plain.batches(8, fields=ALL, dtype="float64")
    (batch, *_) = batches
    assert batches.signature == {
        name: (values.shape[1:], values.dtype) for name, values in batch.items()
    }


def test_an_abandoned_loop_continues_and_a_finished_one_starts_the_next_epoch(
    plain: Dataset,
) -> None:
    batches = plain.batches(10, fields=ALL)
    assert ids(take(batches, 2)) + ids(batches) == ids(plain.batches(10, fields=ALL))
    assert batches.epoch == 1
    assert (
        ids(batches)
        == ids(plain.batches(10, fields=ALL, epoch=1))
        != ids(plain.batches(10, fields=ALL))
    )
    batches.epoch = 0
    assert ids(batches) == ids(plain.batches(10, fields=ALL))


def test_taking_exactly_all_batches_of_an_epoch_ends_it(plain: Dataset) -> None:
    batches = plain.batches(10, fields=ALL)
    for epoch in range(3):
        assert batches.epoch == epoch
        assert ids(islice(batches, len(batches))) == ids(
            plain.batches(10, fields=ALL, epoch=epoch)
        )


def test_a_state_that_leaves_no_batch_of_another_size_leads_to_the_next_epoch(
    plain: Dataset,
) -> None:
    small, large = plain.batches(10, fields=ALL), plain.batches(25, fields=ALL)
    take(small, 4)
    large.load_state(small.state())
    assert large.epoch == 1
    assert ids(large) == ids(plain.batches(25, fields=ALL, epoch=1))


def test_two_loops_over_the_same_batches_are_refused(plain: Dataset) -> None:
    batches = plain.batches(10)
    outer = iter(batches)
    next(outer)
    take(batches, 1)
    with is_refused(UsageError):
        next(outer)


def test_a_batch_owns_its_arrays(plain: Dataset) -> None:
    expected = list(plain.batches(10, fields=ALL))
    found = []
    for batch in plain.batches(10, fields=ALL):
        found.append({name: values.copy() for name, values in batch.items()})
        batch.table[:] = np.nan
        batch["sample_id"][:] = -1
    for one, other in zip(found, expected, strict=True):
        assert all(np.array_equal(one[name], other[name]) for name in ALL)


def test_fields_are_views_of_one_packed_table_in_the_requested_order(
    plain: Dataset,
) -> None:
    batch = next(iter(plain.batches(8, fields=["clearance", "sample_id", "start_q"])))
    assert list(batch) == ["clearance", "sample_id", "start_q"]
    assert batch.table.shape == (8, 4)
    assert batch.table.flags.c_contiguous
    assert batch.table.dtype == np.float32
    assert batch.columns == {"clearance": slice(0, 1), "start_q": slice(1, 4)}
    assert batch["clearance"].shape == (8,)
    assert batch["start_q"].shape == (8, 3)
    assert all(
        np.shares_memory(batch[name], batch.table) for name in ("clearance", "start_q")
    )
    assert batch["sample_id"].dtype == np.int64
    assert dict(batch).keys() == {"clearance", "sample_id", "start_q"}


def test_integers_alone_make_batches_with_an_empty_table(plain: Dataset) -> None:
    batches = list(plain.batches(50, fields=["sample_id"]))
    assert sorted(batches[0]["sample_id"].tolist()) == list(range(50))
    assert batches[0].table.shape == (50, 0)


@pytest.mark.parametrize("dtype", ["float32", "float64", np.float32])
def test_float_fields_have_the_requested_type(plain: Dataset, dtype: Any) -> None:
    rows = columns(splits=SIZES["last shard short"][0], shard_size=16)
    for batch in plain.batches(16, fields=ALL, normalize=False, dtype=dtype):
        assert batch.table.dtype == dtype
        assert np.array_equal(
            batch["start_q"], rows["start_q"][batch["sample_id"]].astype(dtype)
        )


def test_batches_of_float32_shards_have_the_requested_type(tmp_path: Path) -> None:
    dataset = load_dataset(make(tmp_path, dtype="float32"))
    rows = columns(dtype="float32")
    for dtype in ("float32", "float64"):
        for batch in dataset.batches(16, fields=ALL, normalize=False, dtype=dtype):
            assert np.array_equal(batch["start_q"], rows["start_q"][batch["sample_id"]])


@pytest.mark.parametrize("stored", ["float32", "float64"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_batches_and_rows_are_normalized_to_identical_values(
    tmp_path: Path, stored: str, dtype: str
) -> None:
    dataset = load_dataset(make(tmp_path, dtype=stored))
    (batch,) = dataset.batches(50, fields=ALL, dtype=dtype)
    rows = dataset.rows(
        "train", batch["sample_id"], fields=ALL, normalize=True, dtype=dtype
    )
    assert all(np.array_equal(rows[name], values) for name, values in batch.items())


def test_a_batch_size_above_the_number_of_rows_needs_drop_last_false(
    plain: Dataset,
) -> None:
    with is_refused(UsageError, argument="batch_size"):
        plain.batches(51)
    (batch,) = plain.batches(51, options=BatchOptions(drop_last=False))
    assert batch.rows == 50


def test_a_last_batch_without_rows_for_a_rank_is_refused(plain: Dataset) -> None:
    message = "the last batch of 50 rows has 2 for 3 ranks: omit it with drop_last=True"
    with pytest.raises(UsageError, match=message):
        plain.batches(6, options=BatchOptions(world=3, drop_last=False))
    assert [
        batch.rows
        for batch in plain.batches(
            48, options=BatchOptions(world=2, rank=1, drop_last=False)
        )
    ] == [24, 1]
    batches = plain.batches(
        9, options=BatchOptions(world=3, drop_last=False)
    )  # 50 = 5 x 9 + 5, but 46 = 5 x 9 + 1
    with is_refused(UsageError, argument="batch_size"):
        batches.load_state(batches.state() | {"row": 4})
    assert batches.state()["row"] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size must be an integer from 1 on, got 0"),
        ({"batch_size": 2.5}, "batch_size must be an integer from 1 on, got 2.5"),
        ({"batch_size": 7, "world": 2}, r"must be a multiple of world \(2\), got 7"),
        ({"rank": 2, "world": 2}, "rank must be one of 0 to 1, got 2"),
        ({"rank": -1}, "rank must be an integer from 0 on, got -1"),
        ({"seed": -1}, "seed must be an integer from 0 on, got -1"),
        ({"epoch": "1"}, "epoch must be an integer from 0 on, got '1'"),
        ({"dtype": "float16"}, "dtype must be one of float32, float64, got 'float16'"),
        ({"dtype": "flaot32"}, "dtype must be one of float32, float64, got 'flaot32'"),
        (
            {"normalize": "yes"},
            "normalize must be True, False or the normalization of a dataset, got 'yes'",
        ),
        (
            {"normalize": 1},
            "normalize must be True, False or the normalization of a dataset, got 1",
        ),
        ({"shuffle": "no"}, "shuffle must be True or False, got 'no'"),
        ({"drop_last": 0}, "drop_last must be True or False, got 0"),
        ({"fields": "start_q"}, r"write \['start_q'\]"),
        ({"fields": []}, "one or more different names"),
        ({"fields": ["start_q", "start_q"]}, "one or more different names"),
    ],
)
def test_invalid_arguments_are_refused(
    plain: Dataset, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        grouped(plain.batches, BatchOptions, **{"batch_size": 8} | options)


def test_unknown_splits_and_fields_are_refused_with_the_nearest_name(
    plain: Dataset,
) -> None:
    with is_refused(DatasetError, argument="split"):
        plain.batches(8, split="valid")
    with is_refused(DatasetError, argument="fields"):
        plain.batches(8, fields=["start_dq"])


def test_the_state_of_another_dataset_or_split_is_refused(
    plain: Dataset, tmp_path: Path
) -> None:
    other = load_dataset(make(tmp_path, seed=8))
    batches = plain.batches(8)
    with is_refused(DatasetError):
        batches.load_state(other.batches(8).state())
    with is_refused(DatasetError):
        batches.load_state(plain.batches(8, split="validation").state())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "x"}, "must be what state"),
        ({"format_version": 2}, "format version 2, this cnpgen reads 1"),
        ({"row": 51}, "at row 51; split 'train' has 50"),
        ({"row": -1}, "row must be an integer from 0 on"),
        ({"epoch": None}, "epoch must be an integer"),
    ],
)
def test_invalid_states_are_refused(
    plain: Dataset, change: dict[str, Any], message: str
) -> None:
    batches = plain.batches(8)
    with pytest.raises((DatasetError, UsageError), match=message):
        batches.load_state(batches.state() | change)
    with is_refused(UsageError):
        batches.load_state([1])  # type: ignore[arg-type]
    lacking = batches.state()
    del lacking["seed"]
    with is_refused(UsageError):
        batches.load_state(lacking)


def test_resuming_does_not_read_previous_windows(
    plain: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    epoch = windows.Order(
        "train", tuple(shard.rows for shard in plain.shards["train"]), 0, 0
    )
    assert len(epoch.windows) > 1
    batches = plain.batches(2)
    batches.load_state(batches.state() | {"row": epoch.windows[-1].first})
    read = record_reads(monkeypatch)
    next(iter(batches))
    assert {shard.path for shard, _, _ in read} == {
        plain.shards["train"][i].path for i in epoch.windows[-1].shards
    }


def test_the_next_window_is_read_ahead_by_one_thread_at_a_time(
    plain: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, most, original = [], [], windows.pack

    def counted(*arguments: Any, **options: Any) -> Any:
        running.append(threading.current_thread())
        most.append(len(running))
        try:
            return original(*arguments, **options)
        finally:
            running.pop()

    monkeypatch.setattr(windows, "pack", counted)
    read = record_reads(monkeypatch)
    rest = iter(plain.batches(1))
    next(rest)
    deadline = time.monotonic() + HANGING
    while len({shard.path for shard, _, _ in read}) < len(plain.shards["train"]):
        time.sleep(0.001)  # the second of two windows is read ahead
        assert time.monotonic() < deadline
    assert sum(1 for _ in rest) == 49
    assert set(most) == {1}
    assert threading.main_thread() not in {thread for _, _, thread in read}


def test_a_split_that_fits_is_read_once_and_a_larger_one_in_every_epoch(
    plain: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = 50 * (2 * 4 + 8)
    for limit, times in ((size, 1), (size - 1, 3)):
        monkeypatch.setattr(windows, "MAX_IN_MEMORY_BYTES", limit)
        read = record_reads(monkeypatch)
        batches = plain.batches(10, fields=["goal_p", "sample_id"])
        found = [ids(batches) for _ in range(3)]
        assert found == [
            ids(plain.batches(10, fields=ALL, epoch=epoch)) for epoch in range(3)
        ]
        mine = [shard.path for shard, fields, _ in read if fields == 2]
        assert sorted(mine) == sorted(
            shard.path for shard in plain.shards["train"] * times
        )


def record_reads(
    monkeypatch: pytest.MonkeyPatch,
) -> list[tuple[Shard, int, threading.Thread]]:
    """Note which shards are read, how many fields of them, and by which thread."""
    found, original = [], ShardReader.read

    def read(self: ShardReader, shard: Shard, fields: Any) -> Any:
        found.append((shard, len(fields), threading.current_thread()))
        return original(self, shard, fields)

    monkeypatch.setattr(ShardReader, "read", read)
    return found
