"""Start states and goals of MoveIt's motion plan requests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import part, scalar, vector
from cnpgen.addons.scene_files.euler_tolerance import rotation_vector_tolerance
from cnpgen.addons.scene_files.link_constraints import EULER, ROTATION_VECTOR
from cnpgen.addons.scene_files.moveit_frames import (
    FrameTable,
    frame_id,
    rotation_of,
)
from cnpgen.addons.scene_files.moveit_shapes import read_regions
from cnpgen.arrays import Array
from cnpgen.documents import NamedNumbers, Names
from cnpgen.problems.scenes.scene_problem import GoalPose, SceneError

_PARAMETRIZATIONS = {"0": EULER, "XYZ_EULER_ANGLES": EULER}
_PARAMETRIZATIONS |= {"1": ROTATION_VECTOR, "ROTATION_VECTOR": ROTATION_VECTOR}


@dataclass(frozen=True, eq=False)
class JointGoals:
    """Goal states [rad] and their tolerances below and above them, shape (G, n) each."""

    states: Array
    below: Array
    above: Array


def read_start(
    state: Any, where: str, present: NamedNumbers
) -> tuple[Names, Array, Array | None]:
    """Return names, positions [rad] and velocities [rad/s] of the joints at the start.

    A state without joints is the present one, which the caller may know.
    """
    joints = part(state, "joint_state", dict, where)
    names = tuple(map(str, part(joints, "name", list, where)))
    positions = vector(
        part(joints, "position", list, where), "", f"{where}: start_state position"
    )
    # An empty state stands for the present one in MoveIt's messages.
    if present and not names and not len(positions):
        return tuple(present), np.array([*present.values()], float), None
    if not names or len(names) != len(positions):
        raise SceneError(
            f"{where}: start_state needs one position for each name, got {len(positions)} for {len(names)};"
            " without any it is the robot's present state: give it by --start, or by present in Python"
        )
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SceneError(f"{where}: start_state has the joint {twice[0]!r} twice")
    velocities = vector(
        part(joints, "velocity", list, where), "", f"{where}: start_state velocity"
    )
    if not len(velocities):
        return names, positions, None
    if len(velocities) != len(names) or not np.isfinite(velocities).all():
        raise SceneError(
            f"{where}: start_state needs one finite velocity for each name or none, got {velocities.tolist()}"
        )
    return names, positions, velocities if velocities.any() else None


def read_joint_goals(
    goals: list[Any], joints: Names, start: Array, where: str
) -> JointGoals:
    """Return the goal states of all alternatives with constraints of joints.

    Joints without a constraint keep their start position.
    """
    found = [_joint_goal(goal, joints, start, where) for goal in goals]
    states, below, above = (
        np.array(found).reshape(len(found), 3, len(joints)).swapaxes(0, 1)
    )
    return JointGoals(states, below, above)


def _joint_goal(goal: Any, joints: Names, start: Array, where: str) -> Array:
    """Return joint positions of a goal and their tolerances below and above, shape (3, n)."""
    values = np.array([start, np.zeros_like(start), np.zeros_like(start)])
    constrained = set[str]()
    for constraint in part(goal, "joint_constraints", list, where):
        is_mapping = isinstance(constraint, dict)
        name = str(constraint.get("joint_name")) if is_mapping else repr(constraint)
        if name not in joints:
            raise SceneError(
                f"{where}: the goal constrains the joint {name!r}, which start_state lacks"
            )
        if name in constrained:
            raise SceneError(f"{where}: a goal constrains the joint {name!r} twice")
        constrained.add(name)
        place = f"{where}: goal of joint {name!r}"
        check_weight(constraint, place)
        values[0, joints.index(name)] = scalar(constraint.get("position"), place)
        for row, key in enumerate(("tolerance_below", "tolerance_above"), 1):
            tolerance = scalar(constraint.get(key) or 0, f"{place}: {key}")
            if not 0 <= tolerance < np.inf:
                raise SceneError(
                    f"{place}: {key} must be finite and not negative, got {tolerance:g}"
                )
            values[row, joints.index(name)] = tolerance
    return values


def check_weight(constraint: Any, where: str) -> None:
    """Raise SceneError for a weight that is no finite number from 0 on; its value has no effect."""
    weight = constraint.get("weight")
    if weight is not None and not 0 <= scalar(weight, f"{where}: weight") < np.inf:
        raise SceneError(
            f"{where}: weight must be finite and not negative, got {weight!r:.60}"
        )


def read_goal_pose(
    goal: Any, table: FrameTable, where: str
) -> tuple[str, GoalPose] | None:
    """Return the pose of a goal and its frame, from one constraint of position and at most one of orientation."""
    positions = part(goal, "position_constraints", list, where)
    orientations = part(goal, "orientation_constraints", list, where)
    if not positions and not orientations:
        return None
    if len(positions) != 1 or len(orientations) > 1:
        raise SceneError(
            f"{where}: a goal pose needs one position constraint and at most one orientation constraint, got"
            f" {len(positions)} and {len(orientations)}"
        )
    position, link = positions[0], part(positions[0], "link_name", str, where)
    check_weight(position, where)
    center, radius = _region(position, where)
    # Without a constraint, the orientation is free: a tolerance of pi about each axis.
    frame, turn, tolerance = frame_id(position, where), np.eye(3), np.full(3, np.pi)
    if orientations:
        if part(orientations[0], "link_name", str, where) != link:
            raise SceneError(
                f"{where}: position and orientation of a goal must be of one link"
            )
        if frame_id(orientations[0], where) != frame:
            raise SceneError(
                f"{where}: position and orientation of a goal must be in one frame"
            )
        turn, tolerance = _goal_orientation(orientations[0], where)
    # The goal is expressed in the last frame that the document does not place.
    frame, placed = table.resolve(frame, (center, turn))
    return frame, GoalPose(
        frame=link,
        position=placed[0],
        rotation=placed[1],
        position_tolerance=radius
        # A cube in the region, for any orientation.
        / np.sqrt(3),
        rotation_tolerance=tolerance,
    )


def _region(constraint: Any, where: str) -> tuple[Array, float]:
    """Return the center of a region [m] and the radius of a ball in it."""
    constraint.refuse(
        "target_point_offset",
        "the origin of the link must be the target: move the region instead",
    )
    shapes = read_regions(constraint, "a goal region", where)
    if len(shapes) != 1:
        raise SceneError(
            f"{where}: a position constraint must have one primitive with a pose, got {len(shapes)}"
        )
    sizes = shapes[0].sizes
    if not sizes.size or not (np.isfinite(sizes) & (sizes > 0)).all():
        raise SceneError(
            f"{where}: dimensions of the goal region must be positive, got {sizes.tolist()!r:.60}"
        )
    # the ball in a box has half of its minimum edge, that in a cylinder also at most its radius
    radius = sizes[0] if shapes[0].kind == "sphere" else sizes.min() / 2
    return shapes[0].pose[0], float(radius)


def orientation_of(constraint: Any, where: str) -> tuple[Array, Array, str]:
    """Return rotation matrix, tolerances up to pi [rad] and parametrization of an orientation constraint."""
    check_weight(constraint, where)
    tolerance = np.array(
        [
            scalar(
                constraint.get(f"absolute_{axis}_axis_tolerance") or 0,
                f"{where}: orientation tolerance",
            )
            for axis in "xyz"
        ]
    )
    if not (np.isfinite(tolerance) & (tolerance >= 0)).all():
        raise SceneError(
            f"{where}: orientation tolerances must be finite and not negative, got {tolerance.tolist()}"
        )
    value = constraint.get("parameterization")
    text = "0" if value is None else str(value).strip().upper()
    kind = _PARAMETRIZATIONS.get(text)
    if kind is None:
        raise SceneError(
            f"{where}: parameterization must be 0 (XYZ_EULER_ANGLES) or 1 (ROTATION_VECTOR), got {value!r:.60}"
        )
    rotation = rotation_of(constraint.get("orientation"), where)
    return rotation, np.minimum(tolerance, np.pi), kind


def _goal_orientation(constraint: Any, where: str) -> tuple[Array, Array]:
    """Return rotation matrix and tolerances of the rotation vector [rad] of an orientation constraint."""
    rotation, tolerance, kind = orientation_of(constraint, where)
    if kind == ROTATION_VECTOR:
        return rotation, tolerance
    try:
        return rotation, rotation_vector_tolerance(tolerance)
    except ValueError as error:
        raise SceneError(f"{where}: orientation constraint: {error}") from error
