"""What both bridges of the loss have in common: its values and slopes on the host, where no plan touches another."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.losses.plan_loss import PlanLoss

Array = NDArray[Any]


def evaluate(
    loss: PlanLoss, path: Array, rate: Array, weights: Array, *, gradient: bool, **options: Any
) -> tuple[Array, Array, Array, Array, Array]:
    """Evaluate N plans.

    A plan whose loss or gradient is not finite has slopes of 0: times the 0 that a caller's mask gives it, nan would
    stay nan, and reach every weight of the network that made the plans.

    Args:
        loss: The loss.
        path: Path control points [rad], shape (N, C, n).
        rate: Rate control points [1/s], shape (N, R).
        weights: Weight of every constraint term, shape (m,).
        gradient: Whether the slopes along path and rate are wanted; else they are of no plan.
        options: ``tops``, ``start_tip`` and ``shift`` of the loss.

    Returns:
        Totals, terms, and the slopes of the totals along path, rate and weights, shape (N, m).
    """
    value = loss(path, rate, weights=weights, gradient=gradient, **options)
    slopes = value.path_gradient, value.rate_gradient, value.terms[:, 1:].copy()
    good = np.isfinite(value.total)
    for slope in slopes[: 2 if gradient else 0]:
        good &= np.isfinite(slope).all(axis=tuple(range(1, slope.ndim)))
    for slope in slopes:
        slope[~good[: len(slope)]] = 0
    return value.total, value.terms, *slopes
