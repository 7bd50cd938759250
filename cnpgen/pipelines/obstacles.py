"""Where the obstacles of a sample are: boxes that stand below the object at the start or at the goal."""

import numpy as np

from cnpgen.pipelines.stage import Array
from cnpgen.recipes import Problem


def obstacle_tops(problem: Problem, start_xyz: Array, goal_xyz: Array) -> Array:
    """Heights of the obstacles' upper faces.

    Args:
        problem: The problem.
        start_xyz: Tip positions at the start [m], shape (3, n).
        goal_xyz: Tip positions at the goal [m], shape (3, n).

    Returns:
        Shape (obstacles, n) [m].
    """
    half = problem.object.size[2] / 2 if problem.object is not None else 0.0
    below = {"start": start_xyz[2] - half, "goal": goal_xyz[2] - half}
    n = start_xyz.shape[1]
    rows = [np.full(n, box.top) if box.top is not None else below[box.below] for box in problem.obstacle]
    return np.array(rows).reshape(len(rows), n)
