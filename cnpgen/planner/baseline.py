"""A baseline on the manifold: the straight line between the boundary control points, bent onto the equalities.

The paper's network corrects a straight line in joint space, which leaves the manifold by far: a heavy object tilts by
some 10 degrees on the way. A few Gauss-Newton steps on the interior control points remove that before the network
runs, with the smallest change of the second differences.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.recipes import TrajectorySpec
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from cnpgen.trajectory.spline import basis, clamped_knots

Array = NDArray[np.float64]

STRAIGHT = 0.05  # weight of the change itself beside that of its second differences
DAMPING = 1e-6  # keeps steps small where the equalities hardly depend on the joints
LONGEST = 0.6  # rad: no step moves a control point further
BLOCK = 256  # tasks at once, so that arrays stay in the cache


@dataclass(frozen=True)
class Baseline:
    """How the line is bent; made once per problem by ``make_baseline``.

    Attributes:
        residuals: Kernel of ``expressions.equality_residuals``.
        equalities: Number m of equalities.
        spec: Degree and numbers of control points.
        steps: Number of Gauss-Newton steps.
        path: Basis of all control points at the K collocation phases, shape (K, C).
        response: How control points follow a force at the phases, shape (interior points, K).
        coupling: How the phases follow it, shape (K, K).
    """

    residuals: Kernel
    equalities: int
    spec: TrajectorySpec
    steps: int
    path: Array
    response: Array
    coupling: Array

    def correction(self, boundary: Boundary, rate: Array, tops: Array) -> Array:
        """Compute what the interior control points deviate from the straight line by.

        Args:
            boundary: Boundary conditions of N motions.
            rate: Nominal rate of every motion [1/s], shape (N,): the line hangs on it where an end moves.
            tops: Heights of the obstacles' upper faces [m], shape (N, obstacles).

        Returns:
            Shape (N, interior points, n) [rad].
        """
        parts = [slice(first, first + BLOCK) for first in range(0, len(rate), BLOCK)]
        found = [self._bent(boundary[part], rate[part], tops[part]) for part in parts]
        interior = self.spec.path_control_points - 3 - boundary.fixed_at_goal
        return np.concatenate([np.empty((0, interior, boundary.start_q.shape[1])), *found])

    def _bent(self, boundary: Boundary, rate: Array, tops: Array) -> Array:
        rates = np.repeat(rate[:, None], self.spec.rate_control_points, axis=1)
        line = anchor_line(boundary, rates, self.spec)
        fixed = self.path @ assemble(boundary, line, rates, self.spec)
        inner = self.path[:, 3 : 3 + line.shape[1]]
        heights = np.repeat(tops.T, len(self.path), axis=1)
        change = np.zeros_like(line)
        for _ in range(self.steps):
            change += self._step(fixed + inner @ change, heights)
        return change

    def _step(self, q: Array, heights: Array) -> Array:
        """One Gauss-Newton step of the interior control points from positions q at the phases, shape (N, K, n)."""
        rows, count, n = q.shape
        residual, slopes = self.residuals(np.ascontiguousarray(q.reshape(-1, n).T), heights)
        m = self.equalities
        jacobian = slopes.reshape(n, m, rows, count).transpose(2, 1, 3, 0).reshape(rows, m * count, n)
        system = (jacobian @ jacobian.transpose(0, 2, 1)).reshape(rows, m, count, m, count)
        system *= self.coupling[None, None, :, None, :]
        system = system.reshape(rows, m * count, m * count)
        system += DAMPING * np.eye(m * count)
        wanted = -residual.reshape(m, rows, count).transpose(1, 0, 2).reshape(rows, m * count, 1)
        force = jacobian * np.linalg.solve(system, wanted)
        step: Array = self.response @ force.reshape(rows, m, count, n).sum(axis=1)
        size = np.abs(step).max(axis=(1, 2), initial=0.0)
        step *= np.minimum(1.0, LONGEST / np.maximum(size, LONGEST))[:, None, None]
        return step


def make_baseline(
    residuals: Kernel, equalities: int, spec: TrajectorySpec, *, fixed_at_goal: int = 2, steps: int = 3
) -> Baseline:
    """Prepare a baseline: one collocation phase per interior control point, where that point counts most.

    Args:
        residuals: Kernel of ``expressions.equality_residuals``.
        equalities: Number of equalities, at least 1.
        spec: Degree and numbers of control points.
        fixed_at_goal: Control points that the goal fixes.
        steps: Number of Gauss-Newton steps.
    """
    points, degree = spec.path_control_points, spec.degree
    knots = clamped_knots(points, degree)
    interior = range(3, points - fixed_at_goal)
    phases = np.array([knots[i + 1 : i + degree + 1].mean() for i in interior])  # Greville's abscissae
    table = basis(phases, points, degree)
    inner = table[:, 3 : points - fixed_at_goal]
    second = np.diff(np.eye(points), 2, axis=0)[:, 3 : points - fixed_at_goal]
    mobility = np.linalg.inv(second.T @ second + STRAIGHT * np.eye(len(phases)))
    response = mobility @ inner.T
    return Baseline(residuals, equalities, spec, steps, table, response, inner @ response)
