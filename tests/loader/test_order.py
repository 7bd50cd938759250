"""The order of rows: uniform and reproducible."""

from collections import Counter
from itertools import permutations

import numpy as np
import pytest

from cnpgen.loader import windows
from cnpgen.loader.windows import Order, permutation


@pytest.mark.parametrize("size", [0, 1, 2, 3, 63, 64, 65, 1000])
def test_a_permutation_contains_every_index_once(size: int) -> None:
    found = permutation(size, seed=3, key=(1, 2))
    assert found.dtype == np.int64
    assert sorted(found.tolist()) == list(range(size))


def test_every_permutation_is_equally_likely() -> None:
    counts = Counter(
        tuple(permutation(4, seed=0, key=(draw,)).tolist()) for draw in range(4800)
    )
    assert set(counts) == set(permutations(range(4)))
    statistic = sum((count - 200) ** 2 / 200 for count in counts.values())
    assert (
        statistic < 49.7
    )  # chi-squared with 23 degrees of freedom: 1 in 1000 are above


def test_the_order_of_a_released_version_does_not_change() -> None:
    """Reference values of 2026: a run that is resumed with a newer version continues in the same order."""
    assert permutation(8, seed=0, key=(1,)).tolist() == [7, 6, 3, 2, 4, 5, 1, 0]
    epoch = Order("train", (5, 3), seed=1, epoch=2)
    assert [window.shards for window in epoch.windows] == [(0, 1)]
    assert epoch.rows_of(0).tolist() == [2, 1, 5, 7, 6, 0, 3, 4]


@pytest.mark.parametrize(
    "shard_rows", [(), (5,), (16, 16, 16, 7), (1,) * 40, (300, 1), (64,) * 9]
)
@pytest.mark.parametrize("shuffle", [True, False])
def test_the_windows_of_an_epoch_hold_every_shard_once(
    monkeypatch: pytest.MonkeyPatch, shard_rows: tuple[int, ...], shuffle: bool
) -> None:
    monkeypatch.setattr(windows, "WINDOW_ROWS", 64)
    found = Order("train", shard_rows, 0, 0, shuffle)
    assert sorted(shard for window in found.windows for shard in window.shards) == list(
        range(len(shard_rows))
    )
    first = 0
    for index, window in enumerate(found.windows):
        assert window.first == first
        assert window.rows == sum(shard_rows[shard] for shard in window.shards)
        assert sorted(found.rows_of(index).tolist()) == list(range(window.rows))
        first += window.rows
    assert first == sum(shard_rows)


def test_a_window_has_about_the_rows_it_should(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "WINDOW_ROWS", 64)
    found = Order("train", (16,) * 37, 0, 0).windows
    assert {window.rows for window in found} == {64, 80}
    assert [
        len(Order("train", (16,) * shards, 0, 0).windows)
        for shards in (1, 4, 5, 6, 7, 8)
    ] == [1, 1, 1, 2, 2, 2]


@pytest.mark.parametrize(("rows", "count"), [(393_215, 1), (393_216, 2)])
def test_a_split_is_shuffled_uniformly_up_to_the_documented_size(
    rows: int, count: int
) -> None:
    shards = (4096,) * (rows // 4096) + ((rows % 4096,) if rows % 4096 else ())
    assert len(Order("train", shards, 0, 0).windows) == count


def test_without_shuffling_rows_are_in_their_stored_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(windows, "WINDOW_ROWS", 10)
    found = Order("train", (8, 8, 8), 5, 1, shuffle=False)
    assert [window.shards for window in found.windows] == [(0, 1), (2,)]
    assert found.rows_of(0).tolist() == list(range(16))


def test_seed_epoch_split_and_window_each_change_the_order() -> None:
    base = Order("train", (200,), 0, 0)
    others = [
        Order("train", (200,), 1, 0),
        Order("train", (200,), 0, 1),
        Order("validation", (200,), 0, 0),
    ]
    for other in others:
        assert not np.array_equal(base.rows_of(0), other.rows_of(0))
    assert np.array_equal(base.rows_of(0), Order("train", (200,), 0, 0).rows_of(0))


def test_windows_of_one_epoch_are_shuffled_differently(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(windows, "WINDOW_ROWS", 100)
    found = Order("train", (100, 100), 0, 0)
    assert not np.array_equal(found.rows_of(0), found.rows_of(1))
    distributions = {
        tuple(window.shards for window in Order("train", (100,) * 8, 0, epoch).windows)
        for epoch in range(5)
    }
    assert len(distributions) == 5  # the shards are distributed again in every epoch


def test_a_hundred_million_rows_need_no_stored_permutation() -> None:
    found = Order("train", (65_536,) * 1_526, 0, 0)
    assert len(found.windows) == 382  # of four shards, but for two of three
    assert {window.rows for window in found.windows} == {3 * 65_536, 4 * 65_536}
    assert len(found.rows_of(200)) == found.windows[200].rows
