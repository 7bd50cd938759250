"""Batches as tensors in NumPy's memory, with and without a ``DataLoader``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch.utils import data

from cnpgen.errors import UsageError, counted
from cnpgen.loader.batch import Batch
from cnpgen.loader.batches import Batches
from cnpgen.loader.row_format import Columns, Normalization

MAX_WORKERS = 1024


class TensorBatch(dict[str, torch.Tensor]):
    """A batch as tensors by field; fields of real numbers are views of one packed table.

    Args:
        table: Fields of real numbers in one array, shape (B, D).
        layout: Fields and their columns of the table.
        integers: Fields of integers, shape (B, width) or (B,).
        normalization: Normalization of the table, or None for physical units.

    Attributes:
        table: The packed table, for networks whose input is all fields.
        layout: Fields and their columns of the table.
        normalization: Normalization of the table, or None for physical units.
    """

    def __init__(
        self,
        table: torch.Tensor,
        layout: Columns,
        integers: Mapping[str, torch.Tensor],
        normalization: Normalization | None = None,
    ) -> None:
        parts = {
            name: part.start if name in layout.scalars else part
            for name, part in layout.slices.items()
        }
        names = (field.name for field in layout.fields)
        super().__init__(
            {
                name: table[:, parts[name]] if name in parts else integers[name]
                for name in names
            }
        )
        self.table = table
        self.layout = layout
        self.normalization = normalization

    @property
    def columns(self) -> dict[str, slice]:
        """Field name -> its columns of the table."""
        return self.layout.slices

    def to(
        self, device: torch.device | str | int, *, non_blocking: bool = False
    ) -> TensorBatch:
        """Copy a batch to a device, with one transfer of the table."""
        options = {"device": device, "non_blocking": non_blocking}
        integers = {
            field.name: self[field.name].to(**options) for field in self.layout.integers
        }
        return TensorBatch(
            self.table.to(**options), self.layout, integers, self.normalization
        )

    def update(self, *fields: Any, **more: torch.Tensor) -> None:
        """Replace fields by tensors of the same shape.

        Raises:
            UsageError: A shape differs, for example of batches that torch's
                ``default_collate`` has stacked.
        """
        new = dict(*fields, **more)
        for name, values in new.items():
            if name in self and values.shape != self[name].shape:
                raise UsageError(
                    f"field {name!r} of a batch must keep its shape {tuple(self[name].shape)}, got"
                    f" {tuple(values.shape)}: a BatchDataset yields batches, its DataLoader needs batch_size=None"
                )
        super().update(new)

    def __repr__(self) -> str:
        kind = f"{self.table.dtype} on {self.table.device}"
        return f"<batch of {counted(len(self.table), 'row')}, {kind}: {self.layout.summary}>"


def to_torch(batch: Batch) -> TensorBatch:
    """Return a batch as tensors that share its memory."""
    integers = {
        name: torch.from_numpy(values) for name, values in batch.integers.items()
    }
    return TensorBatch(
        torch.from_numpy(batch.table), batch.layout, integers, batch.normalization
    )


class BatchDataset(data.IterableDataset[TensorBatch]):  # type: ignore[misc]
    """Batches as tensors, for direct iteration or a ``DataLoader``.

    Every loop yields the remaining batches of an epoch. ``state_dict`` contains the
    position of the next batch. Trainers that support it (Lightning) save it in their
    checkpoints and resume there.

    A ``DataLoader`` needs ``batch_size=None``. With workers the order is the same.
    Every loop then starts the next epoch, even if the previous loop was left early.
    :meth:`set_epoch` reaches persistent workers; a state loaded later does not. Each
    worker reads all shards, so workers cost more time than they save.

    Args:
        batches: Batches from ``dataset.batches(...)``.
    """

    def __init__(self, batches: Batches) -> None:
        super().__init__()
        self.batches = batches
        # Workers have copies of the position that may end with them. Each therefore
        # stores in shared memory its next epoch and the number of times that the
        # position had been set by then: a position set later has priority.
        if batches.worker_positions is None:
            batches.worker_positions = torch.full((MAX_WORKERS, 2), -1).share_memory_()
        # A worker's copy of the batches may lack them.
        self._worker_positions = batches.worker_positions

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[TensorBatch]:
        worker = data.get_worker_info()
        if worker is None:
            return map(to_torch, self.batches)
        note = self._worker_positions[worker.id]
        batches = self.batches
        epoch, times_set = note.tolist()
        if epoch in {-1, batches.epoch} or times_set not in {-1, batches.times_set}:
            epoch = None
        part = batches.for_worker(worker.id, worker.num_workers, epoch=epoch)
        note.copy_(torch.tensor([part.epoch + 1, batches.times_set]))
        return map(to_torch, part)

    def set_epoch(self, epoch: int) -> None:
        """Start an epoch, here and in all workers.

        Continue it if it is the present one.
        """
        if self.batches.epoch != epoch:
            self.batches.epoch = epoch
        self._worker_positions.copy_(torch.tensor([epoch, -1]))

    def state_dict(self) -> dict[str, Any]:
        """Return the position after the last yielded batch; see ``Batches.state``.

        Raises:
            UsageError: The call is inside a worker, which cannot determine the batches
                that were used.
        """
        if data.get_worker_info() is not None:
            raise UsageError(
                "a worker of a DataLoader has no state of the batches that were used: set num_workers=0"
            )
        return self.batches.state()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a position: the next loop starts with the batch after it.

        Raises:
            UsageError: This is not the state of a loader, or the last batch after it
                has fewer rows than ranks.
            DatasetError: The state is of another dataset or split.
        """
        self.batches.load_state(state)
