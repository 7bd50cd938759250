"""A baseline on the manifold: the straight line between the boundary control points, bent onto the equalities.

The paper's network corrects a straight line in joint space, which leaves the manifold by far: a heavy object tilts by
some 10 degrees on the way. A Gauss-Newton step of the interior control points removes nearly all of that before the
network runs, with the smallest change of their second differences.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.network.omega import along_line
from cnpgen.planner.expressions import equality_residuals
from cnpgen.recipes import Problem, TrajectorySpec
from cnpgen.robots.linalg import dot, solve
from cnpgen.robots.symbolic import symbols
from cnpgen.trajectory.boundary import Boundary, goal_points, start_points
from cnpgen.trajectory.spline import basis, clamped_knots

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

STRAIGHT = 0.05  # weight of the change itself beside that of its second differences
DAMPING = 1e-6  # keeps steps small where the equalities hardly depend on the joints
LONGEST = 0.6  # rad: no step moves a control point further


@dataclass(frozen=True)
class Baseline:
    """What bends the line of one problem; made by ``make_baseline``.

    Attributes:
        bend: Kernel of ``bent_line``.
        spec: Degree and numbers of control points.
    """

    bend: Kernel
    spec: TrajectorySpec

    def correction(self, boundary: Boundary, rate: Array, tops: Array) -> Array:
        """Compute what the interior control points deviate from the straight line by.

        Args:
            boundary: Boundary conditions of N motions.
            rate: Nominal rate of every motion [1/s], shape (N,): the line hangs on it where an end moves.
            tops: Heights of the obstacles' upper faces [m], shape (N, obstacles).

        Returns:
            Shape (N, interior points, n) [rad].
        """
        rates = rate[:, None] * np.ones(self.spec.rate_control_points)
        first, last = start_points(boundary, rates, self.spec), goal_points(boundary, rates, self.spec)
        ends = np.concatenate([first, last], axis=1)
        rows, fixed, n = ends.shape
        ends = ends.reshape(rows, fixed * n)
        (change,) = self.bend(np.ascontiguousarray(ends.T), np.ascontiguousarray(tops.T))
        return change.T.reshape(rows, self.spec.path_control_points - fixed, n)


def make_baseline(problem: Problem, kernels: KernelLibrary, *, steps: int, fixed_at_goal: int = 2) -> Baseline:
    """Load the baseline of a problem that has equalities.

    Args:
        problem: The problem.
        kernels: Where kernels are loaded from.
        steps: Number of Gauss-Newton steps, at least 1.
        fixed_at_goal: Control points that the goal fixes.
    """
    spec = problem.trajectory
    shape = (spec.degree, spec.path_control_points, fixed_at_goal)
    return Baseline(kernels.load(bent_line, shape=shape, steps=steps), spec)


def bent_line(robot: "Robot", problem: Problem, *, shape: tuple[int, int, int], steps: int) -> Any:
    """Build ``(ends, tops) -> change``: control points at the ends in, change of the interior ones out, point by point.

    Args:
        robot: The robot.
        problem: The problem.
        shape: Degree, number of control points, and how many of them the goal fixes.
        steps: Number of Gauss-Newton steps.
    """
    import casadi as ca

    degree, points, fixed_at_goal = shape
    ends_sx, ends = symbols("ends", (3 + fixed_at_goal) * robot.n)
    tops_sx, _ = symbols("tops", len(problem.obstacle))
    given = [ends[i : i + robot.n] for i in range(0, len(ends), robot.n)]
    table, response = _collocation(degree, points, fixed_at_goal)
    along, begin, end = along_line(response.shape[0])[:, 0], given[2], given[3]
    line = [[a + (b - a) * float(t) for a, b in zip(begin, end, strict=True)] for t in along]
    control = [*given[:3], *line, *given[3:]]
    equality = equality_residuals(robot, problem)
    for _ in range(steps):
        q = [_combined(row, control) for row in table]
        step = _gauss_newton(equality, q, tops_sx, table[:, 3 : 3 + len(line)], response)
        control[3 : 3 + len(line)] = [
            [x + d for x, d in zip(*pair, strict=True)] for pair in zip(control[3 : 3 + len(line)], step, strict=True)
        ]
    moved = zip(control[3 : 3 + len(line)], line, strict=True)
    change = [x - x0 for new, old in moved for x, x0 in zip(new, old, strict=True)]
    return ca.Function("bent_line", [ends_sx, tops_sx], ca.cse([ca.vertcat(*change)]))


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


def _collocation(degree: int, points: int, fixed_at_goal: int) -> tuple[Array, Array]:
    """Return the basis at one phase per interior control point, where that point counts most, and their response.

    Returns:
        Shape (K, points) and (interior points, K), with K interior points.
    """
    knots, interior = clamped_knots(points, degree), slice(3, points - fixed_at_goal)
    chosen = range(points)[interior]
    phases = np.array([knots[i + 1 : i + degree + 1].mean() for i in chosen])  # Greville's abscissae
    table = basis(phases, points, degree)
    second = np.diff(np.eye(points), 2, axis=0)[:, interior]
    mobility = np.linalg.inv(second.T @ second + STRAIGHT * np.eye(len(phases)))
    return table, mobility @ table[:, interior].T
