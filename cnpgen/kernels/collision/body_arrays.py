"""Convex bodies as arrays for ``convex.c``: convex parts of links and obstacles of a sample."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.robots.observation.primitives import KINDS, MESH, Primitives, primitives_of
from cnpgen.robots.obstacle import Obstacle

Bodies = NDArray[np.void]

HULL, BOX, CYLINDER = 0, 1, 2  # kinds in convex.c
LANES = 8  # vertices and obstacles are padded to a multiple of the widest vector
BLOCK = 16  # vertices, as in convex.c
# Fewer vertices are found as fast without blocks; convex.c has memory for 1024 blocks.
MIN_BLOCKED = 49
MAX_BLOCKED = 1024 * BLOCK
BODY = np.dtype(
    [
        *((name, np.int64) for name in ("kind", "count", "first", "frame", "link")),
        *(
            ("blocks", np.int64),
            ("size", np.float64, 3),
            ("radius", np.float64),
            ("rotation", np.float64, 9),
            ("position", np.float64, 3),
            ("bound", np.float64),
        ),
    ]
)
PADDING_DISTANCE_M = 1e6  # of the bounding boxes that pad the obstacles to full vectors
_BOX = KINDS.index("box")
_CYLINDER = KINDS.index("cylinder")


class HullVertices(NamedTuple):
    """Vertices of a hull for ``convex.c``.

    ``values`` are ``vertices`` coordinates x, then y, then z. With ``blocks``, center (3) and
    radius of their bounding spheres follow in the same way.
    """

    values: Array
    vertices: int
    blocks: int

    def put(self, bodies: Bodies, where: Any, first: int) -> None:
        """Enter the hull into the bodies at some indices; ``first`` is the index of its values among all."""
        bodies["kind"][where] = HULL
        bodies["first"][where] = first
        bodies["count"][where] = self.vertices
        bodies["blocks"][where] = self.blocks


def hull_vertices(corners: Array) -> HullVertices:
    """Return corners, shape (V, 3), padded with the first one to full vectors or blocks."""
    if not MIN_BLOCKED <= len(corners) <= MAX_BLOCKED:
        padded = _padded(corners, LANES)
        return HullVertices(padded.T.ravel(), len(padded), 0)
    padded = _padded(corners, BLOCK)
    blocks = padded[_block_order(padded)].reshape(-1, BLOCK, 3)
    centers = (blocks.min(axis=1) + blocks.max(axis=1)) / 2
    radii = np.linalg.norm(blocks - centers[:, None], axis=2).max(axis=1)
    radii = radii * (1 + 1e-12) + 1e-13  # above rounding errors
    spheres = np.column_stack([centers, radii])
    spheres = np.pad(spheres, [(0, -len(spheres) % LANES), (0, 0)])
    # No block: never searched.
    spheres[len(radii) :, 3] = -np.inf
    values = np.concatenate([blocks.reshape(-1, 3).T.ravel(), spheres.T.ravel()])
    return HullVertices(values, len(padded), len(spheres))


def _padded(rows: Array, multiple: int) -> Array:
    """Return rows with copies of the first one, which never change a maximum, up to a multiple."""
    return np.concatenate([rows, np.repeat(rows[:1], -len(rows) % multiple, axis=0)])


def _block_order(corners: Array) -> NDArray[np.int64]:
    """Return an order of corners in which those of each block are near each other.

    The corners are split at a multiple of ``BLOCK`` near the median of the coordinate in
    which they are widest, and so on until one block is left.
    """
    order = list[NDArray[np.int64]]()
    rest = [np.arange(len(corners))]
    while rest:
        part = rest.pop()
        if len(part) == BLOCK:
            order.append(part)
            continue
        widest = np.ptp(corners[part], axis=0).argmax()
        part = part[np.argsort(corners[part, widest], kind="stable")]
        half = (len(part) // BLOCK + 1) // 2 * BLOCK
        rest += [part[half:], part[:half]]
    return np.concatenate(order)


def bounding_boxes(bodies: Bodies, centers: Array, half: Array) -> Array:
    """Return the bounding boxes of bodies of N samples by rows, shape (N, 16, M padded); see ``obstacle_bodies``.

    Bodies have shape (N, M), centers and half sizes of their boxes without the radius
    [m] (N, M, 3).
    """
    count = bodies.shape[1]
    boxes = np.zeros((len(bodies), 16, count + -count % LANES))
    # Padding is so far away that its bounding box is never near a capsule.
    boxes[:, :3] = PADDING_DISTANCE_M
    rows = np.concatenate(
        [centers, half, bodies["rotation"], bodies["radius"][..., None]], axis=-1
    )
    boxes[..., :count] = rows.swapaxes(1, 2)
    return boxes


def primitive_bodies(obstacles: Primitives, first: int) -> tuple[Bodies, Array, Array]:
    """Return the obstacles of N samples as bodies, vertices of meshes and boxes, as ``obstacle_bodies`` of one."""
    kinds = obstacles.kinds
    sizes = obstacles.sizes
    hulls = [hull_vertices(mesh.core) for mesh in obstacles.meshes]
    ends = np.cumsum([first, *(len(hull.values) for hull in hulls)])
    box = kinds == _BOX
    cylinder = kinds == _CYLINDER
    mesh = kinds >= MESH
    # Spheres and capsules: a segment along z, of length 0 or 2 h, with a radius around
    # it.
    rounded = (kinds >= 0) & ~(box | cylinder | mesh)
    bodies = np.zeros(kinds.shape, BODY)
    bodies["kind"] = np.where(cylinder, CYLINDER, BOX)  # and hulls, below
    # Absent bodies are boxes of size 0 at the padding distance.
    centers = np.where((kinds >= 0)[..., None], obstacles.centers, PADDING_DISTANCE_M)
    bodies["position"] = centers
    bodies["rotation"] = obstacles.rotations.reshape(*kinds.shape, 9)
    for index, (hull, shape) in enumerate(zip(hulls, obstacles.meshes, strict=True)):
        here = kinds == MESH + index
        hull.put(bodies, here, int(ends[index]))
        bodies["radius"][here] = shape.radius
    bodies["size"][box] = sizes[box]
    bodies["size"][cylinder] = sizes[cylinder][:, [0, 0, 1]]
    bodies["size"][rounded, 2] = sizes[rounded, 1]
    bodies["radius"][rounded] = sizes[rounded, 0]
    # Of a mesh without its radius.
    inner = sizes - bodies["radius"][..., None]
    half = np.where(mesh[..., None], inner, bodies["size"])
    return (
        bodies,
        np.concatenate([*(hull.values for hull in hulls), np.empty(0)]),
        bounding_boxes(bodies, centers, half),
    )


def obstacle_bodies(
    obstacles: Sequence[Obstacle], numbers: Array, first: int
) -> tuple[Bodies, Array, Array]:
    """Return the obstacles of one sample as bodies.

    Args:
        obstacles: Obstacles of the problem.
        numbers: Their poses and sizes, shape (width,), see ``cnpgen.robots.solid``.
        first: Index of the first vertex of the obstacles among all vertices.

    Returns:
        ``(bodies, vertices, boxes)``: bodies, shape (O,); vertices of meshes, flat;
        bounding boxes by rows (center, half sizes, rotation, radius), shape (16, O
        padded).
    """
    found = primitives_of(obstacles, numbers[None], with_prisms=True)
    (bodies,), vertices, (boxes,) = primitive_bodies(found, first)
    return bodies, vertices, boxes
