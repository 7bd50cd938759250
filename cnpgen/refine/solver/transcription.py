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

so that it is positive semidefinite. ``step.c`` computes these derivatives, and
``benchmarks/numpy_transcription.py`` is their reference in NumPy.
"""

from collections.abc import Callable
from ctypes import CDLL
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.kernel import Kernel
from cnpgen.refine.solver.grid import Grid
from cnpgen.refine.solver.residuals import CostTerm
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

T = TypeVar("T")
# Weight of the squared second differences of log r, which selects one of many
# parametrizations.
RATE_SMOOTHING = 1e-4


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
        # Values and positions of one step are needed one after the other.
        self.states = cache_last(self._states)

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
        return self.states(x)[0][: self.n]

    def regularization(self, x: Array) -> float:
        """Return the regularization of log r, which selects one of many equivalent parametrizations."""
        log = x[self.split :]
        return float(0.5 * log @ self.smoothing @ log)

    def measured(self, x: Array) -> tuple[float, Array]:
        """Evaluate ``objective`` and residuals (K, m)."""
        w, path, rate = self.states(x)
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
        assert self.kernels.cost_residuals is not None
        w = self.grid.cost_bases.states(path, rate)
        e, _ = self.kernels.cost_residuals(w)
        rho = self.kernels.cost_term.rate(e, self.kernels.cost_counts)
        # dt = ds / r: quadrature weights of the phase become those of time.
        return self.duration(rate) + float(
            (self.grid.cost_weights / w[4 * self.n]) @ rho
        )

    def duration(self, rate: Array) -> float:
        """Return the motion time [s] of rate control points [1/s], shape (R,)."""
        return float(self.grid.time_weights @ (1.0 / (self.grid.time_basis @ rate)))

    def _states(self, x: Array) -> tuple[Array, Array, Array]:
        """Return w = (p, p', p'', ..., r, r', ...) on the grid, shape (width, K), and the control points."""
        path, rate = self.unpack(x)
        return self.grid.bases.states(path, rate), path, rate


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
