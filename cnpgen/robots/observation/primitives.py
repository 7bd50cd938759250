"""Obstacles as arrays of boxes, spheres, cylinders, capsules and convex meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cnpgen.arrays import AnyArray, Array, Integers
from cnpgen.errors import UsageError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.cylinder_shape import CylinderShape
from cnpgen.robots.obstacle_shapes.obstacle_shape import (
    ObstacleShape,
    SizedShape,
    shape_class,
)
from cnpgen.robots.scene import PARKED_POSITION_M, Scene, rotations_of
from cnpgen.robots.shape.inline import is_inline
from cnpgen.robots.solid import number_slices, place_obstacles, pose_width
from cnpgen.store.scene_table import OBSTACLE_KINDS, SceneTable

PLANE_DECIMALS = 9  # to which the planes of triangles of one face agree
MIN_AREA_M2 = 1e-12  # of a triangle; smaller ones have no normal in single precision
MAX_KEPT_MESHES = 256
KINDS = OBSTACLE_KINDS  # index: the code of a kind
MESH = len(KINDS)  # the code of the first mesh, followed by those of the others
NO_BODY = -1  # kind of the padding


@dataclass(frozen=True, eq=False)
class ConvexMesh:
    """The convex hull of corners, relative to the center of its bounding box.

    Attributes:
        center: Center of the bounding box in the frame of the mesh [m], shape (3,).
        half: Half the edge lengths of the bounding box [m], shape (3,).
        corners: The corners [m], shape (V, 3).
        triangles: Triangles of the surface: a corner and the edges to the two others
            [m], shape (T, 3, 3).
        planes: Outer unit normals n and offsets c of the faces, shape (F, 4): ``n @ x +
            c <= 0`` inside.
        core: Corners of the hull with ``radius`` around it, for which the mesh stands
            [m], shape (C, 3).
        radius: Radius [m].
    """

    center: Array
    half: Array
    corners: Array
    triangles: Array
    planes: Array
    core: Array
    radius: float


@lru_cache(MAX_KEPT_MESHES)
def convex_mesh(shape: ObstacleShape) -> ConvexMesh:
    """Return the mesh of the surface of a shape; round edges have corners in ``BALL_DIRECTIONS``."""
    from scipy.spatial import ConvexHull

    core, radius = shape.polytope()
    corners = shape.surface()
    center = (corners.max(axis=0) + corners.min(axis=0)) / 2
    half = np.ptp(corners, axis=0) / 2
    # Relative to the center of the bounding box: sizes and centers are then consistent.
    hull = ConvexHull(corners - center)
    first, second, third = (hull.points[index] for index in hull.simplices.T)
    planes = hull.equations[
        np.sort(
            np.unique(hull.equations.round(PLANE_DECIMALS), axis=0, return_index=True)[
                1
            ]
        )
    ]
    # A corner and two edges, the form that distances and areas need.
    triangles = np.stack([first, second - first, third - first], axis=1)
    areas = np.linalg.norm(np.cross(triangles[:, 1], triangles[:, 2]), axis=1) / 2
    triangles = triangles[areas > MIN_AREA_M2]
    return ConvexMesh(
        center, half, hull.points, triangles, planes, core - center, radius
    )


@dataclass(frozen=True, eq=False)
class Primitives:
    """M bodies of simple shapes in the world frame; or those of N scenes, with a first axis of length N.

    Attributes:
        kinds: Index of each shape in ``KINDS``, shape (M,); ``MESH`` plus the index of
            its mesh for others; -1 where a scene has fewer bodies.
        centers: Centers [m], shape (M, 3).
        rotations: Rotation matrices; columns are the axes of a body, shape (M, 3, 3).
        sizes: Sizes [m], shape (M, 3): half the edge lengths of a box, or of the
            bounding box of a mesh; otherwise the radius, half the length along z (of a
            capsule without its round ends; 0 for a sphere), and 0.
        meshes: The meshes of all bodies.
    """

    kinds: Integers
    centers: Array
    rotations: Array
    sizes: Array
    meshes: tuple[ConvexMesh, ...] = ()

    def __len__(self) -> int:
        return len(self.kinds)

    def __getitem__(self, which: int | slice | AnyArray) -> Primitives:
        return Primitives(
            self.kinds[which],
            self.centers[which],
            self.rotations[which],
            self.sizes[which],
            self.meshes,
        )

    def mesh(self, index: int) -> ConvexMesh | None:
        """Return the mesh of a body; None for other shapes."""
        return (
            self.meshes[self.kinds[index] - MESH] if self.kinds[index] >= MESH else None
        )


def primitives_of(
    obstacles: Sequence[Obstacle], numbers: Array, *, with_prisms: bool = False
) -> Primitives:
    """Return obstacles as primitives.

    Poses and sizes (``cnpgen.robots.solid``) have shape (pose_width,), or of N samples
    (N, pose_width), which gives arrays with a first axis of length N. ``with_prisms``
    returns cylinders that contain the prisms of judges.
    """
    samples = numbers.shape[:-1]
    rows = np.atleast_2d(numbers)
    kinds, centers, rotations, sizes = _padding(len(rows), len(obstacles))
    meshes: list[ConvexMesh] = []
    for index, (obstacle, part) in enumerate(
        zip(obstacles, number_slices(obstacles), strict=True)
    ):
        of_body = centers[:, index], rotations[:, index], sizes[:, index]
        shape = obstacle.form
        if isinstance(shape, SizedShape):
            kinds[:, index] = KINDS.index(obstacle.kind)
            shape.place(rows[:, part], *of_body)
        else:
            kinds[:, index] = MESH + len(meshes)
            meshes.append(_fill_mesh(obstacle, rows[:, part], *of_body))
    if not with_prisms:
        cylinders = kinds == KINDS.index("cylinder")
        sizes[cylinders, 0] *= CylinderShape.radius_share
    arrays = (
        array.reshape(*samples, *array.shape[1:])
        for array in (kinds, centers, rotations, sizes)
    )
    return Primitives(*arrays, meshes=tuple(meshes))  # type: ignore[misc,arg-type]


def _fill_mesh(
    obstacle: Obstacle, numbers: Array, center: Array, rotation: Array, size: Array
) -> ConvexMesh:
    """Fill in the arrays of a mesh as ``SizedShape.place`` does, and return the mesh."""
    if obstacle.mesh and not is_inline(obstacle.mesh):
        raise UsageError(
            f"obstacle {obstacle.name!r} is a mesh file, expected its corners: see make_mesh"
        )
    mesh = convex_mesh(obstacle.form)
    rotation[:] = numbers[:, 3:].reshape(-1, 3, 3)
    center[:] = numbers[:, :3] + rotation @ mesh.center
    size[:] = mesh.half
    return mesh


def scene_primitives(scenes: Scene | Sequence[Sequence[Obstacle]]) -> Primitives:
    """Return the bodies of N scenes, arrays with a first axis of length N.

    Without obstacles parked below the robot.
    """
    if isinstance(scenes, Scene):
        bodies = primitives_of(
            scenes.obstacles, scenes.poses[:, : pose_width(scenes.obstacles)]
        )
        bodies.kinds[bodies.centers[:, :, 2] <= PARKED_POSITION_M[2] / 2] = (
            # Meshes have another center.
            NO_BODY
        )
        return bodies
    # Problems of one scene share its obstacles.
    known: dict[int, Primitives] = {}
    for obstacles in scenes:
        if id(obstacles) not in known:
            known[id(obstacles)] = primitives_of(obstacles, place_obstacles(obstacles))
    return padded([known[id(obstacles)] for obstacles in scenes])


def table_primitives(table: SceneTable) -> Primitives:
    """Return the bodies of the scenes of a table, arrays with a first axis of length S."""
    kinds = table.obstacle_kind
    # Of a box half the edge lengths; otherwise the radius and half the length.
    is_box = kinds[..., None] == KINDS.index("box")
    sizes = table.obstacle_size * np.where(is_box, 0.5, [1.0, 0.5, 0.0])
    centers = table.obstacle_position.astype(float)
    return Primitives(kinds, centers, rotations_of(table), sizes)


def padded(scenes: Sequence[Primitives]) -> Primitives:
    """Return the bodies of N scenes as arrays with a first axis of length N, padded with bodies of kind -1."""
    kinds, centers, rotations, sizes = _padding(
        len(scenes), max(map(len, scenes), default=0)
    )
    meshes: dict[ConvexMesh, int] = {}  # mesh -> index
    for index, scene in enumerate(scenes):
        count = len(scene)
        codes = [MESH + meshes.setdefault(mesh, len(meshes)) for mesh in scene.meshes]
        # Codes of meshes are renumbered, since scenes have different lists of meshes.
        kinds[index, :count] = np.array([*range(MESH), *codes, NO_BODY])[scene.kinds]
        centers[index, :count] = scene.centers
        rotations[index, :count] = scene.rotations
        sizes[index, :count] = scene.sizes
    return Primitives(kinds, centers, rotations, sizes, tuple(meshes))


def _sized(kind: str) -> type[SizedShape]:
    found = shape_class(kind)
    assert issubclass(found, SizedShape)
    return found


def _padding(*shape: int) -> tuple[Integers, Array, Array, Array]:
    """Return kinds, centers, rotations and sizes of rows of no bodies."""
    centers, sizes = np.zeros((2, *shape, 3))
    return (
        np.full(shape, NO_BODY, np.int64),
        centers,
        np.tile(np.eye(3), (*shape, 1, 1)),
        sizes,
    )


def depths_of_origin(bodies: Primitives) -> Array:
    """Return the depth of the origin of the world in each body [m], not above 0 outside; -inf without a body.

    The shape is that of ``kinds``.
    """
    # R^T (0 - c): the origin in the frame of each body; by symmetry of all but meshes
    # its absolute value decides.
    origin = -np.einsum("...ji,...j->...i", bodies.rotations, bodies.centers)
    local = np.abs(origin)
    # Of meshes the nearest plane of a face counts.
    depths = [
        *(_sized(kind).depths(local, bodies.sizes) for kind in KINDS),
        *(
            -(origin @ mesh.planes[:, :3].T + mesh.planes[:, 3]).max(axis=-1)
            for mesh in bodies.meshes
        ),
    ]
    codes = [bodies.kinds == code for code in range(len(depths))]
    return np.asarray(np.select(codes, depths, -np.inf))
