"""The bridge to torch: batches and rows as tensors on NumPy's memory, plans and their loss with gradients."""

from cnpgen.interop.torch.batches import BatchDataset, TensorBatch, to_torch
from cnpgen.interop.torch.plans import control_points, plan_loss
from cnpgen.interop.torch.rows import RowDataset

__all__ = ["BatchDataset", "RowDataset", "TensorBatch", "control_points", "plan_loss", "to_torch"]
