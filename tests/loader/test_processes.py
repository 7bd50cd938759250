"""A loader in other processes and threads: pickled, spawned, and forked within an epoch."""

import multiprocessing
import os
import pickle
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from cnpgen.loader import windows
from cnpgen.loader.batches import Batches
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from tests.conftest import HANGING
from tests.examples.loader import ALL, ids, make


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(make(tmp_path_factory.mktemp("loader") / "set", shard_size=8))


@pytest.fixture(autouse=True, params=["kept in memory", "read in every epoch"])
def _small_windows(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.setattr(windows, "WINDOW_ROWS", 16)
    monkeypatch.setattr(
        windows,
        "MAX_IN_MEMORY_BYTES",
        1 << 20 if request.param == "kept in memory" else 0,
    )


def remaining_ids(batches: Batches) -> list[list[int]]:
    return ids(batches)


def test_a_pickled_loader_continues_at_its_position(dataset: Dataset) -> None:
    batches = dataset.batches(5, fields=ALL)
    loop = iter(batches)
    head = [next(loop)["sample_id"].tolist() for _ in range(3)]
    copy = pickle.loads(pickle.dumps(batches))
    assert head + ids(copy) == ids(dataset.batches(5, fields=ALL))
    assert copy.epoch == 1
    assert batches.epoch == 0


def test_a_pickled_dataset_is_small_and_works_although_it_had_mapped_shards(
    dataset: Dataset,
) -> None:
    dataset.arrays("train")
    content = pickle.dumps(dataset)
    assert len(content) < 50_000
    assert np.array_equal(
        pickle.loads(content)["train"][7]["start_q"], dataset["train"][7]["start_q"]
    )


def test_a_spawned_process_continues_at_the_position_of_its_parent(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # the patch does not apply to a new process
    batches = dataset.batches(5, fields=ALL)
    loop = iter(batches)
    head = [next(loop)["sample_id"].tolist() for _ in range(3)]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert head + pool.apply(remaining_ids, (batches,)) == ids(
            dataset.batches(5, fields=ALL)
        )


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.parametrize("taken", [0, 1, 3])
def test_a_forked_loop_continues_in_both_processes(
    dataset: Dataset, taken: int
) -> None:
    expected = ids(dataset.batches(5, fields=ALL))
    loop = (batch["sample_id"].tolist() for batch in dataset.batches(5, fields=ALL))
    head = [next(loop) for _ in range(taken)]
    assert head + forked(loop) == expected
    assert head + list(loop) == expected


def forked(loop: Iterator[list[int]]) -> list[list[int]]:
    """Finish a loop in a forked process."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.write(writing, pickle.dumps(list(loop)))
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        content = pipe.read()
    assert os.waitpid(child, 0)[1] == 0
    return pickle.loads(content)


def test_many_threads_read_the_same_dataset(dataset: Dataset) -> None:
    expected = ids(dataset.batches(5, fields=ALL))
    everything = dataset.arrays("train")["start_q"]
    random = np.random.default_rng(0)
    wanted = [random.integers(50, size=20) for _ in range(40)]
    with ThreadPoolExecutor(8) as pool:
        loops = [
            pool.submit(remaining_ids, dataset.batches(5, fields=ALL))
            for _ in range(20)
        ]
        reads = [pool.submit(dataset.rows, "train", rows) for rows in wanted]
        assert all(loop.result() == expected for loop in loops)
        for rows, read in zip(wanted, reads, strict=True):
            assert np.array_equal(read.result()["start_q"], everything[rows])


def test_an_abandoned_loop_leaves_no_thread(dataset: Dataset) -> None:
    import threading
    import time

    before = threading.active_count()
    for _ in range(5):
        next(iter(dataset.batches(5)))
    deadline = time.monotonic() + HANGING
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.001)
    assert threading.active_count() == before


def test_files_are_not_left_open(dataset: Dataset) -> None:
    folder = Path("/proc/self/fd")
    if not folder.is_dir():
        pytest.skip("this system does not list open files")
    list(dataset.batches(5))
    before = len(list(folder.iterdir()))
    for epoch in range(4):
        list(dataset.batches(5, epoch=epoch))
    assert len(list(folder.iterdir())) == before
