"""Uniform slow-down: motions from rest to rest may be run slower along the same path, as far as the limits need it.

At ``r / k`` velocities are 1/k and accelerations 1/k^2 of what they were. A bounded value g(q, dq, ddq) is then
``g0 + b / k + c / k^2``, exactly so for velocities, accelerations and torques; g at k = 1, at k = 2 and at rest gives
b and c, and the smallest k at which every g is within its bounds follows in closed form. What depends on the jerk
is ``g0 + d / k^3``.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import SpeedBounds, speed_bounds, speed_residuals
from cnpgen.planner.speeds import BLOCK, Speeds, load_speeds
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.motion import Motion

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

SLOWEST = 3.0  # no motion is slowed down more: what breaks limits by so much is no plan
INTERVALS = 128  # between phases
SPARE = 2e-4  # relative: between two phases a limit may be exceeded by about this much


@dataclass(frozen=True)
class Slowing(Speeds):
    """Finds how much slower motions of one problem must be; made by ``make_slowing``.

    Attributes:
        residuals: Kernel of ``expressions.speed_residuals``.
        bounds: Those of its values.
    """

    residuals: Kernel
    bounds: SpeedBounds

    def factor(self, motion: Motion, tops: Array) -> Array:
        """Smallest factor, at least 1, by which each of N motions from rest to rest must be slower.

        What slowing down does not help against (a torque that gravity alone exceeds) is left alone.

        Args:
            motion: N motions, with the problem's numbers of control points.
            tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).

        Returns:
            Shape (N,).
        """
        factor, phases = np.ones(len(motion)), self.path.shape[1]
        for block in (slice(first, first + BLOCK) for first in range(0, len(motion), BLOCK)):
            column = self.column(motion[block], tops[block])
            (excess,) = self.excess(column)
            over = np.flatnonzero(excess[0] > 0)  # most motions are slow enough everywhere, and one look tells
            if len(over):
                np.maximum.at(factor[block], over // phases, self._needed(column.take(over, axis=1)))
        return np.where(factor > 1, np.minimum(factor * (1 + SPARE), SLOWEST), 1.0)

    def _needed(self, column: Array) -> Array:
        """Smallest factors that L of the columns of ``column`` ask for, shape (L,)."""
        n, orders = self.residuals.tape.inputs[0], len(self.path)
        p, p1, p2, *third = column[: orders * n].reshape(orders, n, -1)
        (r, r1, *second), tops = column[orders * n :][: orders - 1], column[orders * n + orders - 1 :]
        moving = [p1 * r, (p2 * r + p1 * r1) * r]
        moving += [((third[0] * r + 3 * p2 * r1) * r + p1 * (second[0] * r + r1**2)) * r] if third else []
        fast, slow, rest = (
            self.residuals(p, *(each / k**order for order, each in enumerate(moving, 1)), tops)[0]
            for k in (1.0, 2.0, np.inf)
        )
        quadratic = 2 * (fast - 2 * slow + rest)  # c, from g(1) = rest + b + c and g(2) = rest + b / 2 + c / 4
        linear = fast - rest - quadratic
        above, below = self.bounds.upper[:, None] - rest, rest - self.bounds.lower[:, None]
        needed = np.maximum(_smallest(above, linear, quadratic), _smallest(below, -linear, -quadratic))
        cubic = self.bounds.cubic
        change = (fast - rest)[cubic]
        needed[cubic] = np.maximum(_smallest_cubic(above[cubic], change), _smallest_cubic(below[cubic], -change))
        return np.asarray(needed.max(axis=0, initial=1.0))


def make_slowing(problem: Problem, robot: "Robot", kernels: KernelLibrary) -> Slowing:
    """Prepare the slow-down of one problem.

    Args:
        problem: The problem.
        robot: Its robot.
        kernels: Where kernels are loaded from.
    """
    speeds, residuals = load_speeds(problem, kernels, INTERVALS), kernels.load(speed_residuals)
    return Slowing(speeds.excess, speeds.path, speeds.rate, residuals, speed_bounds(robot, problem))


def _smallest(room: Array, linear: Array, quadratic: Array) -> Array:
    """Smallest k >= 1 with ``linear / k + quadratic / k^2 <= room``, elementwise; 1 where there is no room at rest."""
    with np.errstate(all="ignore"):
        root = np.sqrt(np.maximum(linear**2 + 4 * quadratic * room, 0.0))
        k = (linear + root) / (2 * room)  # of room k^2 - linear k - quadratic = 0
    broken = (linear + quadratic > room) & (room > 0) & np.isfinite(k)
    return np.where(broken, np.maximum(k, 1.0), 1.0)


def _smallest_cubic(room: Array, change: Array) -> Array:
    """Smallest k >= 1 with ``change / k^3 <= room``, elementwise; 1 where there is no room at rest."""
    with np.errstate(all="ignore"):
        k = np.cbrt(change / room)
    return np.where((change > room) & (room > 0) & np.isfinite(k), k, 1.0)
