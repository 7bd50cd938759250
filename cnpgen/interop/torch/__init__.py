"""The bridge to torch: batches and rows as tensors in NumPy's memory, plans and their loss with gradients."""

from cnpgen.errors import requires_extra

with requires_extra("torch", "torch"):
    from cnpgen.interop.torch.torch_batches import BatchDataset, TensorBatch, to_torch
    from cnpgen.interop.torch.torch_plans import control_points, plan_loss
    from cnpgen.interop.torch.torch_rows import RowDataset

__all__ = ["BatchDataset", "RowDataset", "TensorBatch", "control_points", "plan_loss", "to_torch"]
