"""What bounds how fast the paths of one problem may be run: kernels and bounds, and the splines' basis at K phases."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import speed_bounds, speed_excess, speed_residuals
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.spline import basis, chebyshev

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

PHASES = 128
BLOCK = 64  # motions at once, so that arrays stay in the cache


@dataclass(frozen=True)
class Speeds:
    """What slowing down and pacing look at; made by ``load_speeds``.

    Attributes:
        excess: Kernel of ``expressions.speed_excess``.
        residuals: Kernel of ``expressions.speed_residuals``.
        lower: Lower bounds of its values, shape (m,).
        upper: Upper bounds, shape (m,).
        cubic: Which of the values depend on the jerk, shape (m,).
        path: Basis of p and its derivatives at K phases, shape (orders, K, C).
        rate: Basis of r and its derivatives, shape (orders - 1, K, R).
    """

    excess: Kernel
    residuals: Kernel
    lower: Array
    upper: Array
    cubic: NDArray[np.bool_]
    path: Array
    rate: Array


def load_speeds(problem: Problem, robot: "Robot", kernels: KernelLibrary) -> Speeds:
    """Load them for one problem.

    Args:
        problem: The problem.
        robot: Its robot.
        kernels: Where kernels are loaded from.
    """
    spec, s, orders = problem.trajectory, chebyshev(PHASES), problem.path_orders
    path = np.stack([basis(s, spec.path_control_points, spec.degree, order) for order in range(orders)])
    rate = np.stack([basis(s, spec.rate_control_points, spec.degree, order) for order in range(orders - 1)])
    excess, residuals = kernels.load(speed_excess), kernels.load(speed_residuals)
    return Speeds(excess, residuals, *speed_bounds(robot, problem), path=path, rate=rate)
