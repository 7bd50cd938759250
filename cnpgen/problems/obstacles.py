"""Scenes of samples: some obstacles stand below the object at the start or at the goal."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.problem import Problem
from cnpgen.robots.scene import Scene
from cnpgen.robots.solid import place_obstacles

Array = NDArray[np.float64]


def scene_of(problem: Problem, start_xyz: Array, goal_xyz: Array) -> Scene:
    """Place the obstacles of N samples.

    An obstacle with ``below`` ends at the bottom of the object (at the tip without an object) at that end.

    Args:
        problem: The problem.
        start_xyz: Tip positions at the start [m], shape (N, 3).
        goal_xyz: Tip positions at the goal [m], shape (N, 3).
    """
    half = 0.0 if problem.object is None else problem.object.size[2] / 2
    bottoms = {"start": np.asarray(start_xyz)[..., 2] - half, "goal": np.asarray(goal_xyz)[..., 2] - half}
    return Scene(tuple(problem.obstacle), place_obstacles(problem.obstacle, bottoms))
