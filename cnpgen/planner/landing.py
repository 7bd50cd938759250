"""The last step onto the manifold: what the network gave is bent onto the equalities, and gradients go back through it.

With it the network need not hold equalities against everything else that it is asked for: plans are on the manifold at
eleven phases to second order, and between them as well as the spline can be.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.bending import bending, bending_adjoint
from cnpgen.recipes import Problem

Array = NDArray[Any]


@dataclass(frozen=True)
class Landing:
    """Bends plans of one problem onto its equalities; made by ``make_landing``.

    Attributes:
        bend: Kernel of ``bending``.
        adjoint: Kernel of ``bending_adjoint``; None where no gradient is asked for.
        interior: Which path control points move.
    """

    bend: Kernel
    adjoint: Kernel | None
    interior: slice

    def land(self, path: Array, tops: Array) -> Array:
        """Bend paths; boundary control points stay.

        Args:
            path: Path control points [rad], shape (N, C, n).
            tops: Heights of the obstacles' upper faces [m], shape (N, obstacles).

        Returns:
            New control points, of the same shape and type.
        """
        (change,) = self.bend(_lanes(path), _lanes(tops))
        landed = path.copy()
        inner = landed[:, self.interior]
        inner += change.T.reshape(inner.shape)
        return landed

    def pull_back(self, path: Array, tops: Array, gradient: Array) -> Array:
        """Turn the gradient with respect to landed control points into that with respect to those before.

        Args:
            path: Control points before [rad], shape (N, C, n).
            tops: Heights of the obstacles' upper faces [m], shape (N, obstacles).
            gradient: Gradient with respect to what ``land`` gave, shape (N, C, n).
        """
        assert self.adjoint is not None
        (back,) = self.adjoint(_lanes(path), _lanes(tops), _lanes(gradient[:, self.interior]))
        found: Array = gradient + back.T.reshape(path.shape).astype(gradient.dtype, copy=False)
        return found


def make_landing(
    problem: Problem, kernels: KernelLibrary, *, steps: int, gradients: bool, fixed_at_goal: int = 2
) -> Landing:
    """Load the landing of a problem that has equalities.

    Args:
        problem: The problem.
        kernels: Where kernels are loaded from.
        steps: Number of Gauss-Newton steps, at least 1.
        gradients: Whether gradients are asked for.
        fixed_at_goal: Control points that the goal fixes.
    """
    spec = problem.trajectory
    shape = (spec.degree, spec.path_control_points, fixed_at_goal)
    adjoint = kernels.load(bending_adjoint, shape=shape, steps=steps) if gradients else None
    bend = kernels.load(bending, shape=shape, steps=steps)
    return Landing(bend, adjoint, slice(3, spec.path_control_points - fixed_at_goal))


def _lanes(values: Array) -> NDArray[np.float64]:
    """Turn (N, ...) into (width, N), float64."""
    return np.ascontiguousarray(values.reshape(len(values), math.prod(values.shape[1:])).T, np.float64)
