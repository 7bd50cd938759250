"""Project network paths onto the manifold's equalities during training, and gradients back.

With the projection the network need not trade equalities against other terms of the loss. Paths meet the equalities
at eleven phases to second order, and between them as well as the spline can.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.control_point_functions import path_change, path_change_adjoint
from cnpgen.planner.expressions import effective_steps
from cnpgen.planner.task_preprocessor import lanes
from cnpgen.problems.problem import Problem

Array = NDArray[Any]


@dataclass(frozen=True)
class Projection:
    """Projection of one problem's paths onto its equalities; made by ``make_projection``.

    Attributes:
        change: Kernel of ``control_point_functions.path_change``.
        adjoint: Kernel of ``control_point_functions.path_change_adjoint``.
        interior: Slice of the path control points that move.
    """

    change: Kernel
    adjoint: Kernel
    interior: slice

    def project(self, path: Array, obstacle_poses: Array) -> Array:
        """Project paths; boundary control points stay.

        Args:
            path: Path control points [rad], shape (N, C, n).
            obstacle_poses: Poses and sizes of the obstacles, shape (N, width).

        Returns:
            New control points, of the same shape and type.
        """
        (change,) = self.change(lanes(path), lanes(obstacle_poses))
        projected = path.copy()
        inner = projected[:, self.interior]
        inner += change.T.reshape(inner.shape)
        return projected

    def vjp(self, path: Array, obstacle_poses: Array, gradient: Array) -> Array:
        """Convert the gradient with respect to projected control points to that with respect to the unprojected ones.

        Args:
            path: Control points before the projection [rad], shape (N, C, n).
            obstacle_poses: Poses and sizes of the obstacles, shape (N, width).
            gradient: Gradient with respect to the result of ``project``, shape (N, C, n).
        """
        (through_change,) = self.adjoint(lanes(path), lanes(obstacle_poses), lanes(gradient[:, self.interior]))
        total: Array = gradient + through_change.T.reshape(path.shape).astype(gradient.dtype, copy=False)
        return total


def make_projection(
    problem: Problem, kernels: KernelLibrary, *, steps: int, fixed_at_goal: int = 2, within_limits: bool = False
) -> Projection | None:
    """Load the projection of a problem by Gauss-Newton steps; None if there are no steps or no equalities."""
    if not effective_steps(kernels, steps):
        return None
    interior = slice(3, problem.trajectory.path_control_points - fixed_at_goal)
    load = partial(kernels.load, steps=steps, fixed_at_goal=fixed_at_goal, within_limits=within_limits)
    return Projection(load(path_change), load(path_change_adjoint), interior)
