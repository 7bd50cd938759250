"""Distances and penetration depths of points and boxes, with gradients."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.problems.obstacles import obstacle_poses_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import solids_of

Array = NDArray[np.float64]
Box = tuple[Array, Array]
"""Lower and upper corner [m], shape (3,) each; obstacles have no lower end."""

MIN_OBJECT_DISTANCE_M = 0.14  # of the object's centre, for samplers
MAX_CORNER_PENETRATION_M = 0.01  # of the object's corners, for samplers


def boxes_of(problem: Problem, start_xyz: Array, goal_xyz: Array) -> tuple[Array, list[Box]]:
    """Return the edge lengths of the held object [m], shape (3,), and the obstacles.

    Args:
        problem: The problem.
        start_xyz: Tip position at the start [m], shape (3,).
        goal_xyz: Tip position at the goal [m], shape (3,).

    Raises:
        UsageError: There is no held object, or an obstacle is not an upright box.
    """
    size = require_transport(problem)
    solids = solids_of(problem.obstacle, obstacle_poses_of(problem, start_xyz, goal_xyz))
    boxes = [(np.array([*solid.low[:2], -np.inf]), solid.high) for solid in solids]
    return size, boxes


def require_transport(problem: Problem) -> Array:
    """Return the edge lengths of the held object [m], shape (3,).

    Raises:
        UsageError: There is no held object, or an obstacle is not an upright box.
    """
    if problem.object_size is None:
        raise UsageError(f"supported are hits on a table and transports, {problem.name!r} has neither table nor object")
    others = [each.name for each in problem.obstacle if not each.upright]
    if others:
        raise UsageError(f"supported are upright boxes only, {problem.name!r} has {', '.join(others)}")
    return np.array(problem.object_size)


def distance(point: Array, box: Box) -> tuple[float, Array]:
    """Return the distance of a point from a box [m], 0 inside, and its gradient, shape (3,)."""
    offset = point - np.clip(point, *box)
    length = float(np.linalg.norm(offset))
    return length, offset / length if length > 0 else np.zeros(3)


def depth(point: Array, box: Box) -> tuple[float, Array]:
    """Return the penetration depth of a point in a box [m], 0 outside, and its gradient, shape (3,)."""
    depths = np.concatenate([point - box[0], box[1] - point])
    least = int(np.argmin(depths))
    normal = np.zeros(3)
    if depths[least] <= 0:
        return 0.0, normal
    normal[least % 3] = 1.0 if least < 3 else -1.0
    return float(depths[least]), normal
