"""Evaluation of the loss and its gradients on the host, for the bridges to torch and JAX."""

from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.losses.plan_loss import PlanLoss


def evaluate(
    loss: PlanLoss,
    path: AnyArray,
    rate: AnyArray,
    weights: AnyArray,
    *,
    gradient: bool,
    **options: Any,
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray, AnyArray]:
    """Evaluate N plans.

    A plan whose loss or gradient is not finite has gradients of 0. A gradient of nan
    would stay nan when a mask multiplies it by 0, and would reach every weight of the
    network.

    Args:
        loss: The loss.
        path: Path control points [rad], shape (N, C, n).
        rate: Rate control points [1/s], shape (N, R).
        weights: Weight of every constraint term, shape (m,).
        gradient: Whether to compute the gradients in path and rate; otherwise they are
            empty.
        options: ``obstacle_poses``, ``start_tip`` and ``shift`` of the loss.

    Returns:
        Totals, terms, and the gradients of the totals in path, rate and weights, the
        last of shape (N, m).
    """
    value = loss(path, rate, weights=weights, gradient=gradient, **options)
    gradients = value.path_gradient, value.rate_gradient, value.terms[:, 1:].copy()
    finite = np.isfinite(value.total)
    for array in gradients[: 2 if gradient else 0]:
        finite &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    for array in gradients:
        array[~finite[: len(array)]] = 0
    return value.total, value.terms, *gradients
