"""Step losses: the task loss, and Huber's function of the violation of a constraint.

A condition ``lower <= g <= upper`` has the violation ``e = g - min(max(g, lower), upper)``. ``Huber(e)`` is the paper's
``Huber(ReLU(.))`` of an inequality and its ``Huber(d)`` of an equality (paper, section on loss functions). Its
derivative is e clipped to [-1, 1].
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.dynamics import acceleration_at, body_motions
from cnpgen.kernels.symbolic.linalg import cross, dot
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.problems.constraints.constraint import Condition

CENTRIFUGAL_SMOOTHING_M_S2 = 0.05  # below, the centrifugal term is quadratic, so that its gradient is continuous
MIN_SQUARED_SPEED_M2_S2 = 1e-4  # keeps the direction of a tip at rest defined


@dataclass(frozen=True)
class Term:
    """A step loss.

    Attributes:
        value: The loss, an SX scalar.
        parts: Pairs of an SX scalar and the derivative of the loss with respect to it.
    """

    value: Any
    parts: list[tuple[Any, Any]]


def task_term(state: SymbolicState, eta: float) -> Term:
    """Return ``1 + eta kappa v^2`` (paper, Appendix B, eta).

    Args:
        state: The state.
        eta: Weight of the tip's centrifugal acceleration relative to the time [s^2/m].
    """
    import casadi as ca

    if eta == 0:
        return Term(ca.SX(1), [])
    v = state.tip_velocity
    across = cross(v, _tip_acceleration(state))
    square = dot(across, across) / (dot(v, v) + MIN_SQUARED_SPEED_M2_S2)
    size = ca.sqrt(square + CENTRIFUGAL_SMOOTHING_M_S2**2) - CENTRIFUGAL_SMOOTHING_M_S2
    return Term(1 + eta * size, [(size, eta)])


def _tip_acceleration(state: SymbolicState) -> list[Any]:
    """Return the acceleration of the tip [m/s^2] by the recursion of the inverse dynamics, for a third of the cost."""
    chain = state.robot.chain
    last = body_motions(chain, state.q, state.dq, state.ddq)[-1]
    without_gravity = acceleration_at(last.acceleration, last.omega, last.alpha, chain.tip_translation.tolist())
    rotation = [[dot(row, column) for column in chain.tip_rotation.tolist()] for row in state.kinematics.rotation]
    return [dot(row, without_gravity) + g for row, g in zip(rotation, chain.gravity.tolist(), strict=True)]


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
