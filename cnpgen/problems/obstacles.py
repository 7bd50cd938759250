"""Where the obstacles of a sample are: some stand below the object at the start or at the goal."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from cnpgen.problems.problem import Problem

Array = NDArray[np.float64]


def obstacle_tops(problem: "Problem", start_xyz: Array, goal_xyz: Array) -> Array:
    """Compute the heights of the obstacles' upper faces [m], shape (..., n_obstacles).

    An obstacle with ``below`` ends at the bottom of the object (at the tip, if there is none) at that end.

    Args:
        problem: The problem.
        start_xyz: Tip positions at the start [m], shape (..., 3).
        goal_xyz: Tip positions at the goal [m], shape (..., 3).
    """
    half = 0.0 if problem.object is None else problem.object.size[2] / 2
    bottoms = {"start": np.asarray(start_xyz)[..., 2] - half, "goal": np.asarray(goal_xyz)[..., 2] - half}
    tops = np.empty((*bottoms["start"].shape, len(problem.obstacle)))
    for index, box in enumerate(problem.obstacle):
        tops[..., index] = bottoms[box.below] if box.top is None else box.top
    return tops
