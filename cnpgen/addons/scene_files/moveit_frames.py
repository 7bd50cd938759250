"""Poses and frames of MoveIt's messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import part, vector
from cnpgen.arrays import Array
from cnpgen.problems.scenes.quaternions import quaternion_error, rotation_matrix
from cnpgen.problems.scenes.scene_problem import SceneError
from cnpgen.problems.scenes.scene_request import BASE_FRAMES
from cnpgen.robots.shape.hull import MAX_COORDINATE_M
from cnpgen.store.files.accounted import is_default, mark_read

Pose = tuple[Array, Array]  # position [m] and rotation matrix
BASE = "base of the robot"  # where the planning frame is elsewhere
IDENTITY: Pose = (np.zeros(3), np.eye(3))
MAX_BASE_TILT = (
    1e-9  # of the base against the vertical; gravity would have another direction
)


class FrameTable:
    """Frames that a document places: fixed transforms, objects with their subframes, and the base of the robot.

    Attributes:
        used: Frames of the table that were resolved, and whether each is the base.
    """

    def __init__(self, place: str) -> None:
        self._place = place
        self._frames: dict[str, tuple[str, Pose]] = {}
        self.used: dict[str, bool] = {}

    def add(self, name: str, parent: str, pose: Pose) -> None:
        """Add a frame by its pose in a parent frame."""
        self._frames[name] = (parent, pose)

    def resolve(self, frame: str, pose: Pose) -> tuple[str, Pose]:
        """Return a pose in the last frame that the table does not place: empty for the base, or that of a link."""
        visited = set[str]()
        while frame in self._frames:
            # A circle of frames would never end.
            if frame in visited:
                raise SceneError(
                    f"{self._place}: the frames {', '.join(sorted(visited))} are placed in a circle"
                )
            visited.add(frame)
            parent, outer = self._frames[frame]
            self.used[frame] = parent in BASE_FRAMES and outer is IDENTITY
            pose = composed(outer, pose) if outer is not IDENTITY else pose
            frame = parent
        return ("" if frame in {*BASE_FRAMES, BASE} else frame), pose


def composed(outer: Pose, inner: Pose) -> Pose:
    """Return the pose of an inner frame in the parent of an outer one."""
    return outer[0] + outer[1] @ inner[0], outer[1] @ inner[1]


def frame_id(entry: Any, where: str) -> str:
    """Return the frame of a header, without the slash of tf before it; empty for the planning frame."""
    header = part(entry, "header", dict, where)
    return str(part(header, "frame_id", str, where)).removeprefix("/")


def pose_of(pose: Any, where: str) -> Pose:
    """Return position and rotation of a pose."""
    if not isinstance(pose, dict):
        raise SceneError(f"{where}: a pose must be a mapping, got {pose!r:.60}")
    position = _coordinates(pose, "position", where)
    return position, rotation_of(pose.get("orientation"), where)


def _coordinates(entry: Any, key: str, where: str) -> Array:
    """Return x, y and z of an entry [m]."""
    found = vector(entry.get(key), "xyz", f"{where}: {key}")
    # Also false for nan.
    if not (np.abs(found) <= MAX_COORDINATE_M).all():
        raise SceneError(
            f"{where}: {key} must be finite and at most {MAX_COORDINATE_M:g}, got {found.tolist()}"
        )
    return found


def optional_pose(entry: Any, key: str, where: str) -> Pose:
    """Return a pose; the identity if it is missing or empty."""
    pose = entry.get(key)
    if is_default(pose):
        mark_read(pose)
        return IDENTITY
    return pose_of(pose, where)


def transform_of(transform: Any, where: str) -> Pose:
    """Return translation and rotation of a transform; the identity if it is missing or empty."""
    if is_default(transform):
        mark_read(transform)
        return IDENTITY
    shift = _coordinates(transform, "translation", where)
    turn = rotation_of(transform.get("rotation"), f"{where}: rotation")
    # Transforms that change nothing become the object IDENTITY, by which they are
    # recognized.
    same = not shift.any() and np.abs(turn - np.eye(3)).max() <= MAX_BASE_TILT
    return IDENTITY if same else (shift, turn)


def rotation_of(xyzw: Any, where: str) -> Array:
    """Return the rotation matrix of a quaternion (x, y, z, w)."""
    quaternion = vector(xyzw, "xyzw", f"{where}: orientation")
    if text := quaternion_error(quaternion):
        raise SceneError(f"{where}: {text}")
    # Messages state (x, y, z, w), the function takes (w, x, y, z).
    return rotation_matrix(quaternion[[3, 0, 1, 2]])


def add_fixed_frames(table: FrameTable, scene: Any, place: str) -> None:
    """Add the ``fixed_frame_transforms`` of a scene."""
    names = set[str]()
    for entry in part(scene, "fixed_frame_transforms", list, place):
        where = f"{place}: fixed_frame_transforms"
        name = part(entry, "child_frame_id", str, where)
        if name in names:
            raise SceneError(f"{where} has the frame {name!r} twice")
        names.add(name)
        pose = transform_of(part(entry, "transform", dict, where), where)
        parent = frame_id(entry, where)
        if name and name != parent and not (name in BASE_FRAMES and pose is IDENTITY):
            table.add(name, parent, pose)


def add_base(table: FrameTable, state: Any, where: str) -> None:
    """Place the planning frame relative to the robot's base by a state's ``multi_dof_joint_state``.

    The one virtual joint of a robot with a fixed base has the pose of the base in the
    planning frame.
    """
    joints = part(state, "multi_dof_joint_state", dict, where)
    frame = frame_id(joints, where)
    names = part(joints, "joint_names", list, where)
    transforms = part(joints, "transforms", list, where)
    where = f"{where}: multi_dof_joint_state"
    if len(names) != len(transforms):
        raise SceneError(
            f"{where} has {len(names)} joint_names and {len(transforms)} transforms, expected equal numbers"
        )
    poses = [transform_of(each, where) for each in transforms]
    moved = [pose for pose in poses if pose is not IDENTITY]
    if len(moved) > 1:
        raise SceneError(
            f"{where} moves {len(moved)} joints, expected one, of the base"
        )
    if frame not in BASE_FRAMES:
        table.add(frame, "", IDENTITY)
    if not moved:
        return
    shift, turn = moved[0]
    # The cosine of the angle between both z axes.
    if abs(turn[2, 2] - 1) > MAX_BASE_TILT:
        raise SceneError(f"{where} tilts the base: gravity is along z of the base")
    # Poses in the planning frame need the inverse of the base's pose: (-R^T t, R^T).
    for name in BASE_FRAMES:
        table.add(name, BASE, (-turn.T @ shift, turn.T))
