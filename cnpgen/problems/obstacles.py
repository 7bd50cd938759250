"""Where the obstacles of a sample are: some stand below the object at the start or at the goal."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.problem import Problem
from cnpgen.problems.record import ProblemRecord, as_problem

Array = NDArray[np.float64]


def obstacle_tops(problem: Problem | ProblemRecord | str | Path, start_xyz: Array, goal_xyz: Array) -> Array:
    """Compute the heights of the obstacles' upper faces [m], shape (..., n_obstacles).

    An obstacle with ``below`` ends at the bottom of the object (at the tip, if there is none) at that end.

    Args:
        problem: The problem, its record, or the name or the file of a problem, a pipeline or a dataset.
        start_xyz: Tip positions at the start [m], shape (..., 3).
        goal_xyz: Tip positions at the goal [m], shape (..., 3).

    Raises:
        UsageError: ``problem`` is none.
    """
    problem = as_problem(problem)
    half = 0.0 if problem.object is None else problem.object.size[2] / 2
    bottoms = {"start": np.asarray(start_xyz)[..., 2] - half, "goal": np.asarray(goal_xyz)[..., 2] - half}
    tops = np.empty((*bottoms["start"].shape, len(problem.obstacle)))
    for index, box in enumerate(problem.obstacle):
        tops[..., index] = bottoms[box.below] if box.top is None else box.top
    return tops
