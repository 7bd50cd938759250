"""Locked joints of a URDF, such as those of a gripper: they become fixed at a position other than zero."""

from collections.abc import Mapping
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from cnpgen.errors import RecipeError, nearest
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.urdf import number_in, numbers_in, numbers_text, urdf_tree

_TURNING, _SLIDING = ("revolute", "continuous"), ("prismatic",)
_MOTION = ("axis", "limit", "mimic", "calibration", "dynamics", "safety_controller")  # elements of a joint that moves


def with_locked_joints(urdf: str, positions: Mapping[str, float], *, is_stored: bool) -> str:
    """Return a URDF whose locked joints are fixed at their positions [rad or m], with those that mimic them.

    The joints of a stored problem are fixed already.

    Raises:
        RecipeError: A joint does not exist, does not move, or its position is outside of its limits.
    """
    if not positions:
        return urdf
    mistakes = list[str]()
    try:
        robot = urdf_tree(urdf)
        joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
        mistakes += [
            f"the URDF has no joint {name!r}{nearest(name, joints)}" for name in positions if name not in joints
        ]
        if not mistakes:
            all_positions = dict(positions) | _mimicking(joints, positions)
            mistakes += [text for name, q in all_positions.items() for text in _fix(joints[name], q, is_stored)]
    except ValueError as error:
        mistakes.append(str(error))
    if mistakes:
        raise RecipeError([f"robot.locked_joints: {text}" for text in mistakes])
    return ElementTree.tostring(robot, encoding="unicode")


def _mimicking(joints: Mapping[str, Element], positions: Mapping[str, float]) -> dict[str, float]:
    """Return the positions of joints that mimic a locked one and have none of their own."""
    found = {}
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is not None and mimic.get("joint") in positions and name not in positions:
            factor, offset = number_in(mimic, "multiplier", 1.0), number_in(mimic, "offset", 0.0)
            found[name] = factor * positions[mimic.get("joint", "")] + offset
    return found


def _fix(joint: Element, position: float, is_stored: bool) -> list[str]:
    """Make a joint fixed at a position; return its mistakes."""
    import pinocchio as pin

    name, kind = joint.get("name", ""), joint.get("type", "")
    if kind == "fixed" and is_stored:
        return []
    if kind not in _TURNING + _SLIDING:
        return [f"joint {name!r} is {kind} and has no position, expected a revolute, continuous or prismatic joint"]
    limit = joint.find("limit")
    low, high = number_in(limit, "lower", 0.0), number_in(limit, "upper", 0.0)
    if kind != "continuous" and not low - 1e-9 <= position <= high + 1e-9:
        unit = "m" if kind in _SLIDING else "rad"
        return [f"joint {name!r} is locked at {position:g} {unit}, outside of its limits {low:g} to {high:g} {unit}"]
    axis = np.array(numbers_in(joint.find("axis"), "xyz", (1.0, 0.0, 0.0)))
    if not np.linalg.norm(axis):
        return [f"joint {name!r} has the axis 0 0 0"]
    axis /= np.linalg.norm(axis)
    origin = joint.find("origin")
    xyz = np.array(numbers_in(origin, "xyz", (0.0, 0.0, 0.0)))
    rotation = turned(*numbers_in(origin, "rpy", (0.0, 0.0, 0.0)))
    if kind in _SLIDING:
        xyz = xyz + rotation @ (position * axis)
    else:
        rotation = rotation @ _turn(axis, position)
    for part in [part for part in joint if part.tag in (*_MOTION, "origin")]:
        joint.remove(part)
    joint.set("type", "fixed")
    joint.insert(0, Element("origin", xyz=numbers_text(xyz), rpy=numbers_text(pin.rpy.matrixToRpy(rotation))))
    return []


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation about a unit axis (Rodrigues), shape (3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
