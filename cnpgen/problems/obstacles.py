"""The scenes of samples: some obstacles stand below the object at the start or at the goal."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import place_obstacles
from cnpgen.store.dataset_spec import StoredProblem

Array = NDArray[np.float64]


def obstacle_poses_of(problem: Problem | StoredProblem | str | Path, start_xyz: Array, goal_xyz: Array) -> Array:
    """Compute the poses and sizes of the obstacles; of upright boxes the heights of their upper faces [m].

    An obstacle with ``below`` ends at the bottom of the object (at the tip without an object) at that end.

    Args:
        problem: The problem, its record, or the name or file of a problem, a pipeline or a dataset.
        start_xyz: Tip positions at the start [m], shape (..., 3).
        goal_xyz: Tip positions at the goal [m], shape (..., 3).

    Returns:
        Shape (..., width), where width is ``cnpgen.robots.solid.pose_width`` of the obstacles.

    Raises:
        UsageError: ``problem`` is no problem.
    """
    problem = as_problem(problem)
    if not problem.obstacle:
        return np.empty((*np.shape(start_xyz)[:-1], 0))
    half = 0.0 if problem.object is None else problem.object.size[2] / 2
    bottoms = {"start": np.asarray(start_xyz)[..., 2] - half, "goal": np.asarray(goal_xyz)[..., 2] - half}
    return place_obstacles(problem.obstacle, bottoms)


def scene_of(problem: Problem | StoredProblem | str | Path, start_xyz: Array, goal_xyz: Array) -> Scene:
    """Place the obstacles of N samples; arguments of shape (N, 3) and errors as of ``obstacle_poses_of``."""
    problem = as_problem(problem)
    return Scene(tuple(problem.obstacle), obstacle_poses_of(problem, start_xyz, goal_xyz))
