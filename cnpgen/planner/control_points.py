"""The paper's Omega block: control points from network outputs, and the vector-Jacobian product back.

``C_{3+i} = line_i + correction_i + scale phi_i`` with the line from C_2 to C_{C-N_d},
and ``rate = e^o / T_expected``. The boundary control points follow from the rates, so
that boundary conditions hold by construction. The line depends on two of them, so
gradients of the path reach the rates both directly and through the line.

During training, a ``Projection`` moves paths onto the manifold's equalities, so that
the network need not trade them against other terms of the loss. Paths meet the
equalities at eleven phases to second order, and between them as well as the spline can.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.control_point_functions import path_change, path_change_adjoint
from cnpgen.planner.expressions import effective_steps
from cnpgen.planner.tasks import Tasks, lanes
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.boundary import (
    Boundary,
    boundary_derivatives,
    goal_points,
    start_points,
)
from cnpgen.trajectory.trajectory_spec import TrajectorySpec


@dataclass(frozen=True)
class ControlPoints:
    """Control points of N motions.

    Attributes:
        path: Control points of p [rad], shape (N, C, n).
        rate: Control points of r [1/s], shape (N, R).
    """

    path: AnyArray
    rate: AnyArray

    def __repr__(self) -> str:
        return (
            f"<ControlPoints: path {np.shape(self.path)}, rate {np.shape(self.rate)}>"
        )


def control_points(
    tasks: Tasks,
    phi: AnyArray,
    log_rate: AnyArray,
    *,
    scale: float,
    spec: TrajectorySpec,
) -> ControlPoints:
    """Compute control points in the dtype of the arguments; ``scale`` is the factor of phi [rad], the paper's pi.

    The outputs of the configuration head, phi in (-1, 1), have shape (N, m n), those of
    the time head (N, R).
    """
    boundary = tasks.boundary
    # exp keeps rates positive; the expected time is their unit.
    rate = np.exp(log_rate)
    rate /= tasks.expected_time[:, None]
    first, last = start_points(boundary, rate, spec), goal_points(boundary, rate, spec)
    n = boundary.start_q.shape[1]
    interior = (scale * phi).reshape(len(phi), phi.shape[1] // n, n)
    # line_i + scale phi_i in place, without another array.
    begin = first[:, 2:3]
    interior += begin + (last[:, :1] - begin) * along_line(
        interior.shape[1], interior.dtype.name
    )
    if tasks.correction is not None:
        interior += tasks.correction
    return ControlPoints(np.concatenate([first, interior, last], axis=1), rate)


def vjp(
    tasks: Tasks,
    points: ControlPoints,
    *,
    path_gradient: AnyArray,
    rate_gradient: AnyArray,
    scale: float,
    spec: TrajectorySpec,
) -> tuple[AnyArray, AnyArray]:
    """Convert gradients with respect to the control points to gradients with respect to the network's outputs.

    The gradients of ``points``, the result of ``control_points``, have shapes (N, C, n)
    and (N, R). Those of phi and of the logarithms of the rates have shapes (N, m n) and
    (N, R).
    """
    interior = path_gradient[
        :, 3 : spec.path_control_points - tasks.boundary.fixed_at_goal
    ]
    along = along_line(interior.shape[1], interior.dtype.name)[:, 0]
    # The line depends on both of its ends: C_{3+i} = (1 - a_i) first + a_i last + ...
    total = path_gradient.copy()
    total[:, 2] += (1 - along) @ interior
    total[:, spec.path_control_points - tasks.boundary.fixed_at_goal] += (
        along @ interior
    )
    rates = rate_gradient.copy()
    # Boundary points depend on the rates next to them.
    for effect in boundary_derivatives(tasks.boundary, points.rate, spec):
        rates[:, effect.variable] += np.einsum(
            "ij,ij->i", total[:, effect.point], effect.derivative
        )
    # d rate / d log_rate = rate.
    rates *= points.rate
    return scale * interior.reshape(len(interior), math.prod(interior.shape[1:])), rates


def lines_at_rest(boundary: Boundary, correction: AnyArray) -> AnyArray:
    """Return control points of lines between states at rest, shape (N, C, n), plus corrections [rad], (N, m, n)."""
    start, goal = boundary.start_q[:, None], boundary.goal_q[:, None]
    # At rest the control points that an end fixes are all equal to its position.
    interior = start + (goal - start) * along_line(correction.shape[1]) + correction
    last = np.repeat(goal, boundary.fixed_at_goal, axis=1)
    return np.concatenate([np.repeat(start, 3, axis=1), interior, last], axis=1)


@lru_cache(maxsize=16)
def along_line(count: int, dtype: str = "float64") -> AnyArray:
    """Return the interior control points' fractions of the line from C_2 to C_{C-N_d}, shape (m, 1)."""
    return np.linspace(0, 1, count, dtype=dtype)[:, None]


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

    def project(self, path: AnyArray, obstacle_poses: AnyArray) -> AnyArray:
        """Return projected control points of paths [rad], shape (N, C, n).

        Boundary control points stay.
        """
        (change,) = self.change(lanes(path), lanes(obstacle_poses))
        projected = path.copy()
        inner = projected[:, self.interior]
        inner += change.T.reshape(inner.shape)
        return projected

    def vjp(
        self, path: AnyArray, obstacle_poses: AnyArray, gradient: AnyArray
    ) -> AnyArray:
        """Convert the gradient with respect to the result of ``project`` to that with respect to its argument."""
        # Chain rule of path + change(path): the gradient itself, and that through the
        # change.
        (through_change,) = self.adjoint(
            lanes(path), lanes(obstacle_poses), lanes(gradient[:, self.interior])
        )
        total: AnyArray = gradient + through_change.T.reshape(path.shape).astype(
            gradient.dtype, copy=False
        )
        return total


def make_projection(
    problem: Problem,
    kernels: KernelLibrary,
    *,
    steps: int,
    fixed_at_goal: int = 2,
    within_limits: bool = False,
) -> Projection | None:
    """Load the projection of a problem by Gauss-Newton steps.

    None if there are no steps or no equalities.
    """
    # A problem without equalities on positions needs no projection.
    if not effective_steps(kernels, steps):
        return None
    interior = slice(3, problem.trajectory.path_control_points - fixed_at_goal)
    load = partial(
        kernels.load,
        steps=steps,
        fixed_at_goal=fixed_at_goal,
        within_limits=within_limits,
    )
    return Projection(load(path_change), load(path_change_adjoint), interior)
