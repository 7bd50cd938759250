"""MoveIt planning scenes and motion plan requests in YAML, as MotionBenchMaker writes them.

Positions are (x, y, z) in m and orientations quaternions (x, y, z, w), as lists or
mappings. Dimensions follow ``shape_msgs/SolidPrimitive``. Poses are in the planning
frame, which is that of the robot's base, or in the frame of a link, an object or a
fixed transform. Every element is read, refused by name, or one of ``moveit_unused``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import part, scalar
from cnpgen.addons.scene_files.moveit_collisions import (
    OCTOMAP,
    is_true,
    read_allowed_collisions,
    read_link_sizes,
)
from cnpgen.addons.scene_files.moveit_frames import (
    FrameTable,
    add_base,
    add_fixed_frames,
)
from cnpgen.addons.scene_files.moveit_goals import (
    read_goal_pose,
    read_joint_goals,
    read_start,
)
from cnpgen.addons.scene_files.moveit_meshes import (
    warn_of_unneeded_packages,
    with_mesh_files,
)
from cnpgen.addons.scene_files.moveit_objects import (
    add_object_frames,
    placed_attached,
    read_attached,
    read_world,
    with_touch_links,
)
from cnpgen.addons.scene_files.moveit_path import read_path_constraints
from cnpgen.addons.scene_files.moveit_shapes import built
from cnpgen.addons.scene_files.moveit_unused import UNUSED_ELEMENTS
from cnpgen.addons.scene_files.octomap import read_octomap
from cnpgen.documents import JsonMapping, NamedNumbers, Names
from cnpgen.errors import listed, nearest
from cnpgen.problems.scenes.scene_problem import (
    MAX_SCENE_OBSTACLES,
    SceneError,
    SceneProblem,
)
from cnpgen.problems.scenes.scene_reader import ReadingOptions
from cnpgen.problems.scenes.scene_request import SceneRequest
from cnpgen.robots.obstacle import Obstacle
from cnpgen.store.files.accounted import (
    MISSPELT,
    Account,
    AccountedMapping,
    accounted,
    is_default,
    mark_read,
    misspelt,
)

_KEYS = {"collision_objects", "goal_constraints", "start_state", "world"}


def is_moveit(document: Any) -> bool:
    """Return whether a document is a planning scene or a motion plan request."""
    return isinstance(document, dict) and bool(_KEYS & document.keys())


def read_moveit(
    documents: dict[Path, Any], options: ReadingOptions
) -> Iterator[tuple[SceneProblem, Account]]:
    """Yield the problems of planning scenes and requests, file -> document, with their accounts.

    A request belongs to the scene in its own document, or to the scene in the same
    folder whose name differs by "request" and "scene" only: ``request0001.yaml`` and
    ``scene0001.yaml``. A scene without a request is an error.
    """
    warn_of_unneeded_packages(documents, options.packages)
    for path, document in documents.items():
        is_scene = "collision_objects" in document or "world" in document
        if "goal_constraints" not in document:
            if is_scene and _partner(path, "scene", "request") in documents:
                continue
            what = "scene" if is_scene else "start_state"
            raise SceneError(
                f"{path}: the {what} has no request with goal_constraints in this file or beside it"
                f"{_hint(document, 'goal_constraints')}"
            )
        scene_path = path if is_scene else _partner(path, "request", "scene")
        if scene_path not in documents:
            raise SceneError(
                f"{path}: there is no scene {scene_path.name} beside the request"
                f"{_hint(document, 'world', 'collision_objects')}"
            )
        yield _read_pair(scene_path, path, documents, options)


def _hint(document: JsonMapping, *missing: str) -> str:
    """Return the keys of a document that are probably a missing one, misspelt."""
    hints = (nearest(key, missing, similarity=MISSPELT) for key in document)
    found = [f"{key}{hint}" for key, hint in zip(document, hints, strict=True) if hint]
    return f"; unknown: {listed(found)}" if found else ""


def _read_pair(
    scene_path: Path, path: Path, documents: dict[Path, Any], options: ReadingOptions
) -> tuple[SceneProblem, Account]:
    """Return the problem of a scene and a request, which may be one document, with its account."""
    parts = []
    for file in dict.fromkeys((scene_path, path)):
        account = Account(
            f"{file}",
            UNUSED_ELEMENTS,
            allow_unused=options.allow_unused,
            error=SceneError,
        )
        content = with_mesh_files(documents[file], file, options.packages)
        parts.append(accounted(content, account))
    scene = parts[0]
    own = parts[-1]
    try:
        problem = _problem(scene_path, scene, path, own, options.present)
    except SceneError as error:
        if not (unknown := misspelt(*parts)):
            raise
        text = f"{error.args[0]}; {unknown}"
        raise SceneError(text, remedies=error.remedies) from error
    for each in parts:
        each.account.finish(each)
    account = scene.account
    if own is not scene:
        account.unused += own.account.unused
        account.accepted += own.account.accepted
    request = replace(problem.request, accepted=tuple(account.accepted))
    return replace(problem, request=request), account


def _partner(path: Path, old: str, new: str) -> Path:
    """Return the path with the last occurrence of a word in its name replaced."""
    head, found, tail = path.name.rpartition(old)
    return (
        path.with_name(head + new + tail) if found else path.with_name(new + path.name)
    )


def _problem(
    scene_path: Path,
    scene: AccountedMapping,
    path: Path,
    request: AccountedMapping,
    present: NamedNumbers,
) -> SceneProblem:
    name = re.sub(r"^(scene|request)[_-]?", "", path.stem) or path.stem
    place = f"{scene_path}: scene {name!r}"
    where = str(path)
    if is_true(scene.get("is_diff"), f"{place}: is_diff"):
        scene.refuse(
            "is_diff", "the file must have the whole scene, not changes of one"
        )
    state, own = _states(scene, request, where)
    joints, start, velocity = read_start(state, where, present)
    table = FrameTable(place)
    add_fixed_frames(table, scene, place)
    add_base(table, state, where)
    obstacles, demands = _world(scene, own, table, place, where)
    problem = _with_goals(request, where, joints, start, table)
    velocity_scale, acceleration_scale = _scales(request, where)
    constraints = list(read_path_constraints(request, table, where))
    return replace(
        problem,
        name=name,
        obstacles=obstacles,
        source=str(scene_path),
        request=replace(
            problem.request,
            **demands,
            start_dq=velocity,
            velocity_scale=velocity_scale,
            acceleration_scale=acceleration_scale,
            fixed_frames=tuple(table.used.items()),
            constraints=tuple(each for _, each in constraints),
            constraint_frames=tuple(frame for frame, _ in constraints),
        ),
    )


def _world(
    scene: AccountedMapping,
    states: list[Any],
    table: FrameTable,
    place: str,
    where: str,
) -> tuple[tuple[Obstacle, ...], dict[str, Any]]:
    """Return the obstacles of a scene, and what a request states about them and the objects that states attach."""
    objects = read_world(scene, place)
    add_object_frames(table, objects)
    carried = [each for one in states for each in read_attached(one, objects, where)]
    add_object_frames(table, {item.name: item for item, _ in carried})
    names = [each.name for _, each in carried]
    allowed = read_allowed_collisions(scene, objects, names, place)
    obstacles = [
        each
        for each in _obstacles(scene, objects, table, place)
        if each[0] not in allowed.ignored
    ]
    touching = tuple(allowed.touching.get(body, ()) for body, *_ in obstacles)
    attached = tuple(
        placed_attached(item, with_touch_links(each, allowed.touching), table, place)
        for item, each in carried
    )
    return tuple(obstacle for *_, obstacle in obstacles), {
        "robot_name": part(scene, "robot_model_name", str, place),
        "obstacle_frames": tuple(frame for _, frame, _ in obstacles),
        "obstacle_touch_links": touching if any(touching) else (),
        "attached": attached,
        "link_sizes": read_link_sizes(scene, place),
    }


def _states(
    scene: AccountedMapping, request: AccountedMapping, where: str
) -> tuple[Any, list[Any]]:
    """Return the state with the joint positions, and the states that attach objects.

    As in MoveIt, ``start_state`` of a request replaces ``robot_state`` of the scene,
    unless it is a difference (``is_diff``) or empty.
    """
    start = part(request, "start_state", dict, where)
    present = part(scene, "robot_state", dict, where)
    is_difference = is_true(start.get("is_diff"), f"{where}: start_state.is_diff")
    if not part(part(start, "joint_state", dict, where), "name", list, where):
        return present, [present, start]
    kept = part(present, "attached_collision_objects", list, where)
    if kept and not is_difference:
        present.refuse(
            "attached_collision_objects",
            "start_state replaces robot_state and detaches them: set start_state.is_diff to true, or attach them there",
        )
    base = part(present, "multi_dof_joint_state", dict, where)
    if part(base, "transforms", list, where):
        present.refuse(
            "multi_dof_joint_state",
            "start_state replaces robot_state: give the placement there",
        )
    return start, [present, start] if is_difference else [start]


def _scales(request: AccountedMapping, where: str) -> tuple[float, float]:
    """Return the scaling factors of velocities and accelerations; 0 and a missing factor mean 1."""
    scales = []
    for kind in ("velocity", "acceleration"):
        key = f"max_{kind}_scaling_factor"
        value = request.get(key)
        scale = 1.0 if value is None else scalar(value, f"{where}: {key}") or 1.0
        if not 0 < scale <= 1:
            raise SceneError(
                f"{where}: {key} must be above 0 and at most 1, or 0 for 1, got {scale:g}"
            )
        scales.append(scale)
    request.refuse(
        "max_cartesian_speed",
        "the speed of a link is not limited: give max_velocity_scaling_factor",
    )
    return scales[0], scales[1]


def _with_goals(
    request: AccountedMapping,
    where: str,
    joints: Names,
    start: Any,
    table: FrameTable,
) -> SceneProblem:
    """Return a problem with the start, the joints and the goals of a request.

    Its ``goal_constraints`` are alternatives.
    """
    _refuse_trajectory_constraints(request, where)
    with_joints, others = _alternatives(request, where)
    joint_goals = read_joint_goals(with_joints, joints, start, where)
    read = (read_goal_pose(entry, table, where) for entry in others)
    poses = [each for each in read if each is not None]
    if not with_joints and not poses:
        raise SceneError(
            f"{where}: goal_constraints have neither joint_constraints nor position_constraints"
        )
    # joint goals come first; without any, the first pose does
    frame, pose = ("", None) if with_joints else poses[0]
    more = poses if with_joints else poses[1:]
    tolerant = np.concatenate([joint_goals.below, joint_goals.above]).any()
    demands = SceneRequest(
        goal_below=joint_goals.below if tolerant else None,
        goal_above=joint_goals.above if tolerant else None,
        goal_frame=frame,
        other_goal_frames=tuple(frame for frame, _ in more),
    )
    return SceneProblem(
        name="",
        obstacles=(),
        start_q=start,
        goal_q=joint_goals.states,
        goal_pose=pose,
        joint_names=joints,
        request=demands,
        other_goal_poses=tuple(pose for _, pose in more),
    )


def _alternatives(
    request: AccountedMapping, where: str
) -> tuple[list[AccountedMapping], list[AccountedMapping]]:
    """Return the goals with constraints of joints, and the others; one goal cannot have both."""
    goals = part(request, "goal_constraints", list, where)
    if not all(isinstance(entry, dict) for entry in goals):
        raise SceneError(f"{where}: goal_constraints must be mappings")
    with_joints = list[AccountedMapping]()
    others = list[AccountedMapping]()
    for entry in goals:
        entry.refuse("visibility_constraints", "visibility is not supported")
        if not part(entry, "joint_constraints", list, where):
            others.append(entry)
            continue
        with_joints.append(entry)
        for key in ("position_constraints", "orientation_constraints"):
            entry.refuse(key, "a goal has constraints of joints or of a pose, not both")
    return with_joints, others


def _refuse_trajectory_constraints(request: AccountedMapping, where: str) -> None:
    """Refuse constraints of waypoints; a name without constraints is none."""
    key = "trajectory_constraints"
    entry = part(request, key, dict, where)
    if not all(is_default(value) for kind, value in entry.items() if kind != "name"):
        text = "constraints of waypoints are not supported: give path_constraints"
        request.account.refuse(key, entry, text)
    mark_read(entry)


def _obstacles(
    scene: AccountedMapping,
    objects: dict[str, Any],
    table: FrameTable,
    place: str,
) -> Iterator[tuple[str, str, Obstacle]]:
    """Yield the names in the allowed collisions, the frames and the obstacles of the world."""
    count = 0
    for item in objects.values():
        frame, pose = table.resolve(item.frame, item.pose)
        for obstacle in built(item.name, item.shapes, pose, place):
            count += 1
            yield item.name, frame, obstacle
    world = part(scene, "world", dict, place)
    for frame, box in read_octomap(world, table, MAX_SCENE_OBSTACLES - count, place):
        yield OCTOMAP, frame, box
