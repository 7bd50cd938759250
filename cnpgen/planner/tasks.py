"""Planning tasks: boundary conditions and the values computed from them before the network runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import AnyArray
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary

MIN_EXPECTED_TIME_S = 0.2  # lower bound of ``expected_time``
MIN_REACH_TIME_S = 0.03  # lower bound of ``reaching_time``
# Lower bound without effect on moving joints: avoids a division by zero.
MIN_TRAVEL_TIME_S = 1e-6
# ``expected_time``, ``reaching_time``, ``expected_time`` unbounded.
EXPECTED_TIMES = "distance", "reach", "travel"


@dataclass(frozen=True)
class Tasks:
    """N planning tasks of one problem with n joints.

    Attributes:
        boundary: Boundary conditions, shape (N, n) each.
        start_xyz: Tip positions at the start, world frame [m], shape (N, 3).
        goal_xyz: Tip positions at the goal, world frame [m], shape (N, 3).
        expected_time: Unit of durations [s], shape (N,): network outputs are rates
            times this.
        scene: Obstacles of the tasks.
        correction: Offsets of the projected line from the straight one [rad], shape (N,
            m, n); None if it is straight.
        placed: Obstacles of a problem whose samples place them; ``scene`` has none
            then. None for other problems.
        observation: Features of the placed obstacles, shape (N, F), or None.
    """

    boundary: Boundary
    start_xyz: AnyArray
    goal_xyz: AnyArray
    expected_time: AnyArray
    scene: Scene
    correction: AnyArray | None = None
    placed: Scene | None = None
    observation: AnyArray | None = None

    def __repr__(self) -> str:
        return f"<Tasks of shape {np.shape(self.boundary.start_q)}>"

    def __len__(self) -> int:
        return len(self.expected_time)

    @property
    def obstacle_poses(self) -> AnyArray:
        """Poses and sizes of all obstacles, as losses take them, shape (N, width)."""
        return (self.scene if self.placed is None else self.placed).poses

    def take(self, rows: slice | NDArray[Any]) -> Tasks:
        """Return a subset of the tasks."""
        return self._converted(lambda part: part[rows])

    def astype(self, dtype: str) -> Tasks:
        """Return the tasks in another float type."""
        return self._converted(lambda part: part.astype(dtype))

    def _converted(self, convert: Callable[[Any], Any]) -> Tasks:
        parts: dict[str, Any] = {
            name: None if part is None else convert(part)
            for name, part in vars(self).items()
        }
        return Tasks(**parts)


def lanes(values: NDArray[Any]) -> NDArray[np.float64]:
    """Reshape (N, ...) to (width, N), float64."""
    return np.ascontiguousarray(
        values.reshape(len(values), math.prod(values.shape[1:])).T, np.float64
    )


def rows(values: AnyArray, n: int) -> AnyArray:
    """Reshape (points n, N) to (N, points, n)."""
    return np.ascontiguousarray(values.T).reshape(
        values.shape[1], values.shape[0] // n, n
    )


def ends_of(boundary: Boundary) -> AnyArray:
    """Return boundary conditions of N motions, shape (5 n, N), or (6 n, N) with goal_ddq."""
    return np.ascontiguousarray(
        np.concatenate(list(boundary.conditions().values()), axis=1).T
    )


def expected_time(
    boundary: Boundary, velocity_limit: AnyArray, *, least: float = MIN_EXPECTED_TIME_S
) -> AnyArray:
    """Return the largest time that a joint needs at its velocity limit (authors' implementation, expected time) [s].

    Velocity limits [rad/s] have shape (n,) or (N, n), times shape (N,) and the lower
    bound ``least`` [s].
    """
    # T = max(least, max over joints of |goal - start| / v_max)
    joint_times: AnyArray = np.abs(boundary.goal_q - boundary.start_q) / velocity_limit
    # In two thirds of the time of max().
    time: AnyArray = np.maximum.reduce(joint_times, axis=1, initial=least)
    return time


def reaching_time(robot: Robot, *, fixed_at_goal: int) -> Any:
    """Build ``ends -> time``: the minimum time in which every joint alone could reach its goal state [s].

    Each joint accelerates at its limit in either direction, and cruises at its velocity
    limit if it would exceed it. This is a lower bound of the motion time if it exceeds
    ``MIN_REACH_TIME_S``. Ends are those of ``control_point_functions``. The kernel
    takes an eighth of the time of NumPy for one task.
    """
    import casadi as ca

    ends = ca.SX.sym("ends", (3 + fixed_at_goal) * robot.n)
    q, dq, _, goal_q, goal_dq, *_ = ca.vertsplit(ends, robot.n)
    velocity = ca.SX(robot.velocity_limit)
    acceleration = ca.SX(robot.acceleration_limit)
    # Distance at constant acceleration from dq to goal_dq.
    direct = (dq + goal_dq) * ca.fabs(goal_dq - dq) / (2 * acceleration)
    # On this side the joint speeds up first; mirrored, only one case remains.
    side = ca.if_else(goal_q - q >= direct, 1.0, -1.0)
    first, last, distance = side * dq, side * goal_dq, side * (goal_q - q)
    # Accelerate to a peak, then decelerate: peak^2 = a distance + (first^2 + last^2) /
    # 2.
    squares = (first**2 + last**2) / 2
    peak = ca.sqrt(ca.fmax(acceleration * distance + squares, 0.0))
    # An end may be faster than the limit; the joint then cruises at that speed.
    fastest = ca.fmax(velocity, ca.fmax(first, last))
    # Beyond the velocity limit the peak is cut off, and the rest is cruised.
    cruise = ca.fmax(distance - (fastest**2 - squares) / acceleration, 0.0) / fastest
    joint_times = (
        2 * ca.fmin(peak, fastest) - first - last
    ) / acceleration + ca.if_else(peak > fastest, cruise, 0.0)
    # All joints move at once: the slowest determines the time.
    time = reduce(ca.fmax, ca.vertsplit(joint_times), ca.SX(MIN_REACH_TIME_S))
    return ca.Function("reaching_time", [ends], [time])
