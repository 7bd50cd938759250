"""Batches as tensors on NumPy's memory, alone and through a ``DataLoader``."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch.utils import data

from cnpgen.errors import UsageError
from cnpgen.loader.batch import Batch
from cnpgen.loader.batches import Batches
from cnpgen.loader.columns import Columns
from cnpgen.loader.normalization import Normalization

MOST_WORKERS = 1024


class TensorBatch(dict[str, torch.Tensor]):
    """A batch as tensors, by field; those of numbers are views of one packed table.

    Args:
        table: The fields of numbers side by side, shape (B, D).
        layout: Which fields there are and where.
        integers: The fields of integers, shape (B, width) or (B,).
        normalization: What the fields of numbers were normalised with; None if they are in their units.

    Attributes:
        table: The packed table: what a network that wants everything side by side takes.
        layout: Which fields there are and where.
        normalization: As it was given.
    """

    def __init__(
        self,
        table: torch.Tensor,
        layout: Columns,
        integers: Mapping[str, torch.Tensor],
        normalization: Normalization | None = None,
    ) -> None:
        parts = {name: part.start if name in layout.scalars else part for name, part in layout.slices.items()}
        names = (field.name for field in layout.fields)
        super().__init__({name: table[:, parts[name]] if name in parts else integers[name] for name in names})
        self.table, self.layout, self.normalization = table, layout, normalization

    @property
    def columns(self) -> dict[str, slice]:
        """Field name -> its columns of the table."""
        return self.layout.slices

    def to(self, device: torch.device | str | int, *, non_blocking: bool = False) -> "TensorBatch":
        """Bring a batch to a device: the table in one transfer, and views of it there."""
        there = {"device": device, "non_blocking": non_blocking}
        integers = {field.name: self[field.name].to(**there) for field in self.layout.integers}
        return TensorBatch(self.table.to(**there), self.layout, integers, self.normalization)

    def update(self, *fields: Any, **more: torch.Tensor) -> None:
        """Replace fields by others of the same shape: a batch has the rows of its table.

        Raises:
            UsageError: A shape is another one. So is that of batches which torch's ``default_collate`` has stacked.
        """
        new = dict(*fields, **more)
        for name, values in new.items():
            if name in self and values.shape != self[name].shape:
                raise UsageError(
                    f"field {name!r} of a batch must keep its shape {tuple(self[name].shape)}, got"
                    f" {tuple(values.shape)}: these are batches already, give the DataLoader of a BatchDataset"
                    " batch_size=None"
                )
        super().update(new)

    def __repr__(self) -> str:
        kind = f"{self.table.dtype} on {self.table.device}"
        return f"<batch of {len(self.table)} rows, {kind}: {self.layout.summary}>"


def to_torch(batch: Batch) -> TensorBatch:
    """Give a batch as tensors on its own memory."""
    integers = {name: torch.from_numpy(values) for name, values in batch.integers.items()}
    return TensorBatch(torch.from_numpy(batch.table), batch.layout, integers, batch.normalization)


class BatchDataset(data.IterableDataset[TensorBatch]):  # type: ignore[misc]
    """Batches as tensors: every loop gives the rest of an epoch. Use it as it is, or in a ``DataLoader``.

    Its ``state_dict`` says where it is, to the batch. Trainers that look for one (Lightning) save it in their
    checkpoints and resume there.

    A ``DataLoader`` needs ``batch_size=None``. With workers the order is the same, and every loop begins the next
    epoch, also after one that was left early; workers that live on are told of it by :meth:`set_epoch`, but not of a
    state that is loaded later. As each worker reads all shards, they cost more than they bring.

    Args:
        batches: What ``dataset.batches(...)`` returned.
    """

    def __init__(self, batches: Batches) -> None:
        super().__init__()
        self.batches = batches
        # Workers have copies of the position, which may end with them. So each notes in shared memory which epoch it
        # has to give next, and how often the position had been set when it did: a position set later counts instead.
        if batches.notes is None:
            batches.notes = torch.full((MOST_WORKERS, 2), -1).share_memory_()
        self._notes = batches.notes  # a worker's copy of the batches may come without

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[TensorBatch]:
        worker = data.get_worker_info()
        if worker is None:
            return map(to_torch, self.batches)
        mine, batches = self._notes[worker.id], self.batches
        epoch, times_set = mine.tolist()
        if epoch in {-1, batches.epoch} or times_set not in {-1, batches.times_set}:
            epoch = None
        part = batches.for_worker(worker.id, worker.num_workers, epoch=epoch)
        mine.copy_(torch.tensor([part.epoch + 1, batches.times_set]))
        return map(to_torch, part)

    def set_epoch(self, epoch: int) -> None:
        """Begin an epoch, here and in all workers; where it is the present one, go on in it."""
        if self.batches.epoch != epoch:
            self.batches.epoch = epoch
        self._notes.copy_(torch.tensor([epoch, -1]))

    def state_dict(self) -> dict[str, Any]:
        """Say where it is: after the last batch handed out, as ``Batches.state`` does.

        Raises:
            UsageError: Workers took the batches, so that nobody here knows which of them were used.
        """
        if data.get_worker_info() is not None:
            raise UsageError("the worker of a DataLoader cannot say which batches were used: leave num_workers at 0")
        return self.batches.state()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to where ``state_dict`` was called: the next loop begins with the batch after it.

        Raises:
            UsageError: This is not the state of a loader, or from there on the last batch has fewer rows than ranks.
            DatasetError: It is of another dataset or split.
        """
        self.batches.load_state(state)
