"""Points and boxes: how near, how deep, and in which direction out; the corners of the held object."""

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.problems.obstacles import obstacle_poses_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import solids_of

Array = NDArray[np.float64]
Box = tuple[Array, Array]
"""Lower and upper corner [m], shape (3,) each; an obstacle reaches down without end."""

APART, DEEP = 0.14, 0.01  # m: of the object's centre from pedestals, and of a corner in one: what samplers keep


def boxes_of(problem: Problem, start_xyz: Array, goal_xyz: Array) -> tuple[Array, list[Box]]:
    """Return the edge lengths of the held object [m], shape (3,), and the obstacles.

    Args:
        problem: The problem.
        start_xyz: Where the tip begins [m], shape (3,).
        goal_xyz: Where it ends [m], shape (3,).

    Raises:
        UsageError: Nothing is held, or an obstacle is no upright box.
    """
    size = require_transport(problem)
    solids = solids_of(problem.obstacle, obstacle_poses_of(problem, start_xyz, goal_xyz))
    boxes = [(np.array([*solid.low[:2], -np.inf]), solid.high) for solid in solids]
    return size, boxes


def require_transport(problem: Problem) -> Array:
    """Return the edge lengths of the held object [m], shape (3,).

    Raises:
        UsageError: Nothing is held, or an obstacle is no upright box.
    """
    if problem.object_size is None:
        raise UsageError(f"it plans hits on a table and transports, and {problem.name!r} has neither table nor object")
    others = [each.name for each in problem.obstacle if not each.upright]
    if others:
        raise UsageError(f"it knows upright boxes only, and {problem.name!r} has {', '.join(others)}")
    return np.array(problem.object_size)


def distance(point: Array, box: Box) -> tuple[float, Array]:
    """Return how far a point is from a box [m], 0 inside, and the gradient of that, shape (3,)."""
    offset = point - np.clip(point, *box)
    length = float(np.linalg.norm(offset))
    return length, offset / length if length > 0 else np.zeros(3)


def depth(point: Array, box: Box) -> tuple[float, Array]:
    """Return how deep a point is in a box [m], 0 outside, and the gradient of that, shape (3,)."""
    rooms = np.concatenate([point - box[0], box[1] - point])
    least = int(np.argmin(rooms))
    normal = np.zeros(3)
    if rooms[least] <= 0:
        return 0.0, normal
    normal[least % 3] = 1.0 if least < 3 else -1.0
    return float(rooms[least]), normal
