"""The bridge to torch: batches and rows as tensors on NumPy's memory, the loss as a differentiable function."""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from numpy.typing import DTypeLike
from torch.autograd.function import once_differentiable
from torch.utils import data

from cnpgen.loader.batch import Batch
from cnpgen.loader.batches import Batches
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.normalization import Normalization

if TYPE_CHECKING:
    from cnpgen.losses.plan_loss import PlanLoss

Tensors = dict[str, torch.Tensor]
T = TypeVar("T")


def to_torch(batch: Batch) -> Tensors:
    """Give a batch as tensors: views of one tensor, ``table`` of the batch, so that they travel together.

    Returns:
        Field name -> values, shape (B, width) or (B,).
    """
    table = torch.from_numpy(batch.table)
    parts = {n: part.start if n in batch.layout.scalars else part for n, part in batch.columns.items()}
    return {n: table[:, parts[n]] if n in parts else torch.from_numpy(batch.integers[n]) for n in batch}


class BatchDataset(data.IterableDataset[Tensors]):  # type: ignore[misc]
    """Batches for a ``DataLoader(..., batch_size=None)``: every loop gives the rest of an epoch.

    With DataLoader workers the order is the same, but every worker has a copy of the position: call
    :meth:`set_epoch` before every epoch. As each worker reads all shards, they cost more than they bring.

    Args:
        batches: What ``dataset.batches(...)`` returned.
    """

    def __init__(self, batches: Batches) -> None:
        super().__init__()
        self.batches = batches
        self._told = torch.tensor(-1).share_memory_()  # the epoch, where workers that live on see it change

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[Tensors]:
        worker = data.get_worker_info()
        if worker is None:
            return map(to_torch, self.batches)
        if int(self._told) not in (-1, self.batches.epoch):
            self.batches.epoch = int(self._told)
        return map(to_torch, self.batches.for_worker(worker.id, worker.num_workers))

    def set_epoch(self, epoch: int) -> None:
        """Begin an epoch, here and in all workers; where it is the present one, go on in it."""
        if self.batches.epoch != epoch:
            self.batches.epoch = epoch
        self._told.fill_(epoch)


class RowDataset(data.Dataset[Tensors]):  # type: ignore[misc]
    """Rows at random, for torch's samplers; slower than :class:`BatchDataset`.

    ``DataLoader(rows, batch_size=1024, shuffle=True, collate_fn=rows.collate)`` reads a batch at once; without
    ``collate_fn`` torch would look for single rows.

    Args:
        dataset: The dataset.
        split: Name of the split.
        fields: Which fields; by default all fields of numbers that are not diagnostics.
        normalize: Whether to normalise, or what with instead of the dataset's own normalisation.
        dtype: Type of the fields of numbers.
    """

    def __init__(
        self,
        dataset: Dataset,
        split: str = "train",
        *,
        fields: Iterable[str] | None = None,
        normalize: bool | Normalization = True,
        dtype: DTypeLike = "float32",
    ) -> None:
        self._dataset, self._split = dataset, split
        self._length = len(dataset[split])
        self._fields = None if fields is None else list(fields)
        self._normalize, self._dtype = normalize, dtype

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> Tensors:
        return {name: values[0] for name, values in self.__getitems__([index]).items()}

    def __getitems__(self, indices: Sequence[int]) -> Tensors:
        rows = self._dataset.rows(
            self._split, indices, fields=self._fields, normalize=self._normalize, dtype=self._dtype
        )
        return {name: torch.from_numpy(values) for name, values in rows.items()}

    @staticmethod
    def collate(batch: T) -> T:
        """Leave a batch as it is: it was read as one."""
        return batch


def plan_loss(
    loss: "PlanLoss",
    path: torch.Tensor,
    rate: torch.Tensor,
    *,
    weights: torch.Tensor,
    **options: Any,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Evaluate a loss of N plans, differentiably (once) in control points and weights, on the CPU.

    Args:
        loss: The loss; its ``dtype`` is the precision of values and gradients.
        path: Path control points [rad], shape (N, C, n), on any device.
        rate: Rate control points [1/s], shape (N, R), positive.
        weights: Weight of every constraint term (e^alpha), shape (m,).
        options: ``tops``, ``start_tip``, ``shift`` of :class:`cnpgen.losses.plan_loss.PlanLoss`; constants.

    Returns:
        The totals, shape (N,), and the integrals without weights, shape (N, 1 + m), which have no gradient.

    Raises:
        UsageError: A shape is wrong, or a weight is negative or not finite.
    """
    total, terms = _PlanLoss.apply(loss, options, path, rate, weights)
    return total, terms


class _PlanLoss(torch.autograd.Function):  # type: ignore[misc]
    """The loss computes its gradient along with its value: backward only scales it."""

    @staticmethod
    def forward(
        ctx: Any, loss: "PlanLoss", options: dict[str, Any], *arguments: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        path, rate, weights = arguments
        given = {name: _host(value) for name, value in options.items()}
        wanted = any(ctx.needs_input_grad[2:4])
        value = loss(_host(path), _host(rate), weights=_host(weights), gradient=wanted, **given)
        total, terms = (torch.from_numpy(part).to(path) for part in (value.total, value.terms))
        ctx.save_for_backward(*(torch.from_numpy(part) for part in (value.path_gradient, value.rate_gradient)), terms)
        ctx.like = path.new_empty(0), rate.new_empty(0), weights.new_empty(0)
        ctx.mark_non_differentiable(terms)
        return total, terms

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, by_total: torch.Tensor, _: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        by_path, by_rate, terms = ctx.saved_tensors
        like_path, like_rate, like_weights = ctx.like
        path, rate, weights = ctx.needs_input_grad[2:]
        return (
            None,
            None,
            by_path.to(like_path) * by_total.to(like_path)[:, None, None] if path else None,
            by_rate.to(like_rate) * by_total.to(like_rate)[:, None] if rate else None,
            (by_total @ terms[:, 1:]).to(like_weights) if weights else None,
        )


def _host(value: Any) -> Any:
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
