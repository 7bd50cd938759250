"""Evaluate the bounds that depend on the rate of motions at K phases."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import speed_violation
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.spline import basis, chebyshev
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

MOTIONS_PER_BLOCK = 64  # small enough for arrays to stay in the CPU cache


def blocks_of_motions(count: int, size: int = MOTIONS_PER_BLOCK) -> list[slice]:
    """Split motions into blocks of ``size``."""
    return [slice(first, first + size) for first in range(0, count, size)]


@dataclass(frozen=True)
class PhaseGrid:
    """Grid of K phases, for time scaling and time parametrization; made by ``make_phase_grid``.

    Attributes:
        violation: Kernel of ``expressions.speed_violation``.
        path: Basis of p and its derivatives at the phases, shape (orders, K, C).
        rate: Basis of r and its derivatives at the phases, shape (orders - 1, K, R).
    """

    violation: Kernel
    path: Array
    rate: Array

    def column(self, motion: Motion, obstacle_poses: Array) -> Array:
        """Return p, p', ..., r, r', ... and obstacle poses at all phases of N motions, shape (width, N K)."""
        (orders, phases, points), (count, _, n) = self.path.shape, motion.path.shape
        first, last = orders * n, orders * n + orders - 1
        out = np.empty((last + obstacle_poses.shape[1], count * phases))
        path = motion.path.transpose(2, 0, 1).reshape(n * count, points)
        np.matmul(path, self.path.swapaxes(1, 2), out=out[:first].reshape(orders, n * count, phases))
        np.matmul(motion.rate, self.rate.swapaxes(1, 2), out=out[first:last].reshape(orders - 1, count, phases))
        out[last:].reshape(-1, count, phases)[:] = obstacle_poses.T[..., None]
        return out


def make_phase_grid(problem: Problem, kernels: KernelLibrary, intervals: int) -> PhaseGrid:
    """Make the grid of one problem, with K - 1 intervals between its phases."""
    spec, s, orders = problem.trajectory, chebyshev(intervals), problem.path_orders
    path = np.stack([basis(s, spec.path_control_points, spec.degree, order) for order in range(orders)])
    rate = np.stack([basis(s, spec.rate_control_points, spec.degree, order) for order in range(orders - 1)])
    return PhaseGrid(kernels.load(speed_violation), path, rate)
