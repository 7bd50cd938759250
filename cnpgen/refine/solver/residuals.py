"""All residuals of a problem at one phase of a motion, as SX functions of the splines there."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.state import HeldState, jerk_along
from cnpgen.problems.constraints.constraint import FINEST
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
DISTANCE = 0.1  # m
TOLERANCES = 20


def stage_values(robot: "Robot", problem: Problem) -> Any:
    """Build ``(w, tops) -> g`` with ``w = (p, p', p'', r, r')``: all residuals at one phase.

    With constraints of the jerk, ``w = (p, p', p'', p''', r, r', r'')``.
    """
    import casadi as ca

    columns, state, g = _stage(robot, problem)
    return ca.Function("stage_values", columns, state.released([ca.vertcat(*g)]))


def stage_jacobian(robot: "Robot", problem: Problem) -> Any:
    """Build ``(w, tops) -> (g, dg/dw)``, the Jacobian column by column."""
    import casadi as ca

    columns, state, g = _stage(robot, problem)
    residuals = ca.vertcat(*g)
    jacobian = ca.densify(ca.jacobian(residuals, columns[0]))
    outputs = ca.cse(state.released([residuals, ca.vec(jacobian)]))
    return ca.Function("stage_jacobian", columns, outputs)


def _stage(robot: "Robot", problem: Problem) -> tuple[list[Any], HeldState, list[Any]]:
    n, orders = robot.n, problem.path_orders
    (w_sx, w), (tops_sx, tops) = symbols("w", orders * n + orders - 1), symbols("tops", count_numbers(problem.obstacle))
    p, *path = (w[order * n : (order + 1) * n] for order in range(orders))
    (p1, p2), rate = path[:2], w[orders * n :]
    r, r1 = rate[:2]
    dq = [a * r for a in p1]
    ddq = [b * r * r + a * r * r1 for a, b in zip(p1, p2, strict=True)]
    jerk = jerk_along(path, rate)
    state = HeldState(robot, p, dq, ddq, tops, problem.obstacle, problem.object_size, jerk)
    g = []
    for constraint in problem.constraint:
        for condition in constraint.symbolic(state):
            scales = residual_scale(condition.lower, condition.upper, constraint.tolerance, condition.exactness)
            g += [value / float(scale) for value, scale in zip(condition.g, scales, strict=True)]
    return [w_sx, tops_sx], state, g


def residual_scale(lower: Array, upper: Array, tolerance: float, kind: str) -> Array:
    """Natural size of residuals: the limit itself, 20 tolerances of an equality, 0.1 m of a distance.

    With fewer tolerances the merit function holds steps back for the sake of equalities that are met well enough.
    """
    if kind == "limit":
        return np.maximum(np.abs(lower), np.abs(upper))
    return np.where(lower == upper, TOLERANCES * max(tolerance, FINEST), DISTANCE)
