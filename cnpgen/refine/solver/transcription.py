"""Transcription of the optimization problem of one motion: variables, residuals on a Chebyshev grid, derivatives.

Variables are the interior path control points and the logarithms of the rate control
points, x = (C_3, ..., log R_0, ...), which keeps rates positive. Boundary conditions
hold by construction: the boundary control points are functions of the first and last
rate control points (paper, Appendix A). Residuals are the problem's constraints, each
divided by its scale (``cnpgen.refine.solver.residuals``). They are functions of the
splines w = (p, p', p'', r, r') at a phase s, which are linear in the control points:

    T = integral of 1 / r(s) ds,    dg/dx = dg/dw (dw/dC dC/dx + dw/dR dR/dx),

with dR/d(log R) = R, and with the boundary control points' dependence on R in dC/dx.
The objective's Hessian in log R keeps the positive part of that of T,

    H = integral of 2 r^-3 (dr/dlog R)(dr/dlog R)' ds,

so that it is positive semidefinite.
"""

from collections.abc import Callable
from ctypes import CDLL
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np

from cnpgen.arrays import Array, Indices
from cnpgen.kernels.kernel import Kernel
from cnpgen.refine.solver.grid import Bases, Grid
from cnpgen.refine.solver.residuals import CostTerm
from cnpgen.trajectory.boundary import Boundary, assemble, boundary_derivatives
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

T = TypeVar("T")
# Weight of the squared second differences of log r, which selects one of many
# parametrizations.
RATE_SMOOTHING = 1e-4


@dataclass(frozen=True)
class Linearization:
    """Objective and residuals at one x, with their derivatives."""

    x: Array  # variables, shape (nx,)
    cost: float  # objective [s]
    gradient: Array  # gradient of the objective, shape (nx,)
    curvature: Array  # positive semidefinite model of its Hessian, shape (nx, nx)
    g: Array  # residuals, shape (K, m)
    jacobian: Array  # d(residuals)/d(w), shape (width of w, m, K)
    rate: Array  # rate control points, shape (R,)


@dataclass(frozen=True)
class ResidualKernels:
    """Kernels of a problem."""

    spec: TrajectorySpec  # degree and numbers of control points
    values: Kernel  # kernel of ``cnpgen.refine.solver.residuals.stage_values``
    jacobian: Kernel  # kernel of ``cnpgen.refine.solver.residuals.stage_jacobian``
    step_library: CDLL  # library of ``cnpgen.refine.solver.compiled_backend``
    cost_term: CostTerm | None = None  # cost term in addition to the duration, or None
    # Kernel of ``cnpgen.refine.solver.residuals.cost_term_residuals``, or None.
    cost_residuals: Kernel | None = None
    # Number of residuals of every term of the cost term.
    cost_counts: tuple[int, ...] = ()


class Transcription:
    """One motion on one grid, with poses and sizes of its obstacles, shape (width,)."""

    def __init__(
        self,
        kernels: ResidualKernels,
        grid: Grid,
        *,
        boundary: Boundary,
        obstacle_poses: Array,
    ) -> None:
        spec = kernels.spec
        self.kernels = kernels
        self.spec = spec
        self.grid = grid
        self.boundary = boundary
        self.n = boundary.start_q.shape[1]
        # Index of the goal's control points.
        self._goal_points = spec.path_control_points - boundary.fixed_at_goal
        self.interior = self._goal_points - 3
        self.split = self.interior * self.n
        self.nx = self.split + spec.rate_control_points
        self.obstacle_poses = obstacle_poses
        self.poses_along = np.repeat(obstacle_poses[:, None], len(grid.s), axis=1)
        self.smoothing = _smoothing(spec.rate_control_points)
        # An accepted step is evaluated again, with derivatives.
        self._at = cache_last(self._states)
        self._cost_residuals = cache_last(self._evaluate_cost_residuals)
        self._boundary_derivatives = cache_last(
            lambda rate: boundary_derivatives(boundary, rate[None], spec)
        )

    def activate(self) -> None:
        """Prepare kernels whose machine code has a context.

        The step library calls them afterwards.
        """

    def unpack(self, x: Array) -> tuple[Array, Array]:
        """Return path control points (C, n) and rate control points (R,) of the variables."""
        rate = np.exp(x[self.split :])
        path = assemble(
            self.boundary,
            x[: self.split].reshape(1, self.interior, self.n),
            rate[None],
            self.spec,
        )
        return path[0], rate

    def pack(self, path: Array, rate: Array) -> Array:
        """Return the variables of a motion.

        Its boundary control points are replaced by the exact ones.
        """
        return np.concatenate([path[3 : self._goal_points].ravel(), np.log(rate)])

    def positions(self, x: Array) -> Array:
        """Return joint positions on the grid [rad], shape (n, K)."""
        return self._at(x)[0][: self.n]

    def value(self, x: Array) -> tuple[float, Array]:
        """Evaluate the regularized objective and residuals (K, m), without derivatives."""
        cost, g = self.measured(x)
        return cost + self.regularization(x), g

    def regularization(self, x: Array) -> float:
        """Return the regularization of log r, which selects one of many equivalent parametrizations."""
        log = x[self.split :]
        return float(0.5 * log @ self.smoothing @ log)

    def measured(self, x: Array) -> tuple[float, Array]:
        """Evaluate ``objective`` and residuals (K, m)."""
        w, path, rate = self._at(x)
        (g,) = self.kernels.values(w, self.poses_along)
        return self.objective(path, rate), g.T

    def end_residuals(self) -> Array:
        """Evaluate residuals at the start and at the goal, shape (2, m).

        Nan where accelerations or jerks are free.
        """
        orders = len(self.grid.bases.path)
        # With r = 1 and r' = 0, w is the state itself.
        b = self.boundary
        unit = np.eye(1, orders - 1)[0]
        free = np.full(self.n, np.nan)
        goal_ddq = free if b.goal_ddq is None else b.goal_ddq[0]
        jerk = [free] * (orders - 3)
        start = np.concatenate(
            [b.start_q[0], b.start_dq[0], b.start_ddq[0], *jerk, unit]
        )
        goal = np.concatenate([b.goal_q[0], b.goal_dq[0], goal_ddq, *jerk, unit])
        (g,) = self.kernels.values(
            np.stack([start, goal], axis=1), self.poses_along[:, :2]
        )
        return np.asarray(g.T)

    def objective(self, path: Array, rate: Array) -> float:
        """Return the objective of a motion [s], from control points (C, n) and (R,): duration and cost term."""
        if self.kernels.cost_term is None:
            return self.duration(rate)
        e, _, weights = self._cost_residuals(path, rate)
        return self.duration(rate) + float(
            weights @ self.kernels.cost_term.rate(e, self.kernels.cost_counts)[0]
        )

    def duration(self, rate: Array) -> float:
        """Return the motion time [s] of rate control points [1/s], shape (R,)."""
        return float(self.grid.time_weights @ (1.0 / (self.grid.time_basis @ rate)))

    def evaluate(self, x: Array) -> Linearization:
        """Evaluate objective and residuals with their derivatives."""
        w, path, rate = self._at(x)
        g, jacobian = self.kernels.jacobian(w, self.poses_along)
        log = x[self.split :]
        # dr/d(log R_j) = B_j R_j at the nodes of the time integral
        log_rate_derivative = self.grid.time_basis * rate
        inverse = 1.0 / (self.grid.time_basis @ rate)
        cost = float(inverse @ self.grid.time_weights) + self.regularization(x)
        gradient = np.zeros(self.nx)
        # dT/d(log R) = -sum of weight r^-2 dr/d(log R)
        gradient[self.split :] = (
            -((self.grid.time_weights * inverse**2) @ log_rate_derivative)
            + self.smoothing @ log
        )
        curvature = np.zeros((self.nx, self.nx))
        # H = half' half: a square root, so that one product of matrices builds it
        half = (
            log_rate_derivative
            * np.sqrt(2 * self.grid.time_weights * inverse**3)[:, None]
        )
        curvature[self.split :, self.split :] = half.T @ half + self.smoothing
        if self.kernels.cost_term is not None:
            cost += self._add_cost_term(path, rate, gradient, curvature)
        return Linearization(
            x, cost, gradient, curvature, g.T, jacobian.reshape(len(w), *g.shape), rate
        )

    def rows(self, at: Linearization, k: Indices, residual: Indices) -> Array:
        """Return the gradients of residuals with indices (m,) at grid points k, (m,), in the variables: (m, nx)."""
        return self._chain(at.jacobian[:, residual, k].T, k, at.rate, self.grid.bases)

    def linearization_errors(self, at: Linearization, step: float) -> Array:
        """Bound the change of residuals by derivatives of r if no log r changes by more than ``step``: (K, m)."""
        # |r^(i) after - before| <= sum_j |B_j^(i)| R_j step, to first order in the step
        orders = len(self.grid.bases.path)
        errors = np.zeros(at.g.shape)
        for order in range(1, orders - 1):
            change = np.abs(self.grid.bases.rate[order]) @ at.rate * step
            errors += np.abs(at.jacobian[orders * self.n + order]).T * change[:, None]
        return errors

    def _states(self, x: Array) -> tuple[Array, Array, Array]:
        """Return w = (p, p', p'', ..., r, r', ...) on the grid, shape (width, K), and the control points."""
        path, rate = self.unpack(x)
        return self.grid.bases.states(path, rate), path, rate

    def _evaluate_cost_residuals(
        self, path: Array, rate: Array
    ) -> tuple[Array, Array, Array]:
        """Return the cost term's residuals (m, Q), their Jacobian (4 n + 3, m, Q) and quadrature weights (Q,)."""
        assert self.kernels.cost_residuals is not None
        w = self.grid.cost_bases.states(path, rate)
        e, jacobian = self.kernels.cost_residuals(w)
        # dt = ds / r: quadrature weights of the phase become those of time.
        weights = self.grid.cost_weights / w[4 * self.n]
        return e, jacobian.reshape(len(w), *e.shape), weights

    def _add_cost_term(
        self, path: Array, rate: Array, gradient: Array, curvature: Array
    ) -> float:
        """Add the cost term's gradient and its Gauss-Newton Hessian.

        Return its value.
        """
        assert self.kernels.cost_term is not None
        bases = self.grid.cost_bases
        e, jacobian, weights = self._cost_residuals(path, rate)
        rho, rho_derivative = self.kernels.cost_term.rate(e, self.kernels.cost_counts)
        m, points = e.shape
        k = np.repeat(np.arange(points), m)
        residual = np.tile(np.arange(m), points)
        rows = self._chain(jacobian[:, residual, k].T, k, rate, bases)
        row_weights = (weights * rho_derivative)[residual, k]
        gradient += (row_weights * e[residual, k]) @ rows
        half = rows * np.sqrt(row_weights)[:, None]
        # The weights depend on r, too: d(1 / r) = -dr / r^2 with dr = B R d(log R).
        gradient[self.split :] -= (
            (weights * rho / (bases.rate[0] @ rate)) @ bases.rate[0] * rate
        )
        # A product of one matrix takes half the time.
        curvature += half.T @ half
        return float(weights @ rho)

    def _chain(
        self, state_gradients: Array, k: Indices, rate: Array, bases: Bases
    ) -> Array:
        """Convert gradients in w at nodes k, shape (m, width of w), to gradients in the variables, (m, nx)."""
        n = self.n
        m = len(k)
        orders = len(bases.path)
        # dg/dC = sum over orders of B^(i) dg/dp^(i), for all control points, also those
        # that the boundary conditions determine
        control = bases.path_at[k] @ state_gradients[:, : orders * n].reshape(
            m, orders, n
        )
        out = np.empty((m, self.nx))
        out[:, : self.split] = control[:, 3 : self._goal_points].reshape(m, self.split)
        out[:, self.split :] = (
            state_gradients[:, None, orders * n :] @ bases.rate_at[k]
        )[:, 0] * rate
        # Boundary control points depend on the first and last rates: chain rule through them.
        for item in self._boundary_derivatives(rate):
            out[:, self.split + item.variable] += control[:, item.point] @ (
                item.derivative[0] * rate[item.variable]
            )
        return out


@cache
def _smoothing(points: int) -> Array:
    """Return the Hessian of the regularization, shape (R, R)."""
    # |D log r|^2 with second differences D: constant and exponential rates cost nothing
    second = np.diff(np.eye(points), 2, axis=0)
    return np.asarray(2 * RATE_SMOOTHING * second.T @ second)


def cache_last(function: Callable[..., T]) -> Callable[..., T]:
    """Cache the last result of a function, keyed by the identity of its arguments.

    Threads may share the cache.
    """
    last: list[tuple[tuple[Any, ...], T]] = []

    def cached(*objects: Any) -> T:
        for arguments, result in last:
            if len(arguments) == len(objects) and all(
                a is b for a, b in zip(arguments, objects, strict=True)
            ):
                return result
        result = function(*objects)
        last[:] = [(objects, result)]
        return result

    return cached
