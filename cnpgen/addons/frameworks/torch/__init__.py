"""The bridge to torch: batches and rows as tensors in NumPy's memory, plans, robots and losses with gradients."""

from cnpgen.errors import requires_extra

# Without this index, pip installs 4 GB of libraries for CUDA.
_CPU_INDEX = " --extra-index-url https://download.pytorch.org/whl/cpu"

with requires_extra("torch", "torch", _CPU_INDEX):
    from cnpgen.addons.frameworks.torch.tensor_boundary_layer import TensorBoundaryLayer
    from cnpgen.addons.frameworks.torch.tensor_loss import TensorLoss
    from cnpgen.addons.frameworks.torch.tensor_robot import TensorRobot
    from cnpgen.addons.frameworks.torch.tensor_splines import (
        joint_states,
        spline_derivatives,
    )
    from cnpgen.addons.frameworks.torch.torch_batches import (
        BatchDataset,
        TensorBatch,
        to_torch,
    )
    from cnpgen.addons.frameworks.torch.torch_plans import control_points, plan_loss
    from cnpgen.addons.frameworks.torch.torch_rows import RowDataset

__all__ = [
    "BatchDataset",
    "RowDataset",
    "TensorBatch",
    "TensorBoundaryLayer",
    "TensorLoss",
    "TensorRobot",
    "control_points",
    "joint_states",
    "plan_loss",
    "spline_derivatives",
    "to_torch",
]
