"""Step losses: the task loss, and Huber's function of the violation of a constraint.

A condition ``lower <= g <= upper`` has the violation ``e = g - min(max(g, lower), upper)``. ``Huber(e)`` is the paper's
``Huber(ReLU(.))`` of an inequality and its ``Huber(d)`` of an equality (paper, section on loss functions). Its
derivative is e clipped to [-1, 1].
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.linalg import dot
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.problems.constraints.constraint import Condition
from cnpgen.problems.objectives import ObjectiveTerm


@dataclass(frozen=True)
class Term:
    """A step loss.

    Attributes:
        value: The loss, an SX scalar.
        parts: Pairs of an SX scalar and the derivative of the loss with respect to it.
    """

    value: Any
    parts: list[tuple[Any, Any]]


def task_term(state: SymbolicState, objective: Sequence[ObjectiveTerm]) -> Term:
    """Return the step loss of the objective: ``1 + sum of weight_i size_i``; ``1 + eta kappa v^2`` in the paper.

    Args:
        state: The state.
        objective: Terms in addition to the duration.
    """
    import casadi as ca

    value, parts = ca.SX(1), []
    for term in objective:
        residuals = term.training_residuals(state)
        squares = dot(residuals, residuals)
        smoothing = term.smoothing if term.training_smoothing is None else term.training_smoothing
        if smoothing > 0:
            size = ca.sqrt(squares + smoothing**2) - smoothing
            parts.append((size, term.weight))
        else:
            size = squares
            parts += [(e, 2 * term.weight * e) for e in residuals]
        value += term.weight * size
    return Term(value, parts)


def constraint_term(conditions: Sequence[Condition], factor: Any, inset: Any, relaxation: Sequence[Any]) -> Term:
    """Return the sum of Huber's losses of all conditions of a constraint.

    Args:
        conditions: The conditions.
        factor: Factor of limits; bounds that are not symmetric to zero shrink toward their center.
        inset: Distance by which other bounds are moved inwards; equalities are unchanged.
        relaxation: Distance by which the bounds of every value are moved outwards, or None.
    """
    import casadi as ca

    value, parts = ca.SX(0), []
    for (g, lower, upper), width in zip(_bounded(conditions, factor, inset), relaxation, strict=True):
        nearest = g
        if lower is not None:
            nearest = ca.fmax(nearest, lower if width is None else lower - width)
        if upper is not None:
            nearest = ca.fmin(nearest, upper if width is None else upper + width)
        derivative = ca.fmin(ca.fmax(g - nearest, -1), 1)
        value += derivative * (g - nearest - 0.5 * derivative)
        parts.append((g, derivative))
    return Term(value, parts)


def _bounded(conditions: Sequence[Condition], factor: Any, inset: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield values with their tightened bounds, None for a missing bound."""
    for condition in conditions:
        for g, low, high in zip(condition.g, condition.lower.tolist(), condition.upper.tolist(), strict=True):
            if low == high:
                yield g, low, high
            elif condition.tolerance_kind != "limit":
                yield g, low + inset if np.isfinite(low) else None, high - inset if np.isfinite(high) else None
            elif np.isfinite(low) and np.isfinite(high):
                center, half = (low + high) / 2, (high - low) / 2
                yield g, center - half * factor, center + half * factor
            else:
                reduction = 1 - factor
                yield (
                    g,
                    low + abs(low) * reduction if np.isfinite(low) else None,
                    high - abs(high) * reduction if np.isfinite(high) else None,
                )
