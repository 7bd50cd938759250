"""Step losses: the task's, and Huber's function of how far a state is outside a constraint.

A condition ``lower <= g <= upper`` is violated by ``e = g - min(max(g, lower), upper)``. ``Huber(e)`` is the paper's
``Huber(ReLU(.))`` of an inequality and its ``Huber(d)`` of an equality (paper, section on loss functions), its
derivative is e clipped to [-1, 1]: neither needs a branch.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.dynamics import body_motions, carried
from cnpgen.kernels.symbolic.linalg import cross, dot
from cnpgen.kernels.symbolic.state import SymbolicState
from cnpgen.problems.constraints.constraint import Condition

ROUNDED = 0.05  # m/s^2: below, the centrifugal acceleration counts quadratically, so that its gradient is continuous
SLOW = 1e-4  # m^2/s^2: keeps the direction of a tip at rest defined


@dataclass(frozen=True)
class Term:
    """A step loss.

    Attributes:
        value: The loss, an SX scalar.
        parts: Pairs of an SX scalar that it depends on and its derivative with respect to it.
    """

    value: Any
    parts: list[tuple[Any, Any]]


def task_term(state: SymbolicState, eta: float) -> Term:
    """Return ``1 + eta kappa v^2`` (paper, Appendix B, eta).

    Args:
        state: The state.
        eta: Weight of the tip's centrifugal acceleration beside the time [s^2/m].
    """
    import casadi as ca

    if eta == 0:
        return Term(ca.SX(1), [])
    v = state.tip_velocity
    across = cross(v, _tip_acceleration(state))
    size = ca.sqrt(dot(across, across) / (dot(v, v) + SLOW) + ROUNDED**2) - ROUNDED
    return Term(1 + eta * size, [(size, eta)])


def _tip_acceleration(state: SymbolicState) -> list[Any]:
    """Acceleration of the tip [m/s^2] from what the inverse dynamics computes anyway: a third of the operations."""
    chain = state.robot.chain
    last = body_motions(chain, state.q, state.dq, state.ddq)[-1]
    felt = carried(last.acceleration, last.omega, last.alpha, chain.tip_translation.tolist())
    rotation = [[dot(row, column) for column in chain.tip_rotation.tolist()] for row in state.kinematics.rotation]
    return [dot(row, felt) + g for row, g in zip(rotation, chain.gravity.tolist(), strict=True)]


def constraint_term(conditions: Sequence[Condition], factor: Any, inset: Any, wider: Sequence[Any]) -> Term:
    """Return the sum of Huber's losses of all conditions of a constraint.

    Args:
        conditions: The conditions.
        factor: What limits are multiplied with; bounds about a middle other than zero shrink towards it.
        inset: By how much other bounds are moved inwards; equalities are not.
        wider: For every value, by how much its bounds are moved outwards, or None.
    """
    import casadi as ca

    value, parts = ca.SX(0), []
    for (g, lower, upper), extra in zip(_bounded(conditions, factor, inset), wider, strict=True):
        nearest = g
        if lower is not None:
            nearest = ca.fmax(nearest, lower if extra is None else lower - extra)
        if upper is not None:
            nearest = ca.fmin(nearest, upper if extra is None else upper + extra)
        slope = ca.fmin(ca.fmax(g - nearest, -1), 1)
        value += slope * (g - nearest - 0.5 * slope)
        parts.append((g, slope))
    return Term(value, parts)


def _bounded(conditions: Sequence[Condition], factor: Any, inset: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield values with their tightened bounds, None where there is none."""
    for condition in conditions:
        for g, low, high in zip(condition.g, condition.lower.tolist(), condition.upper.tolist(), strict=True):
            if low == high:
                yield g, low, high
            elif condition.exactness != "limit":
                yield g, low + inset if np.isfinite(low) else None, high - inset if np.isfinite(high) else None
            elif np.isfinite(low) and np.isfinite(high):
                middle, half = (low + high) / 2, (high - low) / 2
                yield g, middle - half * factor, middle + half * factor
            else:
                slack = 1 - factor
                yield (
                    g,
                    low + abs(low) * slack if np.isfinite(low) else None,
                    high - abs(high) * slack if np.isfinite(high) else None,
                )
