"""Alternative lines through via points of the model, for plans that violate static conditions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import GridKernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.tape import GridSpec
from cnpgen.planner.control_points import lines_at_rest
from cnpgen.planner.expressions import static_violation
from cnpgen.planner.tasks import Tasks
from cnpgen.planner.time_scaling import blocks_of_motions
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.spline import basis, chebyshev
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

STATIC_INTERVALS = 32  # between phases
COARSE_PHASES = slice(2, None, 4)  # that most violating motions fail at
MOTIONS_PER_CALL = 512  # of the kernel
MAX_LINES = 4  # that motions are planned along


@dataclass(frozen=True)
class ViaPoints:
    """Via points of one problem's model, and the check of static conditions; made by ``make_via_points``.

    Attributes:
        via_points: Configurations [rad], shape (M, n).
        static_violation: Kernel of ``expressions.static_violation`` at phases of motions, in single precision.
        path: Basis of p at K phases, shape (K, C), float32.
    """

    via_points: Array
    static_violation: GridKernel
    path: NDArray[np.float32]

    def violation(self, motion: Motion, obstacle_poses: Array) -> Array:
        """Return the largest violation of conditions on positions and holding torques by N motions, in tolerances.

        It is at most 1 if all conditions hold at the phases, and inf if a position is not finite.
        """
        return self._violation_at(self.path, motion.path, obstacle_poses)

    def lower_bound(self, motion: Motion, obstacle_poses: Array) -> Array:
        """Return lower bounds of ``violation`` that are above 1 for the same motions, in a fraction of the time.

        Motions with a violation at one of a few phases are not checked at the others.
        """
        bound = self._violation_at(self.path[COARSE_PHASES], motion.path, obstacle_poses)
        unclear = np.flatnonzero(bound <= 1)
        bound[unclear] = self.violation(motion[unclear], obstacle_poses[unclear])
        return bound

    def _violation_at(self, basis_of_p: NDArray[np.float32], path: Array, obstacle_poses: Array) -> Array:
        values = np.empty((1, len(basis_of_p), len(path)), np.float32)
        for block in blocks_of_motions(len(path), MOTIONS_PER_CALL):
            q = np.matmul(basis_of_p, path[block].transpose(2, 1, 0).astype(np.float32, order="C"))
            poses = obstacle_poses[block].T.astype(np.float32, order="C")
            self.static_violation(q, poses, out=[values[..., block]])
        worst: Array = values[0].max(axis=0).astype(np.float64)
        return np.nan_to_num(worst, nan=np.inf, posinf=np.inf)

    def best_lines(self, lines: Tasks, count: int) -> NDArray[np.intp]:
        """Return the rows of the ``count`` lines of every task with the smallest violations at a few phases.

        The lines are all M lines of the first task, then of the next one.
        """
        assert lines.correction is not None
        path = lines_at_rest(lines.boundary, lines.correction)
        violation = self._violation_at(self.path[COARSE_PHASES], path, lines.scene.poses)
        order = violation.reshape(-1, len(self.via_points)).argsort(axis=1, kind="stable")[:, :count]
        return np.asarray((order + len(self.via_points) * np.arange(len(order))[:, None]).ravel())

    @staticmethod
    def candidates(violation: Array, count: int) -> NDArray[np.intp]:
        """Return rows of motions: for every task those without violation, or else the one with the smallest.

        Violations, shape (N count,), are those along ``count`` lines of the first task, then of the next one.
        """
        of_task = violation.reshape(-1, count)
        least = of_task.min(axis=1, keepdims=True)
        return np.flatnonzero(of_task <= np.maximum(least, 1))


def make_via_points(problem: Problem, kernels: KernelLibrary, via_points: Array) -> ViaPoints:
    """Load the check of via points [rad], shape (M, n), for one problem."""
    spec = problem.trajectory
    path = basis(chebyshev(STATIC_INTERVALS), spec.path_control_points, spec.degree)
    kernel = kernels.load_grid(static_violation, GridSpec(("point", "lane"), ("point",)), dtype="float32")
    return ViaPoints(via_points, kernel, path.astype(np.float32))
