"""A baseline on the manifold: the straight line between the boundary control points, bent onto the equalities.

The paper's network corrects a straight line in joint space, which leaves the manifold by far: a heavy object tilts by
some 10 degrees on the way. A Gauss-Newton step removes nearly all of that before the network runs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.network.omega import along_line
from cnpgen.planner.bending import bending
from cnpgen.recipes import Problem, TrajectorySpec
from cnpgen.trajectory.boundary import Boundary, goal_points, start_points

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Baseline:
    """What bends the line of one problem; made by ``make_baseline``.

    Attributes:
        bend: Kernel of ``bending``.
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
        begin, interior = first[:, 2:3], self.spec.path_control_points - 3 - last.shape[1]
        line = begin + (last[:, :1] - begin) * along_line(interior)
        path = np.concatenate([first, line, last], axis=1)
        rows, points, n = path.shape
        (change,) = self.bend(np.ascontiguousarray(path.reshape(rows, points * n).T), np.ascontiguousarray(tops.T))
        return change.T.reshape(rows, interior, n)


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
    return Baseline(kernels.load(bending, shape=shape, steps=steps), spec)
