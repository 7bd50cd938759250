"""Alternative lines through via points of the model, for plans that violate static conditions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import static_violation
from cnpgen.planner.phase_grid import blocks_of_motions
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.spline import basis, chebyshev
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

STATIC_INTERVALS = 64  # between phases


@dataclass(frozen=True)
class ViaPoints:
    """Via points of one problem's model, and the check of static conditions; made by ``make_via_points``.

    Attributes:
        via_points: Configurations [rad], shape (M, n).
        static_violation: Kernel of ``expressions.static_violation``.
        path: Basis of p at K phases, shape (K, C).
    """

    via_points: Array
    static_violation: Kernel
    path: Array

    def violation(self, motion: Motion, obstacle_poses: Array) -> Array:
        """Return the largest violation of conditions on positions and holding torques by N motions, in tolerances.

        Args:
            motion: N motions, with the problem's number of path control points.
            obstacle_poses: Poses and sizes of the obstacles, shape (N, width).

        Returns:
            Shape (N,); at most 1 if all conditions hold at the phases, inf if a position is not finite.
        """
        violation, phases = np.empty(len(motion)), len(self.path)
        for block in blocks_of_motions(len(motion)):
            q = (self.path @ motion.path[block]).reshape(-1, motion.path.shape[2])
            (worst,) = self.static_violation(
                np.ascontiguousarray(q.T), np.repeat(obstacle_poses[block].T, phases, axis=1)
            )
            violation[block] = worst.reshape(-1, phases).max(axis=1)
        return np.nan_to_num(violation, nan=np.inf, posinf=np.inf)

    def candidates(self, violation: Array) -> NDArray[np.intp]:
        """Return the motions to choose from, given motions along all M lines of the first task, then of the next one.

        Args:
            violation: Largest violations, shape (N M,).

        Returns:
            Rows of motions: for every task those without violation, or else the one with the smallest.
        """
        of_task = violation.reshape(-1, len(self.via_points))
        least = of_task.min(axis=1, keepdims=True)
        return np.flatnonzero(of_task <= np.maximum(least, 1))


def make_via_points(problem: Problem, kernels: KernelLibrary, via_points: Array) -> ViaPoints:
    """Load the check of via points for one problem.

    Args:
        problem: The problem.
        kernels: Library of kernels.
        via_points: Configurations [rad], shape (M, n).
    """
    spec = problem.trajectory
    path = basis(chebyshev(STATIC_INTERVALS), spec.path_control_points, spec.degree)
    return ViaPoints(via_points, kernels.load(static_violation), path)
