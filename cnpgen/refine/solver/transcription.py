"""The optimisation problem of one motion: variables, residuals on a Chebyshev grid, and their derivatives.

Variables are the interior path control points and the logarithms of the rate control points. Boundary conditions hold
by construction: the boundary control points are functions of the first and last rate control points (paper, Appendix
A). Residuals are the problem's constraints, each divided by a natural size (``cnpgen.refine.solver.residuals``), so
that a violation of 1e-3 means about the same everywhere.
"""

from collections.abc import Callable
from ctypes import CDLL
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.refine.solver.criterion import Criterion
from cnpgen.refine.solver.grid import Bases, Grid
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.slopes import boundary_slopes
from cnpgen.trajectory.spec import TrajectorySpec

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
T = TypeVar("T")
SMOOTH_RATE = 1e-4  # weight of the squared second differences of log r: fixes the gauge between p and r


@dataclass(frozen=True)
class Linearisation:
    """Objective and residuals at one x, with their derivatives.

    Attributes:
        x: The variables.
        cost: Objective [s].
        gradient: Its gradient, shape (nx,).
        curvature: Positive semidefinite model of its Hessian, shape (nx, nx).
        g: Residuals, shape (K, m).
        jacobian: d(residuals)/d(w), shape (width of w, m, K).
        rate: Rate control points, shape (R,).
    """

    x: Array
    cost: float
    gradient: Array
    curvature: Array
    g: Array
    jacobian: Array
    rate: Array


@dataclass(frozen=True)
class ResidualKernels:
    """The kernels of a problem.

    Attributes:
        spec: Degree and numbers of control points.
        values: Kernel of ``cnpgen.refine.solver.residuals.stage_values``.
        jacobian: Kernel of ``cnpgen.refine.solver.residuals.stage_jacobian``.
        criterion: What is minimised beside the time, or None.
        residuals: Kernel of ``cnpgen.refine.solver.criterion.criterion_residuals``, or None.
        steps: Library of ``cnpgen.refine.solver.compiled``, or None where steps are in NumPy and DAQP.
    """

    spec: TrajectorySpec
    values: Kernel
    jacobian: Kernel
    criterion: Criterion | None = None
    residuals: Kernel | None = None
    steps: CDLL | None = None


class Transcription:
    """One motion on one grid.

    Args:
        stage: The kernels.
        grid: The grid.
        boundary: Boundary conditions of one motion.
        tops: Where its obstacles are, as ``obstacle_tops`` says, shape (numbers,).
    """

    def __init__(self, stage: ResidualKernels, grid: Grid, *, boundary: Boundary, tops: Array) -> None:
        spec = stage.spec
        self.stage, self.spec, self.grid, self.boundary = stage, spec, grid, boundary
        self.n = boundary.start_q.shape[1]
        self._fixed = spec.path_control_points - boundary.fixed_at_goal  # where the goal's control points begin
        self.interior = self._fixed - 3
        self.split = self.interior * self.n
        self.nx = self.split + spec.rate_control_points
        self.tops = tops
        self.tops_along = np.repeat(tops[:, None], len(grid.s), axis=1)
        self.smooth = _smoothing(spec.rate_control_points)
        self._at = of_last(self._states)  # steps that are taken are evaluated again, with derivatives
        self._residuals = of_last(self._criterion_residuals)
        self._slopes = of_last(lambda rate: boundary_slopes(boundary, rate[None], spec))

    def unpack(self, x: Array) -> tuple[Array, Array]:
        """Return path control points (C, n) and rate control points (R,) of the variables."""
        rate = np.exp(x[self.split :])
        path = assemble(self.boundary, x[: self.split].reshape(1, self.interior, self.n), rate[None], self.spec)
        return path[0], rate

    def pack(self, path: Array, rate: Array) -> Array:
        """Return the variables of a motion; its boundary control points are replaced by the exact ones."""
        return np.concatenate([path[3 : self._fixed].ravel(), np.log(rate)])

    def positions(self, x: Array) -> Array:
        """Return joint positions on the grid [rad], shape (n, K)."""
        return self._at(x)[0][: self.n]

    def value(self, x: Array) -> tuple[float, Array]:
        """Evaluate what is minimised, and residuals (K, m), without derivatives."""
        cost, g = self.measured(x)
        return cost + self.gauge(x), g

    def gauge(self, x: Array) -> float:
        """Return what is minimised beside the objective, since it fixes the gauge between p and r."""
        log = x[self.split :]
        return float(0.5 * log @ self.smooth @ log)

    def measured(self, x: Array) -> tuple[float, Array]:
        """Evaluate ``objective`` and residuals (K, m)."""
        w, path, rate = self._at(x)
        (g,) = self.stage.values(w, self.tops_along)
        return self.objective(path, rate), g.T

    def end_residuals(self) -> Array:
        """Evaluate residuals at the start and at the goal, shape (2, m); nan where accelerations or jerks are free."""
        orders = len(self.grid.bases.path)
        b, unit = self.boundary, np.eye(1, orders - 1)[0]  # with r = 1 and r' = 0, w is the state itself
        free = np.full(self.n, np.nan)
        goal_ddq, jerk = free if b.goal_ddq is None else b.goal_ddq[0], [free] * (orders - 3)
        start = np.concatenate([b.start_q[0], b.start_dq[0], b.start_ddq[0], *jerk, unit])
        goal = np.concatenate([b.goal_q[0], b.goal_dq[0], goal_ddq, *jerk, unit])
        (g,) = self.stage.values(np.stack([start, goal], axis=1), self.tops_along[:, :2])
        return np.asarray(g.T)

    def objective(self, path: Array, rate: Array) -> float:
        """Return the objective of a motion [s]: its duration and the criterion, without what fixes the gauge.

        Args:
            path: Path control points [rad], shape (C, n).
            rate: Rate control points [1/s], shape (R,).
        """
        return self.duration(rate) + (0.0 if self.stage.criterion is None else self._criterion(path, rate))

    def duration(self, rate: Array) -> float:
        """Return the motion time [s] of rate control points [1/s], shape (R,)."""
        return float(self.grid.weights @ (1.0 / (self.grid.gauss @ rate)))

    def evaluate(self, x: Array) -> Linearisation:
        """Evaluate objective and residuals with their derivatives."""
        w, path, rate = self._at(x)
        g, jacobian = self.stage.jacobian(w, self.tops_along)
        log = x[self.split :]
        slope = self.grid.gauss * rate
        inverse = 1.0 / (self.grid.gauss @ rate)
        cost = float(inverse @ self.grid.weights) + self.gauge(x)
        gradient = np.zeros(self.nx)
        gradient[self.split :] = -((self.grid.weights * inverse**2) @ slope) + self.smooth @ log
        curvature = np.zeros((self.nx, self.nx))
        half = slope * np.sqrt(2 * self.grid.weights * inverse**3)[:, None]
        curvature[self.split :, self.split :] = half.T @ half + self.smooth
        if self.stage.criterion is not None:
            cost += self._add_criterion(path, rate, gradient, curvature)
        return Linearisation(x, cost, gradient, curvature, g.T, jacobian.reshape(len(w), *g.shape), rate)

    def rows(self, at: Linearisation, k: Indices, which: Indices) -> Array:
        """Gradients of chosen residuals with respect to the variables.

        Args:
            at: Where.
            k: Grid point of every row, shape (m,).
            which: Residual of every row, shape (m,).

        Returns:
            Shape (m, nx).
        """
        return self._chain(at.jacobian[:, which, k].T, k, at.rate, self.grid.bases)

    def leaps(self, at: Linearisation, step: float) -> Array:
        """Bound how far derivatives of r can carry residuals when no log r changes by more than ``step``: (K, m)."""
        orders, reach = len(self.grid.bases.path), np.zeros(at.g.shape)
        for order in range(1, orders - 1):
            change = np.abs(self.grid.bases.rate[order]) @ at.rate * step
            reach += np.abs(at.jacobian[orders * self.n + order]).T * change[:, None]
        return reach

    def _states(self, x: Array) -> tuple[Array, Array, Array]:
        """Return w = (p, p', p'', ..., r, r', ...) on the grid, shape (width, K), and the control points."""
        path, rate = self.unpack(x)
        return self.grid.bases.states(path, rate), path, rate

    def _criterion_residuals(self, path: Array, rate: Array) -> tuple[Array, Array, Array]:
        """Return the criterion's residuals (m, Q) at its nodes, their Jacobian (4 n + 3, m, Q) and weights (Q,)."""
        assert self.stage.criterion is not None
        assert self.stage.residuals is not None
        w = self.grid.criterion.states(path, rate)
        e, jacobian = self.stage.residuals(w)
        share = self.stage.criterion.weight * self.grid.criterion_weights / w[4 * self.n]
        return e, jacobian.reshape(len(w), *e.shape), share

    def _criterion(self, path: Array, rate: Array) -> float:
        """Return the criterion's cost."""
        assert self.stage.criterion is not None
        e, _, share = self._residuals(path, rate)
        return float(share @ self.stage.criterion.rate(e)[0])

    def _add_criterion(self, path: Array, rate: Array, gradient: Array, curvature: Array) -> float:
        """Add the criterion's gradient and its Gauss-Newton Hessian; return its cost."""
        assert self.stage.criterion is not None
        bases = self.grid.criterion
        e, jacobian, share = self._residuals(path, rate)
        rho, slope = self.stage.criterion.rate(e)
        m, points = e.shape
        k, which = np.repeat(np.arange(points), m), np.tile(np.arange(m), points)
        rows = self._chain(jacobian[:, which, k].T, k, rate, bases)
        pull = (share * slope)[k]
        gradient += (pull * e[which, k]) @ rows
        half = rows * np.sqrt(pull)[:, None]
        gradient[self.split :] -= (share * rho / (bases.rate[0] @ rate)) @ bases.rate[0] * rate
        curvature += half.T @ half  # of one matrix, which takes half as long
        return float(share @ rho)

    def _chain(self, stage: Array, k: Indices, rate: Array, bases: Bases) -> Array:
        """Turn derivatives in w at nodes k, shape (m, width of w), into derivatives in the variables, (m, nx)."""
        n, m, orders = self.n, len(k), len(bases.path)
        control = bases.path_at[k] @ stage[:, : orders * n].reshape(m, orders, n)
        out = np.empty((m, self.nx))
        out[:, : self.split] = control[:, 3 : self._fixed].reshape(m, self.split)
        out[:, self.split :] = (stage[:, None, orders * n :] @ bases.rate_at[k])[:, 0] * rate
        for each in self._slopes(rate):
            out[:, self.split + each.variable] += control[:, each.point] @ (each.slope[0] * rate[each.variable])
        return out


@cache
def _smoothing(points: int) -> Array:
    """Hessian of what fixes the gauge, shape (R, R)."""
    second = np.diff(np.eye(points), 2, axis=0)
    return np.asarray(2 * SMOOTH_RATE * second.T @ second)


def of_last(function: Callable[..., T]) -> Callable[..., T]:
    """Keep what a function returned for the objects that it was last given; threads may share it."""
    last: list[tuple[tuple[Any, ...], T]] = []

    def recall(*objects: Any) -> T:
        for known, result in last:
            if len(known) == len(objects) and all(a is b for a, b in zip(known, objects, strict=True)):
                return result
        result = function(*objects)
        last[:] = [(objects, result)]
        return result

    return recall
