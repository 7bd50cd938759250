"""What a planner is asked for: boundary conditions, and what follows from them before any network runs."""

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.boundary import Boundary

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[Any]

SHORTEST_TIME = 0.2  # s: floor of the expected time; what lies close together is not reached in no time at all
SHORTEST_REACH = 0.03  # s: likewise of the time that velocities and accelerations need
EXPECTED_TIMES = ("distance", "reach")  # what a model may take for the expected time: the two functions here


@dataclass(frozen=True)
class Tasks:
    """N planning tasks of one problem with n joints.

    Attributes:
        boundary: Boundary conditions, shape (N, n) each.
        start_xyz: Tip positions at the start, world frame [m], shape (N, 3).
        goal_xyz: Tip positions at the goal, world frame [m], shape (N, 3).
        expected_time: What the network's rates are multiples of the inverse of [s], shape (N,).
        correction: What the bent line deviates from the straight one by [rad], shape (N, m, n); None if it is straight.
    """

    boundary: Boundary
    start_xyz: Array
    goal_xyz: Array
    expected_time: Array
    correction: Array | None = None

    def __repr__(self) -> str:
        return f"<Tasks of shape {np.shape(self.boundary.start_q)}>"

    def __len__(self) -> int:
        return len(self.expected_time)

    def take(self, rows: slice | NDArray[Any]) -> "Tasks":
        """Return some of the tasks."""
        return Tasks(
            self.boundary[rows],
            self.start_xyz[rows],
            self.goal_xyz[rows],
            self.expected_time[rows],
            None if self.correction is None else self.correction[rows],
        )

    def astype(self, dtype: str) -> "Tasks":
        """Return the same tasks in another float type."""
        parts = {name: None if part is None else np.asarray(part, dtype) for name, part in vars(self.boundary).items()}
        return Tasks(
            Boundary(**parts),  # type: ignore[arg-type]
            self.start_xyz.astype(dtype),
            self.goal_xyz.astype(dtype),
            self.expected_time.astype(dtype),
            None if self.correction is None else self.correction.astype(dtype),
        )


def expected_time(boundary: Boundary, velocity_limit: Array) -> Array:
    """Time that the slowest joint needs at its velocity limit, at least ``SHORTEST_TIME`` (paper, expected time) [s].

    Args:
        boundary: Boundary conditions.
        velocity_limit: Planning limits [rad/s], shape (n,).

    Returns:
        Shape (N,).
    """
    each: Array = np.abs(boundary.goal_q - boundary.start_q) / velocity_limit
    time: Array = each.max(axis=1, initial=SHORTEST_TIME)
    return time


def reaching_time(robot: "Robot", *, fixed_at_goal: int) -> Any:
    """Build ``ends -> time``: the least time in which every joint could go from its start to its goal state [s].

    Each joint for itself, with what is bounded of it: to its goal at full acceleration either way, at its velocity
    limit between the two where it would exceed that. No motion is shorter but for the floor, ``SHORTEST_REACH``.
    Ends are those of ``curves``; as a kernel, it takes an eighth of what NumPy takes for one task.
    """
    import casadi as ca

    ends = ca.SX.sym("ends", (3 + fixed_at_goal) * robot.n)
    q, dq, _, goal_q, goal_dq, *_ = ca.vertsplit(ends, robot.n)
    velocity, acceleration = ca.SX(robot.velocity_limit), ca.SX(robot.acceleration_limit)
    direct = (dq + goal_dq) * ca.fabs(goal_dq - dq) / (2 * acceleration)  # the way while it only changes speed
    side = ca.if_else(goal_q - q >= direct, 1.0, -1.0)
    first, last, way = side * dq, side * goal_dq, side * (goal_q - q)
    squares = (first**2 + last**2) / 2
    peak = ca.sqrt(ca.fmax(acceleration * way + squares, 0.0))
    fastest = ca.fmax(velocity, ca.fmax(first, last))
    cruise = ca.fmax(way - (fastest**2 - squares) / acceleration, 0.0) / fastest
    each = (2 * ca.fmin(peak, fastest) - first - last) / acceleration + ca.if_else(peak > fastest, cruise, 0.0)
    time = reduce(ca.fmax, ca.vertsplit(each), ca.SX(SHORTEST_REACH))
    return ca.Function("reaching_time", [ends], [time])
