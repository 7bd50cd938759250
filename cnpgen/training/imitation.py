"""Imitation: how far control points are from those of demonstrations, and the gradient of that."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.losses.plan_loss import LossValue
from cnpgen.planner.control_points import ControlPoints

Array = NDArray[Any]


def imitation_loss(points: ControlPoints, shown: ControlPoints) -> LossValue:
    """Half the squared distances of path control points [rad^2] and of the logarithms of rate control points.

    Args:
        points: Control points of N motions.
        shown: Those of their demonstrations.

    Returns:
        Distances as ``total``, and as the only column of ``terms``; their gradients.
    """
    by_path = points.path - shown.path
    logs = np.log(points.rate / shown.rate)
    total = 0.5 * (np.einsum("ijk,ijk->i", by_path, by_path) + np.einsum("ij,ij->i", logs, logs))
    return LossValue(total, total[:, None], by_path, logs / points.rate)
