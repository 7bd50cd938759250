"""Where the obstacles of a sample are: some stand below the object at the start or at the goal."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.problem import Problem
from cnpgen.problems.record import as_problem
from cnpgen.robots.solid import place_obstacles
from cnpgen.store.blueprint import StoredProblem

Array = NDArray[np.float64]


def obstacle_tops(problem: Problem | StoredProblem | str | Path, start_xyz: Array, goal_xyz: Array) -> Array:
    """Compute what says where the obstacles are [m]: of upright boxes the heights of their upper faces.

    An obstacle with ``below`` ends at the bottom of the object (at the tip, if there is none) at that end. Of obstacles
    with a pose it is their poses and sizes; see ``cnpgen.robots.solid``.

    Args:
        problem: The problem, its record, or the name or the file of a problem, a pipeline or a dataset.
        start_xyz: Tip positions at the start [m], shape (..., 3).
        goal_xyz: Tip positions at the goal [m], shape (..., 3).

    Returns:
        Shape (..., numbers): one of an upright box, more of others.

    Raises:
        UsageError: ``problem`` is none.
    """
    problem = as_problem(problem)
    if not problem.obstacle:
        return np.empty((*np.shape(start_xyz)[:-1], 0))
    half = 0.0 if problem.object is None else problem.object.size[2] / 2
    bottoms = {"start": np.asarray(start_xyz)[..., 2] - half, "goal": np.asarray(goal_xyz)[..., 2] - half}
    return place_obstacles(problem.obstacle, bottoms)
