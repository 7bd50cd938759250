"""What a planner is asked for: boundary conditions, and what follows from them before any network runs."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.boundary import Boundary

Array = NDArray[Any]

SHORTEST_TIME = 0.2  # s: floor of the expected time; what lies close together is not reached in no time at all


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
    time: Array = np.maximum(each.max(axis=1), SHORTEST_TIME)
    return time
