"""Numbers of a URDF that are probably in another unit, and elements that a robot lacks, each named in a sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator
from xml.etree.ElementTree import Element

import numpy as np

from cnpgen.robots.urdf import number_in, numbers_in
from cnpgen.robots.urdf_elements import unread_elements

MAX_SPEED_RAD_S = 50.0  # of a revolute joint; faster ones are probably in deg/s
MAX_ANGLE_RAD = 2 * math.pi + 1e-6  # of a roll, pitch or yaw
MAX_AXIS_ERROR = 1e-3  # of the length of an axis, 1
MAX_CENTER_TO_LINK_RATIO = 2.0  # distance of a centre of mass / size of its link
MIN_CENTER_M = 0.1  # smaller distances are not doubted
MIN_MASS_KG = 0.01  # of bodies with an inertia
_ZERO = (0.0, 0.0, 0.0)


def doubts(tree: Element) -> Iterator[str]:
    """Yield a sentence for every number of a URDF that is probably wrong, and for what is not read."""
    yield from unread_elements(tree)
    for joint in tree.findall("joint"):
        yield from _of_joint(joint)
    for link in tree.findall("link"):
        yield from _of_link(tree, link)
    for element in [*tree.findall("joint"), *tree.findall("link")]:
        name = element.get("name", "")
        kind = element.tag
        for origin in element.iter("origin"):
            rpy = numbers_in(origin, "rpy", _ZERO)
            if (angle := max(rpy, key=abs)) and abs(angle) > MAX_ANGLE_RAD:
                text = f"{kind} {name}: <origin rpy> has the angle {angle:g} rad"
                yield f"{text}; {angle:g} deg would be {math.radians(angle):.4g} rad: rpy is in rad"


def _of_joint(joint: Element) -> Iterator[str]:
    name = joint.get("name", "")
    kind = joint.get("type")
    limit = joint.find("limit")
    axis = joint.find("axis")
    if kind in {"revolute", "continuous", "prismatic"}:
        length = math.hypot(*numbers_in(axis, "xyz", (1.0, 0.0, 0.0)))
        if axis is None:
            yield f"joint {name}: it has no <axis>, so that it moves along or about 1 0 0"
        elif abs(length - 1) > MAX_AXIS_ERROR:
            yield f"joint {name}: its <axis> has the length {length:.4g}: only its direction counts"
    if kind in {"revolute", "prismatic"} and limit is not None:
        missing = [key for key in ("lower", "upper") if key not in limit.attrib]
        if len(missing) == 1:
            yield f"joint {name}: its <limit> has no {missing[0]!r}, which means 0"
    speed = number_in(limit, "velocity", 0.0)
    if kind in {"revolute", "continuous"} and speed > MAX_SPEED_RAD_S:
        text = f"joint {name}: its velocity limit is {speed:g} rad/s"
        yield f"{text}; {speed:g} deg/s would be {math.radians(speed):.4g} rad/s: is it in degrees?"


def _of_link(tree: Element, link: Element) -> Iterator[str]:
    name = link.get("name", "")
    inertial = link.find("inertial")
    if inertial is None:
        return
    mass = number_in(inertial.find("mass"), "value", 0.0)
    inertia = inertial.find("inertia")
    if inertia is None:
        yield f"link {name}: its <inertial> has no <inertia>, so that its {mass:g} kg count as a point"
    elif mass > MIN_MASS_KG and not any(
        number_in(inertia, entry, 0.0) for entry in ("ixx", "iyy", "izz")
    ):
        yield f"link {name}: it has {mass:g} kg and an <inertia> of zeros, as a point"
    center = np.linalg.norm(numbers_in(inertial.find("origin"), "xyz", _ZERO))
    size = _size(tree, link)
    if size is not None and center > max(MAX_CENTER_TO_LINK_RATIO * size, MIN_CENTER_M):
        text = f"link {name}: its center of mass is {center:.3g} m from its origin"
        yield f"{text}, the link reaches {size:.3g} m: is the <origin> of its <inertial> in another frame or unit?"


def _size(tree: Element, link: Element) -> float | None:
    """Return the distance from the origin of a link to its geometry and child joints [m]; None with meshes."""
    name = link.get("name", "")
    sizes = [0.0]
    for joint in tree.findall("joint"):
        parent = joint.find("parent")
        if parent is not None and parent.get("link") == name:
            sizes.append(_length(joint))
    for element in [*link.findall("collision"), *link.findall("visual")]:
        geometry = element.find("geometry")
        if geometry is None or geometry.find("mesh") is not None:
            return None
        box = numbers_in(geometry.find("box"), "size", _ZERO)
        parts = [math.hypot(*box) / 2]
        for kind in ("cylinder", "sphere", "capsule"):
            part = geometry.find(kind)
            length = number_in(part, "length", 0.0)
            radius = number_in(part, "radius", 0.0)
            parts.append(length / 2 + radius)
        sizes.append(_length(element) + max(parts))
    return max(sizes)


def _length(element: Element) -> float:
    """Return the length of the translation of an element's origin [m]."""
    return math.hypot(*numbers_in(element.find("origin"), "xyz", _ZERO))
