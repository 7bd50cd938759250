"""Cost terms in addition to the duration: centrifugal acceleration, effort or jerk, as residuals with derivatives."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState, time_derivatives
from cnpgen.problems.problem import Problem

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
Kind = Literal["centrifugal", "effort", "jerk"]

OBJECTIVES: dict[str, Kind] = {"time": "centrifugal", "effort": "effort", "jerk": "jerk"}
ACCELERATION_SMOOTHING_M_S2 = 0.5  # the cost of smaller accelerations is quadratic: its gradient is continuous
SPEED_SMOOTHING_M2_S2 = 1e-4  # defines the direction of a tip at rest


@dataclass(frozen=True)
class CostTerm:
    """Term ``weight * integral of rho(e(q, dq, ddq, jerk)) over time`` of the objective.

    Attributes:
        kind: "centrifugal": e is the tip's acceleration across its velocity [m/s^2] and rho its norm (paper, Appendix
            B); "effort": torques as fractions of their limits and "jerk": jerks as fractions of their limits, rho the
            sum of squares.
        weight: Weight relative to the time [s^2/m] or [1].
    """

    kind: Kind
    weight: float

    def rate(self, e: Array) -> tuple[Array, Array]:
        """Evaluate rho and its curvature.

        Args:
            e: Residuals, shape (m, K).

        Returns:
            ``(rho, weight)``, shape (K,) each: ``weight * e`` is the gradient of rho in e, and ``weight`` times the
            identity bounds its Hessian from above.
        """
        squares = np.sum(e * e, axis=0)
        if self.kind != "centrifugal":
            return squares, np.full(squares.shape, 2.0)
        size = np.sqrt(squares + ACCELERATION_SMOOTHING_M_S2**2)
        return size - ACCELERATION_SMOOTHING_M_S2, 1.0 / size


def choose_cost_term(problem: Problem, objective: str = "time", weight: float | None = None) -> CostTerm | None:
    """Return the cost term of an objective, or None if its weight is 0.

    Args:
        problem: The problem.
        objective: One of ``OBJECTIVES``; "time" is the problem's own objective: time and centrifugal acceleration.
        weight: Weight of the term; by default the problem's for the centrifugal acceleration and 1 for the others.
    """
    kind = OBJECTIVES[objective]
    default = problem.objective.centrifugal if kind == "centrifugal" else 1.0
    chosen = default if weight is None else weight
    return CostTerm(kind, chosen) if chosen > 0 else None


def cost_term_residuals(robot: "Robot", kind: Kind) -> Any:
    """Build ``w -> (e, de/dw)`` with ``w = (p, p', p'', p''', r, r', r'')``, the Jacobian column by column."""
    import casadi as ca

    n = robot.n
    w_sx, w = symbols("w", 4 * n + 3)
    p, *path = (w[order * n : (order + 1) * n] for order in range(4))
    dq, ddq, jerk = time_derivatives(path, w[4 * n :])
    if kind == "jerk":
        e = [x / float(limit) for x, limit in zip(jerk or (), robot.jerk_limit, strict=True)]
    else:
        state = SymbolicState(robot, p, dq, ddq, [], (), None)
        e = _centrifugal_acceleration(state) if kind == "centrifugal" else _torque_fractions(state)
    residuals = ca.vertcat(*e)
    jacobian = ca.densify(ca.jacobian(residuals, w_sx))
    return ca.Function(f"cost_term_{kind}", [w_sx], ca.cse([residuals, ca.vec(jacobian)]))


def _centrifugal_acceleration(state: SymbolicState) -> list[Any]:
    """Return the acceleration of the tip across its velocity, of norm kappa v^2."""
    v, a = state.tip_velocity, state.tip_acceleration
    along = sum(x * y for x, y in zip(v, a, strict=True)) / (sum(x * x for x in v) + SPEED_SMOOTHING_M2_S2)
    return [y - along * x for x, y in zip(v, a, strict=True)]


def _torque_fractions(state: SymbolicState) -> list[Any]:
    return [tau / float(limit) for tau, limit in zip(state.torque, state.robot.torque_limit, strict=True)]
