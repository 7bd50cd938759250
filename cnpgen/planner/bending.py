"""Gauss-Newton steps onto the manifold's equalities, as SX: of interior control points, boundary ones stay.

The equalities are asked for at one phase per interior control point, where that point counts most, and at one more
before the goal: beyond the last of the others a motion that arrives fast leaves the manifold by more than anywhere
else. Of all steps that cancel the residuals to first order the one with the smallest second differences is taken:
motions stay smooth.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.planner.expressions import equality_residuals
from cnpgen.recipes import Problem
from cnpgen.robots.linalg import dot, solve
from cnpgen.robots.symbolic import symbols
from cnpgen.trajectory.spline import basis, clamped_knots

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
Shape = tuple[int, int, int]  # degree, number of control points, and how many of them the goal fixes

STRAIGHT = 0.05  # weight of the change itself beside that of its second differences
DAMPING = 1e-6  # keeps steps small where the equalities hardly depend on the joints
LONGEST = 0.6  # rad: no step moves a control point further


def bending(robot: "Robot", problem: Problem, *, shape: Shape, steps: int) -> Any:
    """Build ``(path, tops) -> change``: all path control points in, change of the interior ones out, point by point.

    Args:
        robot: The robot.
        problem: The problem.
        shape: Degree, number of control points, and how many of them the goal fixes.
        steps: Number of Gauss-Newton steps.
    """
    import casadi as ca

    path, tops, change = _bent(robot, problem, shape, steps)
    return ca.Function("bending", [path, tops], [ca.cse(change)])


def bending_adjoint(robot: "Robot", problem: Problem, *, shape: Shape, steps: int) -> Any:
    """Build ``(path, tops, seed) -> gradient`` of ``seed . change`` with respect to the path, by the reverse mode."""
    import casadi as ca

    path, tops, change = _bent(robot, problem, shape, steps)
    seed = ca.SX.sym("seed", change.numel())
    gradient = ca.densify(ca.jtimes(change, path, seed, True))
    return ca.Function("bending_adjoint", [path, tops, seed], [ca.cse(gradient)])


def _bent(robot: "Robot", problem: Problem, shape: Shape, steps: int) -> tuple[Any, Any, Any]:
    """Return the symbols of path and tops, and the change of the interior control points."""
    import casadi as ca

    degree, points, fixed_at_goal = shape
    (path_sx, path), (tops, _) = symbols("path", points * robot.n), symbols("tops", len(problem.obstacle))
    control = [path[i : i + robot.n] for i in range(0, len(path), robot.n)]
    interior = slice(3, points - fixed_at_goal)
    table, response = _collocation(degree, points, interior)
    equality, total = equality_residuals(robot, problem), [[0.0] * robot.n for _ in response]
    for _ in range(steps):
        q = [_combined(row, control) for row in table]
        step = _gauss_newton(equality, q, tops, table[:, interior], response)
        control[interior] = [_added(*pair) for pair in zip(control[interior], step, strict=True)]
        total = [_added(*pair) for pair in zip(total, step, strict=True)]
    return path_sx, tops, ca.vertcat(*[value for point in total for value in point])


def _added(one: list[Any], other: list[Any]) -> list[Any]:
    return [x + y for x, y in zip(one, other, strict=True)]


def _gauss_newton(equality: Any, q: list[list[Any]], tops: Any, inner: Array, response: Array) -> list[list[Any]]:
    """One step: change of the interior control points that cancels the residuals at the phases to first order.

    Args:
        equality: Function of ``equality_residuals``.
        q: Positions at the K phases.
        tops: Heights of the obstacles.
        inner: Basis of the interior control points at the phases, shape (K, interior points).
        response: How control points follow a force at the phases, shape (interior points, K).
    """
    import casadi as ca

    residuals, rows, phases = [], [], []
    for phase, position in enumerate(q):
        residual, jacobian = equality(ca.vertcat(*position), tops)
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
    pulled: list[list[Any]] = [[0.0] * len(q[0]) for _ in q]
    for strength, row, phase in zip(force, rows, phases, strict=True):
        pulled[phase] = [total + strength * slope for total, slope in zip(pulled[phase], row, strict=True)]
    return [[ca.fmin(ca.fmax(-x, -LONGEST), LONGEST) for x in _combined(row, pulled)] for row in response]


def _combined(factors: Array, points: list[list[Any]]) -> list[Any]:
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
