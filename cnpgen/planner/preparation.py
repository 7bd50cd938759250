"""From boundary conditions to tasks: tip positions, obstacles, expected time, bent line; for training and planning."""

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.control_points import along_line
from cnpgen.planner.curves import corner_bend, line_bend, tips_at_ends
from cnpgen.planner.expressions import useful_steps
from cnpgen.planner.tasks import Tasks, expected_time, reaching_time
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.boundary import Boundary

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


def lanes(values: NDArray[Any]) -> Array:
    """Turn (N, ...) into (width, N), float64."""
    return np.ascontiguousarray(values.reshape(len(values), math.prod(values.shape[1:])).T, np.float64)


def rows(values: Array, n: int) -> Array:
    """Turn (points n, N) into (N, points, n)."""
    return np.ascontiguousarray(values.T).reshape(values.shape[1], values.shape[0] // n, n)


def ends_of(boundary: Boundary) -> Array:
    """Boundary conditions of N motions as ``curves`` takes them, shape (5 n, N), or (6 n, N) with goal_ddq."""
    return np.ascontiguousarray(np.concatenate(list(boundary.given().values()), axis=1).T)


@dataclass(frozen=True)
class Preparation:
    """Prepares tasks of one problem; made by ``prepare_tasks``.

    Attributes:
        problem: The problem.
        velocity_limit: Planning limits [rad/s], shape (n,).
        tips: Kernel of ``curves.tips_at_ends``.
        line: Kernel of ``curves.line_bend``; None where the line stays straight.
        reaching_time: Kernel of ``tasks.reaching_time``; None where the time of the distance is expected.
        corner: Kernel of ``curves.corner_bend``; None where there are no lines with corners, or they are not bent.
    """

    problem: Problem
    velocity_limit: Array
    tips: Kernel
    line: Kernel | None
    reaching_time: Kernel | None = None
    corner: Kernel | None = None

    def __call__(self, boundary: Boundary, middle: Array | None = None, *, ends: Array | None = None) -> Tasks:
        """Prepare N tasks, in float64.

        Args:
            boundary: Boundary conditions, shape (N, n) each.
            middle: Where lines have a corner half way before they are bent [rad], shape (N, n); none by default.
            ends: What ``ends_of`` gives of the boundary conditions, where that is known.
        """
        ends = ends_of(boundary) if ends is None else ends
        start_xyz, goal_xyz = (tip.T for tip in self.tips(ends))
        reaching = self.reaching_time
        time = expected_time(boundary, self.velocity_limit) if reaching is None else reaching(ends)[0][0]
        correction = None if middle is None else self._aside(boundary, middle)
        bend, aside = (self.line, []) if correction is None else (self.corner, [lanes(correction)])
        if bend is not None:
            (change,) = bend(ends, *aside, 1 / time[None], lanes(self.tops(start_xyz, goal_xyz)))
            correction = rows(change, boundary.start_q.shape[1])
        return Tasks(boundary, start_xyz, goal_xyz, time, correction)

    def _aside(self, boundary: Boundary, middle: Array) -> Array:
        """How far lines with a corner are off straight ones at their interior control points [rad], shape (N, m, n)."""
        along = along_line(self.problem.trajectory.path_control_points - 3 - boundary.fixed_at_goal)
        aside = middle - (boundary.start_q + boundary.goal_q) / 2
        return np.asarray((1 - np.abs(2 * along - 1)) * aside[:, None])

    def tops(self, start_xyz: Array, goal_xyz: Array) -> Array:
        """Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers)."""
        return obstacle_tops(self.problem, start_xyz, goal_xyz)


def prepare_tasks(
    problem: Problem,
    robot: "Robot",
    kernels: KernelLibrary,
    *,
    bending_steps: int,
    expected_time: str = "distance",
    fixed_at_goal: int = 2,
    within_limits: bool = False,
    corners: bool = False,
) -> Preparation:
    """Load what tasks are prepared with.

    Args:
        problem: The problem.
        robot: Its robot.
        kernels: Where kernels are loaded from.
        bending_steps: Gauss-Newton steps that bend the line; it stays straight where there are no equalities.
        expected_time: Which of ``EXPECTED_TIMES`` is taken.
        fixed_at_goal: Number of control points that the goal fixes (``Boundary.fixed_at_goal``).
        within_limits: Whether control points are kept within the joint limits (``Meaning``).
        corners: Whether there are lines with corners, too.
    """
    steps = useful_steps(kernels, bending_steps)
    load = partial(kernels.load, steps=steps, fixed_at_goal=fixed_at_goal, within_limits=within_limits)
    line = load(line_bend) if steps else None
    tips = kernels.load(tips_at_ends, fixed_at_goal=fixed_at_goal)
    time = kernels.load(reaching_time, fixed_at_goal=fixed_at_goal) if expected_time == "reach" else None
    corner = load(corner_bend) if steps and corners else None
    return Preparation(problem, robot.velocity_limit, tips, line, time, corner)
