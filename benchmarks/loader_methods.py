"""Methods of reading a dataset in batches: cnpgen, an array in memory as upper bound, torch and h5py.

A method yields normalized, C-contiguous float32 tables of shape (B, D); all yield the same rows.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.loader import windows
from cnpgen.loader.batches import Batches
from cnpgen.loader.dataset import Dataset

Tables = Iterator[NDArray[np.float32]]


@dataclass
class Method:
    """One method with its measurements.

    Attributes:
        name: Description.
        order: Extent of the shuffling; only methods of the same order are comparable.
        read: Function that yields the tables.
        rows: Rows per repetition; fewer than all for slow methods.
        tolerance: Maximum error of the mean of a column [standard deviations]; None for raw rows.
        walls: Rows per second, one per repetition.
        cpus: Rows per second of CPU time of all processes.
    """

    name: str
    order: str
    read: Callable[[], Tables]
    rows: int
    tolerance: float | None = 0.005
    walls: list[float] = field(default_factory=list)
    cpus: list[float] = field(default_factory=list)


@dataclass(eq=False)
class Reader:
    """The training rows of a dataset, read by several methods.

    Attributes:
        dataset: The dataset.
        batch_size: Rows per batch.
    """

    dataset: Dataset
    batch_size: int

    @cached_property
    def rows(self) -> int:
        """Number of rows in complete batches."""
        rows = self.dataset.splits["train"]
        return rows - rows % self.batch_size

    @cached_property
    def table(self) -> NDArray[np.float32]:
        """All rows, packed and normalized, shape (rows, D)."""
        arrays = self.dataset.arrays("train", normalize=True, dtype="float32")
        return np.concatenate(
            [values.reshape(len(values), -1) for values in arrays.values()], axis=1
        )

    @cached_property
    def names(self) -> list[str]:
        """The fields that are read."""
        return list(self.dataset["train"][0])

    def take(self) -> Tables:
        """Take rows of the table in memory, an upper bound."""
        order = np.random.default_rng(0).permutation(len(self.table))
        for first in range(0, self.rows, self.batch_size):
            yield self.table.take(order[first : first + self.batch_size], axis=0)

    def shards(self) -> Tables:
        """Read whole shards with h5py, not normalized."""
        import h5py

        for shard in self.dataset.shards["train"]:
            with h5py.File(shard.path) as file:
                yield np.concatenate(
                    [file[name][()].reshape(shard.rows, -1) for name in self.names],
                    axis=1,
                )

    @cached_property
    def in_memory(self) -> Batches:
        """Batches of a split that stays in memory after its first epoch."""
        return self.dataset.batches(self.batch_size)

    def batches(self) -> Tables:
        """Read the batches of the next epoch with cnpgen."""
        return (batch.table for batch in self.in_memory)

    def streamed(self, **options: Any) -> Tables:
        """Read batches with cnpgen from the files in every epoch, as for a split that exceeds the memory limit."""
        limit, windows.MAX_IN_MEMORY_BYTES = windows.MAX_IN_MEMORY_BYTES, 0
        try:
            yield from (
                batch.table
                for batch in self.dataset.batches(self.batch_size, **options)
            )
        finally:
            windows.MAX_IN_MEMORY_BYTES = limit

    def torch_batches(self, workers: int) -> Tables:
        """Read cnpgen's batches through a torch DataLoader."""
        from torch.utils.data import DataLoader

        from cnpgen.interop.torch import BatchDataset

        for batch in DataLoader(
            BatchDataset(self.in_memory), batch_size=None, num_workers=workers
        ):
            yield batch.table.numpy()

    def torch_rows(self, workers: int) -> Tables:
        """Read rows batch by batch from memory maps, in the order of torch's own sampler."""
        from torch.utils.data import DataLoader

        from cnpgen.interop.torch import RowDataset

        rows = RowDataset(self.dataset)
        return self._packed(
            DataLoader(
                rows,
                self.batch_size,
                shuffle=True,
                collate_fn=rows.collate,
                num_workers=workers,
            )
        )

    def torch_per_row(self, workers: int) -> Tables:
        """Read row by row with h5py from open files."""
        from torch.utils.data import DataLoader

        rows = PerRow(self.dataset, self.names)
        return self._packed(
            DataLoader(rows, self.batch_size, shuffle=True, num_workers=workers)
        )

    @staticmethod
    def _packed(loader: Any) -> Tables:
        """Concatenate the tensors of a batch."""
        for batch in loader:
            yield np.concatenate(
                [values.numpy().reshape(len(values), -1) for values in batch.values()],
                axis=1,
            )


class PerRow:
    """A map-style dataset of single rows, read with h5py and normalized one by one.

    Args:
        dataset: The dataset.
        names: The fields.
    """

    def __init__(self, dataset: Dataset, names: list[str]) -> None:
        shards = dataset.shards["train"]
        self.paths, self.ends = (
            [shard.path for shard in shards],
            np.cumsum([shard.rows for shard in shards]),
        )
        self.names, self.length = names, dataset.splits["train"]
        means, scales = dataset.normalization.mean, dataset.normalization.scale  # type: ignore[union-attr]
        self.scaling = {
            name: (means[name].astype("f4"), scales[name].astype("f4"))
            for name in names
        }
        self.files: dict[int, Any] = {}

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, row: int) -> dict[str, NDArray[np.float32]]:
        import h5py

        shard = int(np.searchsorted(self.ends, row, side="right"))
        if shard not in self.files:
            self.files[shard] = h5py.File(self.paths[shard])
        file, local = self.files[shard], row - (self.ends[shard - 1] if shard else 0)
        return {
            name: ((np.atleast_1d(file[name][local]) - mean) * scale).astype("f4")
            for name, (mean, scale) in self.scaling.items()
        }
