"""What bounds how fast the paths of one problem may be run: how far they are out at K phases."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import speed_excess
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import basis, chebyshev

Array = NDArray[np.float64]

BLOCK = 64  # motions at once, so that arrays stay in the cache


@dataclass(frozen=True)
class Speeds:
    """What slowing down and pacing look at; made by ``load_speeds``.

    Attributes:
        excess: Kernel of ``expressions.speed_excess``.
        path: Basis of p and its derivatives at K phases, shape (orders, K, C).
        rate: Basis of r and its derivatives, shape (orders - 1, K, R).
    """

    excess: Kernel
    path: Array
    rate: Array

    def column(self, motion: Motion, tops: Array) -> Array:
        """Lay out p, p', ..., r, r', ... and obstacles at all phases of N motions, shape (width, N K)."""
        (orders, phases, points), (count, _, n) = self.path.shape, motion.path.shape
        first, last = orders * n, orders * n + orders - 1
        out = np.empty((last + tops.shape[1], count * phases))
        path = motion.path.transpose(2, 0, 1).reshape(n * count, points)
        np.matmul(path, self.path.swapaxes(1, 2), out=out[:first].reshape(orders, n * count, phases))
        np.matmul(motion.rate, self.rate.swapaxes(1, 2), out=out[first:last].reshape(orders - 1, count, phases))
        out[last:].reshape(-1, count, phases)[:] = tops.T[..., None]
        return out


def load_speeds(problem: Problem, kernels: KernelLibrary, intervals: int) -> Speeds:
    """Load them for one problem.

    Args:
        problem: The problem.
        kernels: Where kernels are loaded from.
        intervals: Between phases, one less than these.
    """
    spec, s, orders = problem.trajectory, chebyshev(intervals), problem.path_orders
    path = np.stack([basis(s, spec.path_control_points, spec.degree, order) for order in range(orders)])
    rate = np.stack([basis(s, spec.rate_control_points, spec.degree, order) for order in range(orders - 1)])
    return Speeds(kernels.load(speed_excess), path, rate)
