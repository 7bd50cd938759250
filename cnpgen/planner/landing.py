"""The last step onto the manifold: what the network gave is bent onto the equalities, and gradients go back through it.

With it the network need not hold equalities against everything else that it is asked for: plans are on the manifold at
eleven phases to second order, and between them as well as the spline can be.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.curves import path_bend, path_bend_adjoint
from cnpgen.planner.expressions import useful_steps
from cnpgen.planner.preparation import lanes
from cnpgen.problems.problem import Problem

Array = NDArray[Any]


@dataclass(frozen=True)
class Landing:
    """Bends plans of one problem onto its equalities while training; made by ``make_landing``.

    Attributes:
        bend: Kernel of ``curves.path_bend``.
        adjoint: Kernel of ``curves.path_bend_adjoint``.
        interior: Which path control points move.
    """

    bend: Kernel
    adjoint: Kernel
    interior: slice

    def land(self, path: Array, tops: Array) -> Array:
        """Bend paths; boundary control points stay.

        Args:
            path: Path control points [rad], shape (N, C, n).
            tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).

        Returns:
            New control points, of the same shape and type.
        """
        (change,) = self.bend(lanes(path), lanes(tops))
        landed = path.copy()
        inner = landed[:, self.interior]
        inner += change.T.reshape(inner.shape)
        return landed

    def pull_back(self, path: Array, tops: Array, gradient: Array) -> Array:
        """Turn the gradient with respect to landed control points into that with respect to those before.

        Args:
            path: Control points before [rad], shape (N, C, n).
            tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).
            gradient: Gradient with respect to what ``land`` gave, shape (N, C, n).
        """
        (back,) = self.adjoint(lanes(path), lanes(tops), lanes(gradient[:, self.interior]))
        found: Array = gradient + back.T.reshape(path.shape).astype(gradient.dtype, copy=False)
        return found


def make_landing(
    problem: Problem, kernels: KernelLibrary, *, steps: int, fixed_at_goal: int = 2, within_limits: bool = False
) -> Landing | None:
    """Load the landing of a problem; None where there are no steps or no equalities.

    Args:
        problem: The problem.
        kernels: Where kernels are loaded from.
        steps: Number of Gauss-Newton steps.
        fixed_at_goal: Number of control points that the goal fixes (``Boundary.fixed_at_goal``).
        within_limits: Whether control points are kept within the joint limits (``Meaning``).
    """
    if not useful_steps(kernels, steps):
        return None
    interior = slice(3, problem.trajectory.path_control_points - fixed_at_goal)
    load = partial(kernels.load, steps=steps, fixed_at_goal=fixed_at_goal, within_limits=within_limits)
    return Landing(load(path_bend), load(path_bend_adjoint), interior)
