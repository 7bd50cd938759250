"""Convex bodies as arrays for ``convex.c``: convex parts of links and obstacles of a sample."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.hull import frame_along
from cnpgen.robots.shape.inline import corners_of
from cnpgen.robots.solid import number_slices, solids_of

Array = NDArray[np.float64]
Bodies = NDArray[np.void]

HULL, BOX, CYLINDER = 0, 1, 2  # kinds in convex.c
LANES = 8  # vertices and obstacles are padded to a multiple of the widest vector
BODY = np.dtype(
    [
        *((name, np.int64) for name in ("kind", "count", "first", "frame", "link")),
        *(("size", np.float64, 3), ("radius", np.float64), ("rotation", np.float64, 9), ("position", np.float64, 3)),
    ]
)
PADDING_DISTANCE_M = 1e6  # of the bounding boxes that pad the obstacles to full vectors


def hull_vertices(corners: Array) -> Array:
    """Return corners, shape (V, 3), by coordinates and padded with the first one, shape (3 * padded count,)."""
    padding = np.repeat(corners[:1], -len(corners) % LANES, axis=0)
    return np.concatenate([corners, padding]).T.ravel()


def obstacle_bodies(obstacles: Sequence[Obstacle], numbers: Array, first: int) -> tuple[Bodies, Array, Array]:
    """Return the obstacles of one sample as bodies.

    Cylinders are exact, with the radius of the corners of the prism that judges use: they contain that prism.

    Args:
        obstacles: Obstacles of the problem.
        numbers: Their poses and sizes, shape (width,), see ``cnpgen.robots.solid``.
        first: Index of the first vertex of the obstacles among all vertices.

    Returns:
        ``(bodies, vertices, boxes)``: bodies, shape (O,); vertices of meshes, flat; bounding boxes by rows (center,
        half sizes, rotation, radius), shape (16, O padded).
    """
    bodies, vertices = np.zeros(len(obstacles), BODY), list[Array]()
    boxes = np.zeros((16, len(obstacles) + -len(obstacles) % LANES))
    boxes[:3] = PADDING_DISTANCE_M
    for index, (obstacle, part) in enumerate(zip(obstacles, number_slices(obstacles), strict=True)):
        body = bodies[index]
        center, half = _fill(body, obstacle, numbers[part])
        if body["kind"] == HULL:
            corners = corners_of(obstacle.mesh)
            vertices.append(hull_vertices(corners))
            body["count"], body["first"], first = len(vertices[-1]) // 3, first, first + len(vertices[-1])
        boxes[:3, index], boxes[3:6, index] = center, half
        boxes[6:15, index], boxes[15, index] = body["rotation"], body["radius"]
    return bodies, np.concatenate([*vertices, np.empty(0)]), boxes


def _fill(body: Any, obstacle: Obstacle, numbers: Array) -> tuple[Array, Array]:
    """Fill in an obstacle's kind, sizes and pose; return center and half sizes of its bounding box without radius."""
    rotation, half = np.eye(3), np.zeros(3)
    if obstacle.upright:
        (solid,) = solids_of([obstacle], numbers)
        center, half = (solid.low + solid.high) / 2, (solid.high - solid.low) / 2
        body["kind"], body["size"] = BOX, half
    else:
        center, rest = numbers[:3], numbers[3:]
        if obstacle.kind == "box":
            half, rotation = rest[:3], rest[3:].reshape(3, 3) if obstacle.is_turned else rotation
            body["kind"], body["size"] = BOX, half
        elif obstacle.kind == "sphere":
            body["kind"], body["radius"] = BOX, rest[0]
        elif obstacle.kind == "mesh":
            body["kind"], rotation = HULL, rest.reshape(3, 3)
            corners = corners_of(obstacle.mesh)
            low, high = corners.min(axis=0), corners.max(axis=0)
            body["position"], body["rotation"] = center, rotation.ravel()
            return center + rotation @ (low + high) / 2, (high - low) / 2
        else:
            length = math.hypot(*rest[:3])
            rotation, flat = frame_along(rest[:3].tolist(), length), obstacle.kind == "cylinder"
            half = np.array([rest[3], rest[3], length]) if flat else np.array([0.0, 0.0, length])
            body["kind"], body["size"], body["radius"] = (CYLINDER, half, 0.0) if flat else (BOX, half, rest[3])
    body["position"], body["rotation"] = center, rotation.ravel()
    return center, half
