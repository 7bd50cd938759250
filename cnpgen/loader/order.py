"""The order of a split's rows in one epoch: arithmetic in seed, epoch and the shards' sizes; nothing is stored.

The shards are permuted and dealt out to windows of about 2^18 rows; within a window the rows of all its shards are
permuted together. A split of less than a window and a half is therefore shuffled uniformly as a whole; in larger ones
rows of one shard stay within one window of their epoch. Every epoch deals the shards out anew.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

WINDOW_ROWS = 1 << 18


@dataclass(frozen=True)
class Window:
    """Shards whose rows are shuffled together.

    Attributes:
        first: Position of its first row in the epoch.
        rows: Number of rows.
        shards: Numbers of its shards within the split, in the order in which they are laid out.
    """

    first: int
    rows: int
    shards: tuple[int, ...]


@dataclass(frozen=True)
class Order:
    """The order of one epoch.

    Attributes:
        split: Name of the split; splits are shuffled independently.
        shard_rows: Rows of every shard of the split.
        seed: Seed of all epochs, not negative.
        epoch: Number of the epoch, not negative.
        shuffle: Whether to shuffle at all; else rows come as they are stored.
    """

    split: str
    shard_rows: tuple[int, ...]
    seed: int
    epoch: int
    shuffle: bool = True

    @cached_property
    def windows(self) -> tuple[Window, ...]:
        """The windows of the epoch, in order."""
        shards = self._permuted(len(self.shard_rows), stage=0)
        count = min(max(round(sum(self.shard_rows) / WINDOW_ROWS), 1), max(len(shards), 1))
        windows, first = [], 0
        for dealt in np.array_split(shards, count):
            rows = sum(self.shard_rows[shard] for shard in dealt)
            windows.append(Window(first, rows, tuple(dealt.tolist())))
            first += rows
        return tuple(windows)

    def rows_of(self, window: int) -> NDArray[np.int64]:
        """Return the order of a window's rows: numbers of rows in its shards laid end to end, shape (rows,)."""
        return self._permuted(self.windows[window].rows, stage=1 + window)

    def _permuted(self, size: int, *, stage: int) -> NDArray[np.int64]:
        if not self.shuffle:
            return np.arange(size)
        words = np.frombuffer(hashlib.sha256(self.split.encode()).digest(), "<u4").tolist()
        return permutation(size, seed=self.seed, key=(*words, self.epoch, stage))


def permutation(size: int, *, seed: int, key: tuple[int, ...]) -> NDArray[np.int64]:
    """Return a uniformly random permutation that no later NumPy changes.

    NumPy keeps the raw numbers of a bit generator for ever, but not what ``Generator.permutation`` makes of them. Here
    the rows are sorted by raw numbers whose last bits are replaced by the number of the row; up to 2^20 rows, 44 bits
    stay random, so that ties, which go to the lower number, do not matter.

    Args:
        size: Number of rows.
        seed: Seed, not negative.
        key: Which of the seed's permutations; integers that are not negative.

    Returns:
        The numbers from 0 to ``size - 1``, shape (size,).
    """
    raw = np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)).random_raw(size)
    mask = np.uint64((1 << max(size - 1, 1).bit_length()) - 1)
    keys = (raw & ~mask) | np.arange(size, dtype=np.uint64)
    keys.sort()
    return (keys & mask).view(np.int64)
