"""MoveIt planning scenes and motion plan requests in YAML, as MotionBenchMaker writes them.

Poses are relative to the planning frame, which is taken as the frame of the robot's
base. Positions are (x, y, z) in m and orientations quaternions (x, y, z, w), as lists
or mappings. Dimensions follow ``shape_msgs/SolidPrimitive``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.problems.scenes.quaternions import (
    quaternion_error,
    quaternion_of,
    rotation_matrix,
)
from cnpgen.problems.scenes.scene_problem import (
    GoalPose,
    SceneError,
    SceneProblem,
    check_count,
    make_mesh,
    make_obstacle,
)
from cnpgen.problems.scenes.yaml_document import part, scalar, vector
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.hull import Array, outward_triangles
from cnpgen.robots.shape.inline import corners_of

Pose = tuple[Array, Array]  # position [m] and rotation matrix

_PRIMITIVES = {
    "1": "box",
    "2": "sphere",
    "3": "cylinder",
}  # codes of shape_msgs/SolidPrimitive
_KEYS = {"collision_objects", "goal_constraints", "start_state", "world"}


def is_moveit(document: Any) -> bool:
    """Return whether a document is a planning scene or a motion plan request."""
    return isinstance(document, dict) and bool(_KEYS & document.keys())


def read_moveit(documents: dict[Path, Any]) -> Iterator[SceneProblem]:
    """Yield the problems of planning scenes and requests, file -> document.

    A request belongs to the scene in its own document, or to the scene in the same
    folder whose name differs by "request" and "scene" only: ``request0001.yaml`` and
    ``scene0001.yaml``. A scene without a request is an error.
    """
    for path, document in documents.items():
        is_scene = "collision_objects" in document or "world" in document
        if "goal_constraints" not in document:
            if is_scene and _partner(path, "scene", "request") not in documents:
                raise SceneError(
                    f"{path}: the scene has no request with goal_constraints in this file or beside it"
                )
            continue
        scene_path = path if is_scene else _partner(path, "request", "scene")
        if scene_path not in documents:
            raise SceneError(
                f"{path}: there is no scene {scene_path.name} beside the request"
            )
        yield _problem(scene_path, documents[scene_path], path, document)


def _partner(path: Path, old: str, new: str) -> Path:
    """Return the path with the last occurrence of a word in its name replaced."""
    head, found, tail = path.name.rpartition(old)
    return (
        path.with_name(head + new + tail) if found else path.with_name(new + path.name)
    )


def _problem(scene_path: Path, scene: Any, path: Path, request: Any) -> SceneProblem:
    name = re.sub(r"^(scene|request)[_-]?", "", path.stem) or path.stem
    place = f"{scene_path}: scene {name!r}"
    joints, start = _start(request, str(path))
    goals = part(request, "goal_constraints", list, str(path))
    if not all(isinstance(entry, dict) for entry in goals):
        raise SceneError(f"{path}: goal_constraints must be mappings")
    goal_q = [
        _joint_goal(entry, joints, start, str(path))
        for entry in goals
        if entry.get("joint_constraints")
    ]
    pose = next(filter(None, (_pose_goal(entry, str(path)) for entry in goals)), None)
    if not goal_q and pose is None:
        raise SceneError(
            f"{path}: goal_constraints have neither joint_constraints nor position_constraints"
        )
    return SceneProblem(
        name=name,
        obstacles=tuple(_obstacles(scene, place)),
        start_q=start,
        goal_q=np.array(goal_q).reshape(len(goal_q), len(joints)),
        goal_pose=pose,
        joint_names=joints,
        source=str(scene_path),
    )


def _start(request: Any, where: str) -> tuple[tuple[str, ...], Array]:
    """Return names and positions of the joints at the start."""
    state = part(part(request, "start_state", dict, where), "joint_state", dict, where)
    names = part(state, "name", list, where)
    positions = vector(
        part(state, "position", list, where), "", f"{where}: start_state position"
    )
    if not names or len(names) != len(positions):
        raise SceneError(
            f"{where}: start_state needs one position for each name, got {len(positions)} for {len(names)}"
        )
    return tuple(map(str, names)), positions


def _joint_goal(goal: Any, joints: tuple[str, ...], start: Array, where: str) -> Array:
    """Return the joint positions of a goal.

    Joints without a constraint keep their start position.
    """
    positions = start.copy()
    for constraint in part(goal, "joint_constraints", list, where):
        name = (
            str(constraint.get("joint_name"))
            if isinstance(constraint, dict)
            else repr(constraint)
        )
        if name not in joints:
            raise SceneError(
                f"{where}: the goal constrains the joint {name!r}, which start_state lacks"
            )
        positions[joints.index(name)] = scalar(
            constraint.get("position"), f"{where}: goal of joint {name!r}"
        )
    return positions


def _pose_goal(goal: Any, where: str) -> GoalPose | None:
    """Return the pose of a goal with constraints of position and orientation."""
    positions = part(goal, "position_constraints", list, where)
    orientations = part(goal, "orientation_constraints", list, where)
    if not positions or not orientations:
        return None
    region = part(positions[0], "constraint_region", dict, where)
    primitives, poses = (
        part(region, "primitives", list, where),
        part(region, "primitive_poses", list, where),
    )
    if len(primitives) != 1 or len(poses) != 1:
        raise SceneError(
            f"{where}: a position constraint must have one primitive with a pose, got {len(primitives)}"
        )
    frame = part(positions[0], "link_name", str, where)
    offset = positions[0].get("target_point_offset")
    if offset is not None and np.abs(vector(offset, "xyz", where)).max() > 0:
        raise SceneError(
            f"{where}: target_point_offset must be zero, got {offset!r:.60}"
        )
    dimensions = vector(
        part(primitives[0], "dimensions", list, where),
        "",
        f"{where}: dimensions of the goal region",
    )
    if not dimensions.size or not (np.isfinite(dimensions) & (dimensions > 0)).all():
        raise SceneError(
            f"{where}: dimensions of the goal region must be positive, got {dimensions.tolist()!r:.60}"
        )
    is_sphere = _kind(primitives[0]) == "sphere"
    part(orientations[0], "link_name", str, where)  # which must be a mapping
    angles = [
        orientations[0].get(f"absolute_{axis}_axis_tolerance", 0.01) for axis in "xyz"
    ]
    radius = float(dimensions[0] if is_sphere else dimensions.min() / 2)
    return GoalPose(
        frame=frame,
        position=_pose(poses[0], where)[0],
        rotation=_rotation(orientations[0].get("orientation"), where),
        position_tolerance=radius
        / np.sqrt(3),  # a cube in the region, for any orientation
        rotation_tolerance=np.array(
            [scalar(angle, f"{where}: orientation tolerance") for angle in angles]
        ),
    )


def _obstacles(scene: Any, place: str) -> Iterator[Obstacle]:
    world = part(scene, "world", dict, place)
    objects = part(
        world if "collision_objects" in world else scene,
        "collision_objects",
        list,
        place,
    )
    check_count(len(objects), place)
    frames = {
        part(part(entry, "header", dict, place), "frame_id", str, place)
        for entry in objects
    }
    if len(frames) > 1:
        raise SceneError(
            f"{place} has objects in several frames, {', '.join(sorted(frames))}: expected one, the base"
        )
    _check_transforms(scene, frames, place)
    count = 0
    for entry in objects:
        name = str(entry.get("id", "object"))
        where = f"{place}: obstacle {name!r}"
        if part(entry, "planes", list, where):
            raise SceneError(f"{where} has planes, expected primitives or meshes")
        primitives, meshes = (
            _with_poses(entry, "primitive", where),
            _with_poses(entry, "mesh", where),
        )
        if not primitives and not meshes:
            raise SceneError(f"{where} has neither primitives nor meshes")
        check_count(count := count + len(primitives) + len(meshes), place)
        outer = (
            _pose(entry["pose"], where)
            if entry.get("pose") is not None
            else (np.zeros(3), np.eye(3))
        )
        for primitive, pose in primitives:
            yield _obstacle(name, primitive, outer, _pose(pose, where), place)
        for mesh, pose in meshes:
            vertices = part(mesh, "vertices", list, where)
            points = np.array(
                [vector(each, "xyz", f"{where}: vertex") for each in vertices]
            ).reshape(-1, 3)
            inner = _pose(pose, where)
            obstacle = make_mesh(
                name,
                points,
                outer[0] + outer[1] @ inner[0],
                outer[1] @ inner[1],
                place=place,
            )
            _check_triangles(mesh, len(points), where)
            yield obstacle


def _check_triangles(mesh: Any, vertices: int, where: str) -> None:
    """Check that the triangles of a mesh, whose hull counts, refer to its vertices."""
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


def _with_poses(entry: Any, what: str, where: str) -> list[tuple[Any, Any]]:
    """Return the primitives or meshes of an object with their poses."""
    plural = "meshes" if what == "mesh" else f"{what}s"
    shapes, poses = (
        part(entry, plural, list, where),
        part(entry, f"{what}_poses", list, where),
    )
    if len(shapes) != len(poses):
        raise SceneError(
            f"{where} has {len(shapes)} {plural} and {len(poses)} poses, expected equal numbers"
        )
    return list(zip(shapes, poses, strict=True))


def _check_transforms(scene: Any, frames: set[str], place: str) -> None:
    """Refuse frames of objects that differ from the planning frame."""
    for entry in part(scene, "fixed_frame_transforms", list, place):
        transform = part(entry, "transform", dict, place)
        if str(entry.get("child_frame_id")) not in frames or not transform:
            continue
        shift = vector(transform.get("translation"), "xyz", f"{place}: translation")
        turn = _rotation(transform.get("rotation"), f"{place}: rotation")
        if np.abs(shift).max() > 0 or np.abs(turn - np.eye(3)).max() > 1e-12:
            raise SceneError(
                f"{place}: its frame {entry.get('child_frame_id')!r} is not the planning frame"
            )


def _obstacle(
    name: str, primitive: Any, outer: Pose, inner: Pose, place: str
) -> Obstacle:
    where = f"{place}: obstacle {name!r}"
    kind = _kind(primitive)
    sizes = vector(
        part(primitive, "dimensions", list, where), "", f"{where}: dimensions"
    )
    if kind == "cylinder":
        sizes = sizes[::-1]  # MoveIt: height and radius
    position = outer[0] + outer[1] @ inner[0]
    return make_obstacle(
        name, kind, sizes, position, quaternion_of(outer[1] @ inner[1]), place=place
    )


def _kind(primitive: Any) -> str:
    kind = str(
        primitive.get("type") if isinstance(primitive, dict) else primitive
    ).lower()
    return _PRIMITIVES.get(kind, kind)


def _pose(pose: Any, where: str) -> Pose:
    """Return position and rotation of a pose."""
    if not isinstance(pose, dict):
        raise SceneError(f"{where}: a pose must be a mapping, got {pose!r:.60}")
    return vector(pose.get("position"), "xyz", f"{where}: position"), _rotation(
        pose.get("orientation"), where
    )


def _rotation(xyzw: Any, where: str) -> Array:
    quaternion = vector(xyzw, "xyzw", f"{where}: orientation")
    if text := quaternion_error(quaternion):
        raise SceneError(f"{where}: {text}")
    return rotation_matrix(quaternion[[3, 0, 1, 2]])


def moveit_texts(scene: SceneProblem, joints: Sequence[str]) -> tuple[str, str]:
    """Return a scene and its request, with these names of joints, as YAML.

    SceneError without a primitive or a goal.
    """
    lines = [
        f"name: {_text(scene.name)}",
        "world:",
        "  collision_objects:" + ("" if scene.obstacles else " []"),
    ]
    for obstacle in scene.obstacles:
        if (
            obstacle.kind not in ("mesh", *_PRIMITIVES.values())
            or obstacle.position is None
        ):
            raise SceneError(
                f"{scene.place}: obstacle {obstacle.name!r} is a {obstacle.kind}, MoveIt has no such shape"
            )
        lines += [f"    - id: {_text(obstacle.name)}", *_shape(obstacle)]
        w, x, y, z = quaternion_of(turned(*obstacle.rotation)).tolist()
        lines += [
            f"        - position: {list(obstacle.position)}",
            f"          orientation: {[x, y, z, w]}",
        ]
    return "\n".join(lines) + "\n", _request(scene, joints)


def _shape(obstacle: Obstacle) -> list[str]:
    """Return the lines of the shape of an obstacle, up to its pose."""
    if obstacle.kind == "mesh":
        corners = corners_of(obstacle.mesh)
        faces = [
            f"            - vertex_indices: {triangle}"
            for triangle in outward_triangles(corners).tolist()
        ]
        vertices = [
            f"            - {dict(zip('xyz', corner, strict=True))}"
            for corner in corners.tolist()
        ]
        return [
            "      meshes:",
            "        - triangles:",
            *faces,
            "          vertices:",
            *vertices,
            "      mesh_poses:",
        ]
    dimensions = {
        "box": list(obstacle.size or ()),
        "sphere": [obstacle.radius],
        "cylinder": [obstacle.length, obstacle.radius],
    }[obstacle.kind]
    lines = [
        "      primitives:",
        f"        - type: {obstacle.kind}",
        f"          dimensions: {dimensions}",
    ]
    return [*lines, "      primitive_poses:"]


def _request(scene: SceneProblem, joints: Sequence[str]) -> str:
    if not len(scene.goal_q):
        raise SceneError(
            f"{scene.place} has no goal state, and goal poses are not written"
        )
    names, lines = [_text(name) for name in joints], ["start_state:", "  joint_state:"]
    lines += [
        f"    name: [{', '.join(names)}]",
        f"    position: {scene.start_q.tolist()}",
        "goal_constraints:",
    ]
    for goal in scene.goal_q:
        lines.append("  - joint_constraints:")
        for name, position in zip(names, goal.tolist(), strict=True):
            lines += [
                f"      - joint_name: {name}",
                f"        position: {position!r}",
                "        weight: 1.0",
            ]
    return "\n".join(lines) + "\n"


def _text(name: str) -> str:
    """Quote a text for YAML."""
    return "'" + name.replace("'", "''") + "'"
