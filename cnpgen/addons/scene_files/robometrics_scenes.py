"""Scenes in YAML as robometrics stores the problems of MotionBenchMaker and MPiNets.

A mapping from families to lists of problems with ``start``, ``goal_ik`` (several goal
states), ``goal_pose`` (``position_xyz``, ``quaternion_wxyz``, ``frame``) and
``obstacles``: cuboids with ``dims``, cylinders with ``radius`` and ``height``, each
with a ``pose`` (x, y, z, qw, qx, qy, qz) relative to the robot's base.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import part, scalar, vector
from cnpgen.problems.scenes.quaternions import quaternion_error, rotation_matrix
from cnpgen.problems.scenes.scene_problem import (
    GoalPose,
    SceneError,
    SceneProblem,
    check_count,
    make_obstacle,
)
from cnpgen.problems.scenes.scene_request import BASE_FRAMES, SceneRequest
from cnpgen.robots.obstacle import Obstacle
from cnpgen.store.files.accounted import Account, UnusedElements, accounted

UNUSED_ELEMENTS = UnusedElements(
    harmless={"collision_buffer_ik": "distance at which the goal states were drawn"}
)
_KINDS = ("cuboid", "cylinder", "sphere")
_SIGNS = {"obstacles", "goal_ik", "goal_pose"}  # keys, one of which every problem has


def is_robometrics(document: Any) -> bool:
    """Return whether a document maps families to lists of problems with obstacles."""
    if not isinstance(document, dict) or not document:
        return False
    first = next(iter(document.values()))
    return (
        isinstance(first, list)
        and bool(first)
        and isinstance(first[0], dict)
        and not _SIGNS.isdisjoint(first[0])
    )


def read_robometrics(
    path: Path, document: Any, *, allow_unused: Sequence[str] = ()
) -> Iterator[tuple[SceneProblem, Account]]:
    """Yield the problems of a document with their accounts."""
    for family in document:
        for index, entry in enumerate(part(document, family, list, str(path))):
            name = f"{family} {index}"
            place = f"{path}: scene {name!r}"
            if not isinstance(entry, dict):
                raise SceneError(f"{place} must be a mapping, got {entry!r:.60}")
            account = Account(
                place, UNUSED_ELEMENTS, allow_unused=allow_unused, error=SceneError
            )
            counted = accounted(entry, account)
            problem = _problem(path, name, counted, place)
            account.finish(counted)
            if entry.get("obstacles") is None:
                raise SceneError(
                    f"{place} has no obstacles, expected a mapping, which may be empty"
                )
            request = replace(problem.request, accepted=tuple(account.accepted))
            yield replace(problem, request=request), account


def _problem(path: Path, name: str, entry: Any, place: str) -> SceneProblem:
    start = vector(part(entry, "start", list, place), "", f"{place}: start")
    goals = [
        vector(goal, "", f"{place}: goal_ik")
        for goal in part(entry, "goal_ik", list, place)
    ]
    if any(goal.shape != start.shape for goal in goals):
        raise SceneError(
            f"{place}: every goal_ik must have {len(start)} joint positions like start"
        )
    pose = _goal_pose(part(entry, "goal_pose", dict, place), place)
    if not goals and pose is None:
        raise SceneError(f"{place} has neither goal_ik nor goal_pose")
    if goals and pose is not None:
        # Plans end at a goal state.
        entry.account.unused.append("goal_pose")
    frame = part(entry, "world_frame", str, place)
    frame = "" if frame in BASE_FRAMES else frame
    obstacles = tuple(_obstacles(part(entry, "obstacles", dict, place), place))
    return SceneProblem(
        name=name,
        obstacles=obstacles,
        start_q=start,
        goal_q=np.array(goals).reshape(len(goals), len(start)),
        goal_pose=pose,
        source=str(path),
        request=SceneRequest(
            goal_frame=frame, obstacle_frames=(frame,) * len(obstacles)
        ),
    )


def _goal_pose(entry: Any, place: str) -> GoalPose | None:
    if not entry:
        return None
    quaternion = vector(entry.get("quaternion_wxyz"), "wxyz", f"{place}: goal_pose")
    if text := quaternion_error(quaternion):
        raise SceneError(f"{place}: goal_pose: {text}")
    position = vector(entry.get("position_xyz"), "xyz", f"{place}: goal_pose")
    frame = part(entry, "frame", str, place)
    if not frame:
        raise SceneError(
            f"{place}: goal_pose has no frame, expected a link of the robot"
        )
    return GoalPose(frame, position, rotation_matrix(quaternion))


def _obstacles(obstacles: Any, place: str) -> Iterator[Obstacle]:
    for kind in obstacles:
        if kind not in _KINDS:
            raise SceneError(
                f"{place} has obstacles of the kind {kind!r}, expected {', '.join(_KINDS)}"
            )
    check_count(
        sum(len(part(obstacles, kind, dict, place)) for kind in obstacles), place
    )
    for kind in _KINDS:
        for name, entry in part(obstacles, kind, dict, place).items():
            where = f"{place}: obstacle {name!r}"
            pose = vector(part(entry, "pose", list, where), "", f"{where}: pose")
            if kind == "cuboid":
                sizes = vector(part(entry, "dims", list, where), "", f"{where}: dims")
            else:
                keys = ("radius", "height")[: 2 if kind == "cylinder" else 1]
                sizes = np.array(
                    [scalar(entry.get(key), f"{where}: {key}") for key in keys]
                )
            if kind == "sphere" and len(pose) == 3:
                pose = np.array([*pose, 1.0, 0.0, 0.0, 0.0])
            shape = "box" if kind == "cuboid" else kind
            yield make_obstacle(name, shape, sizes, pose[:3], pose[3:], place=place)
