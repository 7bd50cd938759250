"""A second, independent reading of URDFs: ElementTree, float() and SciPy's rotations."""

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import scipy

from cnpgen.robots.robot import Robot

IDENTITY = np.eye(4)


@dataclass(frozen=True)
class Body:
    """The rigid body that a planned joint moves, in the frame of the joint.

    Attributes:
        mass: Mass [kg].
        mass_center: Mass times center of mass [kg m], shape (3,).
        inertia: Inertia about the origin of the joint [kg m^2], shape (3, 3).
        placement: Pose of the joint in the previous planned joint at zero, shape (4, 4).
        axis: Unit axis, shape (3,).
        limits: Lower and upper position, velocity and effort, shape (4,).
    """

    mass: float
    mass_center: np.ndarray
    inertia: np.ndarray
    placement: np.ndarray
    axis: np.ndarray
    limits: np.ndarray


def bodies_in(text: str, planned: Sequence[str]) -> list[Body]:
    """Read the bodies that planned joints move, from the base outwards; all other joints are at zero."""
    tree = ElementTree.fromstring(text)
    links = {link.get("name"): link for link in tree.findall("link")}
    joints = tree.findall("joint")
    bodies = []
    for name in planned:
        joint = next(joint for joint in joints if joint.get("name") == name)
        mass, first, second = _lump(
            _end(joint, "child"), IDENTITY, links, joints, planned
        )
        axis = np.array(
            [1.0, 0, 0]
            if (found := joint.find("axis")) is None
            else _floats(found.attrib["xyz"])
        )
        limit = joint.find("limit")
        limits = [0.0] * 4
        if limit is not None:
            limits = [
                float(limit.get(key, 0))
                for key in ("lower", "upper", "velocity", "effort")
            ]
        placement = _placement_in_planned(joint, joints, planned)
        bodies.append(
            Body(
                mass,
                first,
                second,
                placement,
                axis / np.linalg.norm(axis),
                np.array(limits),
            )
        )
    return bodies


def differences(
    robot: Robot, bodies: Sequence[Body], *, rtol: float = 1e-9
) -> list[str]:
    """List the parts in which the model of a robot differs from bodies."""
    model, found = robot.model, []
    for index, body in enumerate(bodies, start=1):
        inertia, placement = model.inertias[index], model.jointPlacements[index]
        lever = np.array(inertia.lever)
        about_origin = inertia.inertia + inertia.mass * (
            lever @ lever * np.eye(3) - np.outer(lever, lever)
        )
        subspace = np.asarray(model.createData().joints[index].S, float).ravel()
        limits = [
            model.lowerPositionLimit[index - 1],
            model.upperPositionLimit[index - 1],
            model.velocityLimit[index - 1],
            model.effortLimit[index - 1],
        ]
        pairs = {
            "mass": (inertia.mass, body.mass),
            "mass times center": (inertia.mass * lever, body.mass_center),
            "inertia about the origin": (about_origin, body.inertia),
            "placement": (placement.homogeneous, body.placement),
            "axis": (
                subspace[:3] if robot.prismatic[index - 1] else subspace[3:],
                body.axis,
            ),
            "limits": (np.array(limits), body.limits),
        }
        for part, (actual, expected) in pairs.items():
            scale = max(np.abs(expected).max(), 1e-9 if part != "mass" else 0.0)
            if not np.allclose(actual, expected, rtol=0, atol=rtol * scale):
                found.append(f"{model.names[index]}: {part}")
    return found


def _floats(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])


def _end(joint: Element, tag: str) -> str:
    element = joint.find(tag)
    assert element is not None
    return element.attrib["link"]


def _pose(element: Element) -> np.ndarray:
    """Return the <origin> of an element, shape (4, 4)."""
    origin, pose = element.find("origin"), np.eye(4)
    if origin is not None:
        pose[:3, :3] = scipy.spatial.transform.Rotation.from_euler(
            "xyz", _floats(origin.get("rpy", "0 0 0"))
        ).as_matrix()
        pose[:3, 3] = _floats(origin.get("xyz", "0 0 0"))
    return pose


def _lump(
    link: str,
    pose: np.ndarray,
    links: dict,
    joints: list[Element],
    planned: Sequence[str],
) -> tuple:
    """Add up mass and inertia of a link and of all links that are fixed to it."""
    mass, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    element = links[link].find("inertial")
    if element is not None:
        mass = float(element.find("mass").attrib["value"])
        entries = element.find("inertia")
        tensor = (
            {key: float(value) for key, value in entries.attrib.items()}
            if entries is not None
            else {}
        )
        rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
        matrix = np.array([[tensor.get(key, 0.0) for key in row] for row in rows])
        center = pose @ _pose(element)
        com, rotation = center[:3, 3], center[:3, :3]
        first = mass * com
        second = rotation @ matrix @ rotation.T + mass * (
            com @ com * np.eye(3) - np.outer(com, com)
        )
    for joint in joints:
        if _end(joint, "parent") == link and joint.get("name") not in planned:
            more = _lump(
                _end(joint, "child"), pose @ _pose(joint), links, joints, planned
            )
            mass, first, second = mass + more[0], first + more[1], second + more[2]
    return mass, first, second


def _placement_in_planned(
    joint: Element, joints: list[Element], planned: Sequence[str]
) -> np.ndarray:
    pose, link = _pose(joint), _end(joint, "parent")
    while (
        above := next((each for each in joints if _end(each, "child") == link), None)
    ) is not None:
        if above.get("name") in planned:
            break
        pose, link = _pose(above) @ pose, _end(above, "parent")
    return pose
