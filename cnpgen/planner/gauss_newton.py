"""Project interior control points onto the manifold's equalities by Gauss-Newton steps, as CasADi SX expressions.

The equalities are evaluated at one phase per interior control point, where that point has the largest effect, and at
one more phase before the goal, where fast arrivals leave the manifold most. Among all steps that cancel the residuals
to first order, the one with the smallest second differences is taken, so that motions stay smooth.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.linalg import Vec, add, dot, solve
from cnpgen.problems.conditions import equality_residuals
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.spline import basis, clamped_knots

Array = NDArray[np.float64]

CHANGE_WEIGHT = 0.05  # weight of the change relative to its second differences
PROJECTION_DAMPING = 1e-6  # limits steps near singularities of the equalities
MAX_STEP_RAD = 0.6  # per control point and joint


def projection_change(
    robot: Robot,
    problem: Problem,
    control: list[Vec],
    obstacle_poses: Vec,
    *,
    steps: int,
    fixed_at_goal: int,
    within_limits: bool,
) -> list[Vec]:
    """Return the change of a path's interior control points that projects it onto the equalities.

    Args:
        robot: The robot.
        problem: The problem.
        control: All control points of the path, SX scalars [rad].
        obstacle_poses: Poses and sizes of the obstacles (``Scene.poses``).
        steps: Number of Gauss-Newton steps.
        fixed_at_goal: Number of control points that the goal fixes.
        within_limits: Whether interior control points are clipped to the joint limits after every step.
    """
    control, interior = list(control), slice(3, len(control) - fixed_at_goal)
    table, response = collocation(problem.trajectory.degree, len(control), interior)
    equality, total = equality_residuals(robot, problem), [[0.0] * robot.n for _ in response]
    for _ in range(steps):
        q = [_combined(row, control) for row in table]
        step = _gauss_newton(equality, q, obstacle_poses, table[:, interior], response)
        if within_limits:
            step = [clipped_to_limits(robot, *pair) for pair in zip(control[interior], step, strict=True)]
        control[interior] = [add(*pair) for pair in zip(control[interior], step, strict=True)]
        total = [add(*pair) for pair in zip(total, step, strict=True)]
    return total


def clipped_to_limits(robot: Robot, point: Vec, step: Vec) -> Vec:
    """Change a step so that its end is within the joint limits; then the whole path is, too."""
    import casadi as ca

    ends = zip(robot.position_lower.tolist(), robot.position_upper.tolist(), add(point, step), strict=True)
    return [ca.fmin(ca.fmax(end, low), high) - start for (low, high, end), start in zip(ends, point, strict=True)]


def _gauss_newton(equality: Any, q: list[Vec], obstacle_poses: Vec, inner: Array, response: Array) -> list[Vec]:
    """Return the change of the interior control points that cancels the residuals at the phases to first order."""
    import casadi as ca

    residuals, rows, phases = [], [], []
    for phase, position in enumerate(q):
        residual, jacobian = equality(ca.vertcat(*position), ca.vertcat(*obstacle_poses))
        columns = ca.reshape(jacobian, residual.numel(), len(position))
        for equation in range(residual.numel()):
            residuals.append(residual[equation])
            rows.append(ca.vertsplit(columns[equation, :].T))
            phases.append(phase)
    coupling = inner @ response
    lower = [
        [dot(rows[i], rows[j]) * float(coupling[phases[i], phases[j]]) for j in range(i + 1)] for i in range(len(rows))
    ]
    for i, entries in enumerate(lower):
        entries[i] += PROJECTION_DAMPING
    force = solve(lower, residuals)
    forces: list[Vec] = [[0.0] * len(q[0]) for _ in q]
    for strength, row, phase in zip(force, rows, phases, strict=True):
        forces[phase] = [total + strength * gradient for total, gradient in zip(forces[phase], row, strict=True)]
    return [[ca.fmin(ca.fmax(-x, -MAX_STEP_RAD), MAX_STEP_RAD) for x in _combined(row, forces)] for row in response]


def _combined(factors: Array, points: list[Vec]) -> Vec:
    """Return the sum of points times factors; zero factors are skipped."""
    used = [(float(factor), point) for factor, point in zip(factors, points, strict=True) if factor]
    return [sum(factor * point[joint] for factor, point in used) for joint in range(len(points[0]))]


def collocation(degree: int, points: int, interior: slice) -> tuple[Array, Array]:
    """Return the basis at K phases, and the response of the interior control points to a force there.

    Returns:
        Shape (K, points) and (K - 1, K).
    """
    knots, indices = clamped_knots(points, degree), range(points)[interior]
    greville = [knots[i + 1 : i + degree + 1].mean() for i in indices]
    phases = np.array([*greville, (greville[-1] + 1) / 2])
    table = basis(phases, points, degree)
    second = np.diff(np.eye(points), 2, axis=0)[:, interior]
    mobility = np.linalg.inv(second.T @ second + CHANGE_WEIGHT * np.eye(len(greville)))
    return table, mobility @ table[:, interior].T
