"""The optimisation problem of one motion: variables, residuals on a Chebyshev grid, and their derivatives.

Variables are the interior path control points and the logarithms of the rate control points. Boundary conditions hold
by
construction: the boundary control points are functions of the first and last rate control points (paper, Appendix A).
Residuals are the problem's constraints, each divided by a natural size (a limit by itself, an equality by its
tolerance), so that a violation of 1e-3 means the same everywhere.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.recipes import Problem
from cnpgen.robots.symbolic import SymbolicState, symbols
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.spline import basis, chebyshev, end_derivatives, gauss_rule

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
DISTANCE = 0.1  # m
SMOOTH_RATE = 1e-4  # weight of the squared second differences of log r: fixes the gauge between p and r


def stage_values(robot: "Robot", problem: Problem) -> Any:
    """Build ``(w, tops) -> g`` with ``w = (p, p', p'', r, r')``: all residuals at one phase."""
    import casadi as ca

    w_sx, tops_sx, g = _stage(robot, problem)
    return ca.Function("stage_values", [w_sx, tops_sx], [ca.vertcat(*g)])


def stage_jacobian(robot: "Robot", problem: Problem) -> Any:
    """Build ``(w, tops) -> (g, dg/dw)``, the Jacobian column by column."""
    import casadi as ca

    w_sx, tops_sx, g = _stage(robot, problem)
    residuals = ca.vertcat(*g)
    jacobian = ca.densify(ca.jacobian(residuals, w_sx))
    outputs = ca.cse([residuals, ca.vec(jacobian)])
    return ca.Function("stage_jacobian", [w_sx, tops_sx], outputs)


def _stage(robot: "Robot", problem: Problem) -> tuple[Any, Any, list[Any]]:
    n = robot.n
    (w_sx, w), (tops_sx, tops) = symbols("w", 3 * n + 2), symbols("tops", len(problem.obstacle))
    p, p1, p2, r, r1 = w[:n], w[n : 2 * n], w[2 * n : 3 * n], w[3 * n], w[3 * n + 1]
    dq = [a * r for a in p1]
    ddq = [b * r * r + a * r * r1 for a, b in zip(p1, p2, strict=True)]
    size = problem.object.size if problem.object is not None else None
    state = SymbolicState(robot, p, dq, ddq, tops, problem.obstacle, size)
    g = []
    for constraint in problem.constraint:
        for condition in constraint.symbolic(state):
            scales = residual_scale(condition.lower, condition.upper, constraint.tolerance, condition.exactness)
            g += [value / float(scale) for value, scale in zip(condition.g, scales, strict=True)]
    return w_sx, tops_sx, g


def residual_scale(lower: Array, upper: Array, tolerance: float, kind: str) -> Array:
    """Natural size of residuals: the limit itself, twice the tolerance of an equality, 0.1 m of a distance."""
    if kind == "limit":
        return np.maximum(np.abs(lower), np.abs(upper))
    return np.where(lower == upper, 2 * tolerance, DISTANCE)


@dataclass(frozen=True)
class Grid:
    """Everything about the collocation grid that no motion changes.

    Attributes:
        s: Phases, shape (K,); s = 0 is left out, nothing can be changed there.
        path: Basis of p, p', p'', shape (3, K, C).
        rate: Basis of r, r', shape (2, K, R).
        gauss: Basis of r at the nodes of the time integral, shape (Q, R).
        weights: Quadrature weights of the time integral, shape (Q,).
    """

    s: Array
    path: Array
    rate: Array
    gauss: Array
    weights: Array


def make_grid(problem: Problem, points: int) -> Grid:
    """Build the Chebyshev grid of ``points`` phases."""
    spec = problem.trajectory
    s = chebyshev(points)[1:]
    path = np.stack([basis(s, spec.path_control_points, spec.degree, order) for order in range(3)])
    rate = np.stack([basis(s, spec.rate_control_points, spec.degree, order) for order in range(2)])
    nodes, weights = gauss_rule(spec.rate_control_points, spec.degree, 5)
    return Grid(s, path, rate, basis(nodes, spec.rate_control_points, spec.degree), weights)


@dataclass(frozen=True)
class Evaluation:
    """Objective and residuals at one x, with their derivatives.

    Attributes:
        x: The variables.
        cost: Objective: duration [s] and the smoothing of r.
        gradient: Its gradient, shape (nx,).
        curvature: Gauss-Newton Hessian in the logarithms of the rate, shape (R, R).
        g: Residuals, shape (K, m).
        jacobian: d(residuals)/d(w), shape (3 n + 2, m, K).
        rate: Rate control points, shape (R,).
    """

    x: Array
    cost: float
    gradient: Array
    curvature: Array
    g: Array
    jacobian: Array
    rate: Array


class Transcription:
    """One motion on one grid.

    Args:
        problem: The problem.
        grid: The grid.
        values: Kernel of ``stage_values``.
        jacobian: Kernel of ``stage_jacobian``.
        boundary: Boundary conditions of one motion.
        tops: Heights of its obstacles [m], shape (obstacles,).
    """

    def __init__(
        self, problem: Problem, grid: Grid, *, values: Kernel, jacobian: Kernel, boundary: Boundary, tops: Array
    ) -> None:
        spec = problem.trajectory
        self.spec, self.grid, self.boundary = spec, grid, boundary
        self.n = boundary.start_q.shape[1]
        self.interior = spec.path_control_points - 3 - boundary.fixed_at_goal
        self.split = self.interior * self.n
        self.nx = self.split + spec.rate_control_points
        self._values, self._jacobian = values, jacobian
        self._tops = np.repeat(tops[:, None], len(grid.s), axis=1)
        second = np.diff(np.eye(spec.rate_control_points), 2, axis=0)
        self._smooth = 2 * SMOOTH_RATE * second.T @ second

    def unpack(self, x: Array) -> tuple[Array, Array]:
        """Return path control points (C, n) and rate control points (R,) of the variables."""
        rate = np.exp(x[self.split :])
        path = assemble(self.boundary, x[: self.split].reshape(1, self.interior, self.n), rate[None], self.spec)
        return path[0], rate

    def pack(self, path: Array, rate: Array) -> Array:
        """Return the variables of a motion; its boundary control points are replaced by the exact ones."""
        end = len(path) - self.boundary.fixed_at_goal
        return np.concatenate([path[3:end].ravel(), np.log(rate)])

    def _stage(self, x: Array) -> tuple[Array, Array]:
        path, rate = self.unpack(x)
        w = np.empty((3 * self.n + 2, len(self.grid.s)))
        w[: 3 * self.n] = (self.grid.path @ path).transpose(0, 2, 1).reshape(3 * self.n, -1)
        w[3 * self.n :] = self.grid.rate @ rate
        return w, rate

    def value(self, x: Array) -> tuple[float, Array]:
        """Evaluate objective and residuals (K, m) only."""
        w, rate = self._stage(x)
        (g,) = self._values(w, self._tops)
        log = x[self.split :]
        inverse = 1.0 / (self.grid.gauss @ rate)
        return float(inverse @ self.grid.weights + 0.5 * log @ self._smooth @ log), g.T

    def evaluate(self, x: Array) -> Evaluation:
        """Evaluate objective and residuals with their derivatives."""
        w, rate = self._stage(x)
        g, jacobian = self._jacobian(w, self._tops)
        log = x[self.split :]
        slope = self.grid.gauss * rate
        inverse = 1.0 / (self.grid.gauss @ rate)
        cost = float(inverse @ self.grid.weights + 0.5 * log @ self._smooth @ log)
        gradient = np.zeros(self.nx)
        gradient[self.split :] = -((self.grid.weights * inverse**2) @ slope) + self._smooth @ log
        curvature = (slope * (2 * self.grid.weights * inverse**3)[:, None]).T @ slope + self._smooth
        return Evaluation(x, cost, gradient, curvature, g.T, jacobian.reshape(w.shape[0], g.shape[0], -1), rate)

    def rows(self, at: Evaluation, k: NDArray[np.intp], which: NDArray[np.intp]) -> Array:
        """Gradients of chosen residuals with respect to the variables.

        Args:
            at: Where.
            k: Grid point of every row, shape (m,).
            which: Residual of every row, shape (m,).

        Returns:
            Shape (m, nx).
        """
        n, spec = self.n, self.spec
        stage = at.jacobian[:, which, k].T  # (m, 3 n + 2)
        control = np.zeros((len(k), spec.path_control_points, n))
        for order in range(3):
            control += self.grid.path[order][k][:, :, None] * stage[:, None, order * n : (order + 1) * n]
        out = np.empty((len(k), self.nx))
        end = spec.path_control_points - self.boundary.fixed_at_goal
        out[:, : self.split] = control[:, 3:end].reshape(len(k), -1)
        speed = stage[:, 3 * n, None] * self.grid.rate[0][k] + stage[:, 3 * n + 1, None] * self.grid.rate[1][k]
        out[:, self.split :] = speed * at.rate
        for point, variable, derivative in self._boundary_slopes(at.rate):
            out[:, self.split + variable] += control[:, point] @ derivative
        return out

    def _boundary_slopes(self, rate: Array) -> list[tuple[int, int, Array]]:
        """Derivatives of the boundary control points with respect to log r: (point, variable, derivative)."""
        b, last, points = self.boundary, self.spec.rate_control_points - 1, self.spec.path_control_points
        first = self._end_slopes(b.start_dq[0], b.start_ddq[0], rate[0], rate[1])
        slopes = [(1, 0, first[0]), (2, 0, first[1]), (2, 1, first[2])]
        goal = np.zeros(self.n) if b.goal_ddq is None else b.goal_ddq[0]
        final = self._end_slopes(-b.goal_dq[0], goal, rate[-1], rate[-2])
        slopes.append((points - 2, last, final[0]))
        if b.goal_ddq is not None:
            slopes += [(points - 3, last, final[1]), (points - 3, last - 1, final[2])]
        return slopes

    def _end_slopes(self, dq: Array, ddq: Array, outer: float, inner: float) -> tuple[Array, Array, Array]:
        """Return d c1 / d log r0, d c2 / d log r0 and d c2 / d log r1 at one end."""
        path = end_derivatives(self.spec.path_control_points, self.spec.degree)
        eta = end_derivatives(self.spec.rate_control_points, self.spec.degree).eta
        c1 = -dq / (outer * path.eta)
        second = (ddq - dq * eta * (inner - outer)) / outer**2
        c2 = (-2 * second + dq * eta / outer) / path.beta + 3 * c1
        return c1, c2, -dq * eta * inner / outer**2 / path.beta
