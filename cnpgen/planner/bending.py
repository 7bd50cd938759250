"""Gauss-Newton steps onto the manifold's equalities, as SX: of interior control points, boundary ones stay.

The equalities are asked for at one phase per interior control point, where that point counts most, and at one more
before the goal: beyond the last of the others a motion that arrives fast leaves the manifold by more than anywhere
else. Of all steps that cancel the residuals to first order the one with the smallest second differences is taken:
motions stay smooth.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.linalg import Vec, add, dot, solve
from cnpgen.planner.expressions import equality_residuals
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.spline import basis, clamped_knots

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

STRAIGHT = 0.05  # weight of the change itself beside that of its second differences
DAMPING = 1e-6  # keeps steps small where the equalities hardly depend on the joints
LONGEST = 0.6  # rad: no step moves a control point further


def bend(
    robot: "Robot",
    problem: Problem,
    control: list[Vec],
    tops: Vec,
    *,
    steps: int,
    fixed_at_goal: int,
    within_limits: bool = False,
) -> list[Vec]:
    """Return how far a path's interior control points must move.

    Args:
        robot: The robot.
        problem: The problem.
        control: All control points of the path, SX scalars [rad].
        tops: Where the obstacles are, as ``obstacle_tops`` says.
        steps: Number of Gauss-Newton steps.
        fixed_at_goal: Number of control points that the goal fixes.
        within_limits: Whether interior control points are put back within the joint limits after every step.
    """
    control, interior = list(control), slice(3, len(control) - fixed_at_goal)
    table, response = _collocation(problem.trajectory.degree, len(control), interior)
    equality, total = equality_residuals(robot, problem), [[0.0] * robot.n for _ in response]
    for _ in range(steps):
        q = [_combined(row, control) for row in table]
        step = _gauss_newton(equality, q, tops, table[:, interior], response)
        if within_limits:
            step = [_kept_within(robot, *pair) for pair in zip(control[interior], step, strict=True)]
        control[interior] = [add(*pair) for pair in zip(control[interior], step, strict=True)]
        total = [add(*pair) for pair in zip(total, step, strict=True)]
    return total


def _kept_within(robot: "Robot", point: Vec, step: Vec) -> Vec:
    """Shorten or turn a step so that it ends within the joint limits, within which the whole path is then, too."""
    import casadi as ca

    ends = zip(robot.position_lower.tolist(), robot.position_upper.tolist(), add(point, step), strict=True)
    return [ca.fmin(ca.fmax(end, low), high) - start for (low, high, end), start in zip(ends, point, strict=True)]


def _gauss_newton(equality: Any, q: list[Vec], tops: Vec, inner: Array, response: Array) -> list[Vec]:
    """One step: change of the interior control points that cancels the residuals at the phases to first order.

    Args:
        equality: Function of ``equality_residuals``.
        q: Positions at the K phases.
        tops: Where the obstacles are, as ``obstacle_tops`` says.
        inner: Basis of the interior control points at the phases, shape (K, interior points).
        response: How control points follow a force at the phases, shape (interior points, K).
    """
    import casadi as ca

    residuals, rows, phases = [], [], []
    for phase, position in enumerate(q):
        residual, jacobian = equality(ca.vertcat(*position), ca.vertcat(*tops))
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
        entries[i] += DAMPING
    force = solve(lower, residuals)
    pulled: list[Vec] = [[0.0] * len(q[0]) for _ in q]
    for strength, row, phase in zip(force, rows, phases, strict=True):
        pulled[phase] = [total + strength * slope for total, slope in zip(pulled[phase], row, strict=True)]
    return [[ca.fmin(ca.fmax(-x, -LONGEST), LONGEST) for x in _combined(row, pulled)] for row in response]


def _combined(factors: Array, points: list[Vec]) -> Vec:
    """Return the sum of points times factors; what is zero costs nothing."""
    used = [(float(factor), point) for factor, point in zip(factors, points, strict=True) if factor]
    return [sum(factor * point[joint] for factor, point in used) for joint in range(len(points[0]))]


def _collocation(degree: int, points: int, interior: slice) -> tuple[Array, Array]:
    """Return the basis at K phases, and how the interior control points follow a force there.

    Returns:
        Shape (K, points) and (K - 1, K).
    """
    knots, chosen = clamped_knots(points, degree), range(points)[interior]
    greville = [knots[i + 1 : i + degree + 1].mean() for i in chosen]
    phases = np.array([*greville, (greville[-1] + 1) / 2])
    table = basis(phases, points, degree)
    second = np.diff(np.eye(points), 2, axis=0)[:, interior]
    mobility = np.linalg.inv(second.T @ second + STRAIGHT * np.eye(len(greville)))
    return table, mobility @ table[:, interior].T
