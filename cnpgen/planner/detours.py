"""Other lines where a plan breaks something at rest: with a corner at configurations that the model keeps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import rest_excess
from cnpgen.planner.speeds import BLOCK
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import basis, chebyshev

Array = NDArray[np.float64]

PHASES = 64


@dataclass(frozen=True)
class Detours:
    """Says which plans need another line, and which of the others will do; made by ``make_detours``.

    Attributes:
        middles: Where the corners of other lines are [rad], shape (M, n).
        excess: Kernel of ``expressions.rest_excess``.
        path: Basis of p at K phases, shape (K, C).
    """

    middles: Array
    excess: Kernel
    path: Array

    def broken(self, motion: Motion, tops: Array) -> Array:
        """By how much the worst condition on positions and holding torques is broken by N motions, in tolerances.

        Args:
            motion: N motions, with the problem's number of path control points.
            tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).

        Returns:
            Shape (N,); at most 1 where nothing is broken at any of the phases, inf where positions are no numbers.
        """
        found, phases = np.empty(len(motion)), len(self.path)
        for block in (slice(first, first + BLOCK) for first in range(0, len(motion), BLOCK)):
            q = (self.path @ motion.path[block]).reshape(-1, motion.path.shape[2])
            (worst,) = self.excess(np.ascontiguousarray(q.T), np.repeat(tops[block].T, phases, axis=1))
            found[block] = worst.reshape(-1, phases).max(axis=1)
        return np.nan_to_num(found, nan=np.inf, posinf=np.inf)

    def worth(self, broken: Array) -> NDArray[np.intp]:
        """Say which motions may be taken of those along all M lines of the first task, then of the next one.

        Args:
            broken: What they break, shape (N M,).

        Returns:
            Rows of motions: of every task those that break nothing, or else the one that breaks least.
        """
        of_task = broken.reshape(-1, len(self.middles))
        least = of_task.min(axis=1, keepdims=True)
        return np.flatnonzero(of_task <= np.maximum(least, 1))


def make_detours(problem: Problem, kernels: KernelLibrary, middles: Array) -> Detours:
    """Prepare the detours of one problem.

    Args:
        problem: The problem.
        kernels: Where kernels are loaded from.
        middles: Where the corners are [rad], shape (M, n).
    """
    spec = problem.trajectory
    path = basis(chebyshev(PHASES), spec.path_control_points, spec.degree)
    return Detours(middles, kernels.load(rest_excess), path)
