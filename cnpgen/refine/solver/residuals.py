"""Residuals of a problem at one phase of a motion, as SX functions of the splines."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import FrozenState, time_derivatives
from cnpgen.problems.constraints.constraint import MIN_TOLERANCE
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
DISTANCE_SCALE_M = 0.1  # size of a residual of 1
EQUALITY_SCALE = 20  # tolerances; with fewer the merit function rejects steps for equalities that are met well enough


def stage_values(robot: Robot, problem: Problem) -> Any:
    """Build the function ``(w, obstacle_poses) -> g`` of all residuals at one phase, with ``w = (p, p', p'', r, r')``.

    With constraints of the jerk, ``w = (p, p', p'', p''', r, r', r'')``.
    """
    import casadi as ca

    columns, state, g = _stage(robot, problem)
    return ca.Function("stage_values", columns, state.unfrozen([ca.vertcat(*g)]))


def stage_jacobian(robot: Robot, problem: Problem) -> Any:
    """Build the function ``(w, obstacle_poses) -> (g, dg/dw)``, the Jacobian column by column."""
    import casadi as ca

    columns, state, g = _stage(robot, problem)
    residuals = ca.vertcat(*g)
    jacobian = ca.densify(ca.jacobian(residuals, columns[0]))
    outputs = ca.cse(state.unfrozen([residuals, ca.vec(jacobian)]))
    return ca.Function("stage_jacobian", columns, outputs)


def _stage(robot: Robot, problem: Problem) -> tuple[list[Any], FrozenState, list[Any]]:
    n, orders = robot.n, problem.path_orders
    (w_sx, w), (poses_sx, obstacle_poses) = (
        symbols("w", orders * n + orders - 1),
        symbols("obstacle_poses", problem.scene_width),
    )
    p, *path = (w[order * n : (order + 1) * n] for order in range(orders))
    dq, ddq, jerk = time_derivatives(path, w[orders * n :])
    state = FrozenState(robot, p, dq, ddq, obstacle_poses, problem.obstacle, problem.object_size, jerk)
    g = []
    for constraint in problem.constraint:
        for condition in constraint.symbolic(state):
            scales = residual_scale(condition.lower, condition.upper, constraint.tolerance, condition.tolerance_kind)
            g += [value / float(scale) for value, scale in zip(condition.g, scales, strict=True)]
    return [w_sx, poses_sx], state, g


def residual_scale(lower: Array, upper: Array, tolerance: float, kind: str) -> Array:
    """Return the scale of residuals: the limit itself, 20 tolerances of an equality, or 0.1 m of a distance."""
    if kind == "limit":
        return np.maximum(np.abs(lower), np.abs(upper))
    return np.where(lower == upper, EQUALITY_SCALE * max(tolerance, MIN_TOLERANCE), DISTANCE_SCALE_M)
