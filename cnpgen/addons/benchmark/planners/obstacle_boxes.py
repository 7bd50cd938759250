"""Distances and penetration depths of points and boxes, with gradients."""

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.scene import Scene

Box = tuple[Array, Array]
"""Lower and upper corner [m], shape (3,) each; obstacles have no lower end."""

MIN_OBJECT_DISTANCE_M = 0.14  # of the object's centre, for samplers
MAX_CORNER_PENETRATION_M = 0.01  # of the object's corners, for samplers


def boxes_of(problem: Problem, scene: Scene) -> tuple[Array, list[Box]]:
    """Return the edge lengths of the held object [m], shape (3,), and the obstacles.

    See ``require_transport``.
    """
    size = require_transport(problem)
    boxes = [
        (np.array([*solid.low[:2], -np.inf]), solid.high) for solid in scene.bodies()
    ]
    return size, boxes


def require_table_or_transport(problem: Problem) -> None:
    """Raise UsageError if a problem has neither a table nor a held object among upright boxes."""
    if problem.first(Table) is None:
        require_transport(problem)


def require_transport(problem: Problem) -> Array:
    """Return the edge lengths of the held object [m], shape (3,).

    Raises:
        UsageError: There is no held object, or an obstacle is not an upright box.
    """
    if problem.object_size is None:
        raise UsageError(
            f"supported are hits on a table and transports, {problem.name!r} has neither table nor object"
        )
    others = [obstacle.name for obstacle in problem.obstacle if not obstacle.upright]
    if others:
        raise UsageError(
            f"supported are upright boxes only, {problem.name!r} has {', '.join(others)}"
        )
    return np.array(problem.object_size)


def distance(point: Array, box: Box) -> tuple[float, Array]:
    """Return the distance of a point from a box [m], 0 inside, and its gradient, shape (3,)."""
    offset = point - np.clip(point, *box)
    length = float(np.linalg.norm(offset))
    return length, offset / length if length > 0 else np.zeros(3)


def depth(point: Array, box: Box) -> tuple[float, Array]:
    """Return the penetration depth of a point in a box [m], 0 outside, and its gradient, shape (3,)."""
    depths = np.concatenate([point - box[0], box[1] - point])
    nearest_face = int(np.argmin(depths))
    normal = np.zeros(3)
    if depths[nearest_face] <= 0:
        return 0.0, normal
    normal[nearest_face % 3] = 1.0 if nearest_face < 3 else -1.0
    return float(depths[nearest_face]), normal
