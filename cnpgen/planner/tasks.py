"""What a planner is asked for: boundary conditions, and what follows from them before any network runs."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.boundary import Boundary

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


def reaching_time(boundary: Boundary, velocity_limit: Array, acceleration_limit: Array) -> Array:
    """Least time in which every joint could go from its start to its goal state, at least ``SHORTEST_REACH`` [s].

    Each joint for itself, with what is bounded of it: to its goal at full acceleration either way, at its velocity
    limit between the two where it would exceed that. No motion is shorter but for the floor.

    Args:
        boundary: Boundary conditions.
        velocity_limit: Planning limits [rad/s], shape (n,).
        acceleration_limit: Planning limits [rad/s^2], shape (n,).

    Returns:
        Shape (N,).
    """
    first, last, way = boundary.start_dq, boundary.goal_dq, boundary.goal_q - boundary.start_q
    direct = (first + last) * np.abs(last - first) / (2 * acceleration_limit)  # the way while it only changes speed
    side = np.where(way >= direct, 1.0, -1.0)
    first, last, way = side * first, side * last, side * way
    squares = (first**2 + last**2) / 2
    peak = np.sqrt(np.maximum(acceleration_limit * way + squares, 0.0))
    fastest = np.maximum(velocity_limit, np.maximum(first, last))
    turning = np.minimum(peak, fastest)
    cruise = np.maximum(way - (fastest**2 - squares) / acceleration_limit, 0.0) / fastest
    each: Array = (2 * turning - first - last) / acceleration_limit + np.where(peak > fastest, cruise, 0.0)
    time: Array = each.max(axis=1, initial=SHORTEST_REACH)
    return time
