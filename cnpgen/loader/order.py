"""The order of the rows of a split in one epoch, computed from seed, epoch and shard sizes; nothing is stored.

In every epoch, the shards are permuted and distributed over windows of about 2^18 rows. Within a window, the rows of
all its shards are permuted together. A split of less than 1.5 windows is therefore shuffled uniformly. In larger
splits, the rows of a shard stay within one window per epoch.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

WINDOW_ROWS = 1 << 18


@dataclass(frozen=True)
class Window:
    """Shards, by their index in the split, whose rows are shuffled together, from a position in the epoch on."""

    first: int
    rows: int
    shards: tuple[int, ...]


@dataclass(frozen=True)
class Order:
    """The order of one epoch of a split with shards of some rows; splits are shuffled independently."""

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
        for members in np.array_split(shards, count):
            rows = sum(self.shard_rows[shard] for shard in members)
            windows.append(Window(first, rows, tuple(members.tolist())))
            first += rows
        return tuple(windows)

    def rows_of(self, window: int) -> NDArray[np.int64]:
        """Return the order of the rows of a window: indices into the concatenated rows of its shards, shape (rows,)."""
        return self._permuted(self.windows[window].rows, stage=1 + window)

    def _permuted(self, size: int, *, stage: int) -> NDArray[np.int64]:
        if not self.shuffle:
            return np.arange(size)
        words = np.frombuffer(hashlib.sha256(self.split.encode()).digest(), "<u4").tolist()
        return permutation(size, seed=self.seed, key=(*words, self.epoch, stage))


def permutation(size: int, *, seed: int, key: tuple[int, ...]) -> NDArray[np.int64]:
    """Return a uniformly random permutation, shape (size,), that does not depend on the version of NumPy.

    NumPy guarantees the raw output of bit generators, but not that of ``Generator.permutation``. The rows are sorted by
    raw random numbers, the last bits of which are replaced by the row index. For up to 2^20 rows, 44 bits remain
    random, so ties are negligible. Seed and key are not negative.
    """
    raw = np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)).random_raw(size)
    mask = np.uint64((1 << max(size - 1, 1).bit_length()) - 1)
    keys = (raw & ~mask) | np.arange(size, dtype=np.uint64)
    keys.sort()
    return (keys & mask).view(np.int64)
