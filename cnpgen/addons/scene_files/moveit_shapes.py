"""Shapes of MoveIt's collision objects: primitives and meshes with their poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import part, vector
from cnpgen.addons.scene_files.link_constraints import REGIONS
from cnpgen.addons.scene_files.moveit_frames import Pose, composed, pose_of
from cnpgen.arrays import Array
from cnpgen.problems.scenes.quaternions import quaternion_of
from cnpgen.problems.scenes.scene_problem import SceneError, make_mesh, make_obstacle
from cnpgen.robots.obstacle import Obstacle

# Codes of shape_msgs/SolidPrimitive.
PRIMITIVES = {
    "1": "box",
    "2": "sphere",
    "3": "cylinder",
    "4": "cone",
    "5": "prism",
}
REMEDIES = {
    "cone": "give a mesh of it",
    "prism": "give a mesh of it",
    "planes": "expected primitives or meshes; give a plane as a large flat box",
}


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """Shape of an object.

    Attributes:
        kind: Kind of the shape.
        sizes: Sizes [m] of a primitive, or the points of a mesh, shape (V, 3).
        pose: Pose in the frame of the object.
    """

    kind: str
    sizes: Array
    pose: Pose

    def build(self, name: str, outer: Pose, place: str) -> Obstacle:
        """Return the obstacle of an object with a pose."""
        position, rotation = composed(outer, self.pose)
        if self.kind == "mesh":
            return make_mesh(name, self.sizes, position, rotation, place=place)
        return make_obstacle(
            name,
            self.kind,
            self.sizes,
            position,
            quaternion_of(rotation),
            place=place,
        )


def read_shapes(entry: Any, where: str) -> list[ObjectShape]:
    """Return the shapes of a collision object."""
    for key in ("planes", "plane_poses"):
        if part(entry, key, list, where):
            raise SceneError(f"{where} has planes, {REMEDIES['planes']}")
    primitives = _with_poses(entry, "primitive", where)
    meshes = _with_poses(entry, "mesh", where)
    return [
        *(_primitive(each, pose_of(pose, where), where) for each, pose in primitives),
        *(
            ObjectShape("mesh", _vertices(mesh, where), pose_of(pose, where))
            for mesh, pose in meshes
        ),
    ]


def shape_poses(entry: Any, where: str) -> list[Pose]:
    """Return the poses of a message that moves the shapes of an object."""
    return [
        pose_of(pose, where)
        for key in ("primitive_poses", "mesh_poses")
        for pose in part(entry, key, list, where)
    ]


def primitive_kind(primitive: Any) -> str:
    """Return the kind of a primitive, from its name or its code."""
    kind = str(primitive.get("type") if isinstance(primitive, dict) else primitive)
    return PRIMITIVES.get(kind.lower(), kind.lower())


def primitive_sizes(primitive: Any, where: str) -> Array:
    """Return the sizes of a primitive [m]: edge lengths, a radius, or radius and length."""
    primitive.refuse("polygon", "only prisms have it, which are not supported")
    sizes = vector(
        part(primitive, "dimensions", list, where), "", f"{where}: dimensions"
    )
    is_cylinder = primitive_kind(primitive) == "cylinder"
    # MoveIt: height and radius
    return sizes[::-1] if is_cylinder else sizes


def read_regions(constraint: Any, noun: str, where: str) -> list[ObjectShape]:
    """Return the primitives of a constraint's region with their poses."""
    region = part(constraint, "constraint_region", dict, where)
    if part(region, "meshes", list, where) or part(region, "mesh_poses", list, where):
        raise SceneError(
            f"{where}: {noun} must be of primitives, got meshes: give boxes"
        )
    primitives = part(region, "primitives", list, where)
    poses = part(region, "primitive_poses", list, where)
    if len(primitives) != len(poses):
        raise SceneError(
            f"{where}: {noun} must have one pose for each of its primitives, got"
            f" {len(primitives)} primitives and {len(poses)} poses"
        )
    shapes = []
    for primitive, pose in zip(primitives, poses, strict=True):
        kind = primitive_kind(primitive)
        if kind not in REGIONS:
            raise SceneError(
                f"{where}: {noun} must be one of {', '.join(REGIONS)}, got {kind!r:.60}"
            )
        sizes = primitive_sizes(primitive, where)
        shapes.append(ObjectShape(kind, sizes, pose_of(pose, where)))
    return shapes


def _primitive(primitive: Any, pose: Pose, where: str) -> ObjectShape:
    if not isinstance(primitive, dict):
        raise SceneError(
            f"{where}: a primitive must be a mapping, got {primitive!r:.60}"
        )
    kind = primitive_kind(primitive)
    if kind in REMEDIES:
        raise SceneError(f"{where} is a {kind}: {REMEDIES[kind]}")
    return ObjectShape(kind, primitive_sizes(primitive, where), pose)


def _with_poses(entry: Any, what: str, where: str) -> list[tuple[Any, Any]]:
    """Return the primitives or meshes of an object with their poses."""
    plural = "meshes" if what == "mesh" else f"{what}s"
    shapes = part(entry, plural, list, where)
    poses = part(entry, f"{what}_poses", list, where)
    if len(shapes) != len(poses):
        raise SceneError(
            f"{where} has {len(shapes)} {plural} and {len(poses)} poses, expected equal numbers"
        )
    return list(zip(shapes, poses, strict=True))


def _vertices(mesh: Any, where: str) -> Array:
    """Return the vertices of a mesh [m], shape (V, 3)."""
    vertices = part(mesh, "vertices", list, where)
    points = [vector(each, "xyz", f"{where}: vertex") for each in vertices]
    _check_triangles(mesh, len(points), where)
    return np.array(points).reshape(-1, 3)


def _check_triangles(mesh: Any, vertices: int, where: str) -> None:
    """Check that the triangles of a mesh, whose hull counts, refer to its vertices."""
    # Triangles are checked although only the hull of the vertices is used.
    for triangle in part(mesh, "triangles", list, where):
        for index in vector(
            part(triangle, "vertex_indices", list, where),
            "",
            f"{where}: vertex_indices",
        ):
            if index not in range(vertices):
                raise SceneError(
                    f"{where}: a triangle has the vertex {index:g}, expected 0 to {vertices - 1}"
                )


def built(
    name: str, shapes: Sequence[ObjectShape], outer: Pose, place: str
) -> Iterator[Obstacle]:
    """Yield the obstacles of an object with a pose."""
    for shape in shapes:
        yield shape.build(name, outer, place)
