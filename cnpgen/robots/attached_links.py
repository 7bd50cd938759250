"""Attached objects as links of a URDF: shapes, mass and touch links of a body that a link carries."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.inline import address_of, corners_of
from cnpgen.robots.urdf import numbers_text, urdf_tree
from cnpgen.robots.urdf_changes import with_ignored_pairs

if TYPE_CHECKING:
    import pinocchio as pin

_INERTIA = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2)}
_INERTIA |= {"iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def attached_link_name(name: str) -> str:
    """Return the name of the link, and of its joint, of an attached object."""
    return f"attached {name}"


def root_link(urdf: str) -> str:
    """Return the name of the link that is no child."""
    robot = urdf_tree(urdf)
    children = {child.get("link") for child in robot.iterfind("joint/child")}
    links = (link.get("name", "") for link in robot.findall("link"))
    return next(link for link in links if link not in children)


def with_attached_link(
    urdf: str,
    name: str,
    link: str,
    *,
    shapes: Sequence[Obstacle],
    mass: float,
    touch_links: Iterable[str],
) -> str:
    """Return a URDF with an attached object as a link that is fixed to another one.

    Args:
        urdf: Text of the URDF, whose meshes are inline.
        name: Name of the object.
        link: Link that carries it.
        shapes: Its shapes, with poses in the frame of that link.
        mass: Its mass [kg], which all shapes share by volume; 0 for none.
        touch_links: Links that may touch it, beside ``link``.

    Raises:
        RecipeError: The URDF has a link or a joint of that name.
    """
    robot = urdf_tree(urdf)
    body = attached_link_name(name)
    element = Element("link", name=body)
    if any(part.get("name") == body for part in robot if part.tag in {"link", "joint"}):
        raise RecipeError([f"the URDF has a link or joint {body!r} already"])
    if mass:
        element.append(_inertial(uniform_inertia(shapes, mass)))
    for kind in ("visual", "collision"):
        for shape in shapes:
            part = SubElement(element, kind)
            xyz = numbers_text(shape.position or ())
            rpy = numbers_text(shape.rotation)
            SubElement(part, "origin", xyz=xyz, rpy=rpy)
            SubElement(part, "geometry").append(shape.form.urdf())
    return _with_link(robot, element, link, dict.fromkeys((link, *touch_links)))


def _with_link(
    robot: Element, element: Element, parent: str, touching: Iterable[str]
) -> str:
    """Return a URDF with a link that is fixed to another one, and that some links may touch."""
    body = element.get("name", "")
    robot.append(element)
    joint = SubElement(robot, "joint", name=body, type="fixed")
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=body)
    text = ElementTree.tostring(robot, encoding="unicode")
    return with_ignored_pairs(text, [(each, body) for each in touching])


def with_padded_link(
    urdf: str, link: str, scale: float, padding: float, *, obstacles: Sequence[str]
) -> str:
    """Return a URDF with an enlarged copy of a link's collision geometry, which other links may touch.

    Args:
        urdf: Text of the URDF, whose meshes are inline.
        link: The link.
        scale: Factor of the sizes of every shape.
        padding: What these then grow by to all sides [m].
        obstacles: Fixed links that are obstacles, which the copy must not touch.
    """
    robot = urdf_tree(urdf)
    links = {each.get("name", ""): each for each in robot.findall("link")}
    copy = Element("link", name=attached_link_name(f"padding of {link}"))
    # The enlarged shapes are copies, since the link keeps its own ones.
    copy.extend(deepcopy(links[link].findall("collision")))
    # A link without collision geometry has nothing to enlarge.
    if not len(copy):
        return urdf
    for shape in copy.iterfind("collision/geometry/*"):
        _enlarge(shape, scale, padding)
    return _with_link(
        robot, copy, link, [each for each in links if each not in obstacles]
    )


def _enlarge(shape: Element, scale: float, padding: float) -> None:
    """Enlarge a geometry, as ``geometric_shapes`` of MoveIt does.

    The corners v of a hull with the mean c become c + (scale + padding / |v - c|) (v - c).
    """
    if shape.tag == "mesh":
        corners = corners_of(shape.get("filename", ""))
        center = corners.mean(axis=0)
        offsets = corners - center
        lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
        grown = center + (scale + padding / lengths) * offsets
        shape.set("filename", address_of(grown))
        return
    # A capsule is longer by the growth of its radius.
    sides = {"size": 2, "radius": 1, "length": 0 if shape.tag == "capsule" else 2}
    for key in sides.keys() & shape.keys():
        values = (float(value) for value in shape.get(key, "").split())
        grown_sizes = (scale * value + sides[key] * padding for value in values)
        shape.set(key, numbers_text(grown_sizes))


def uniform_inertia(shapes: Sequence[Obstacle], mass: float) -> pin.Inertia:
    """Return the inertia of shapes of one density, in the frame of their poses, for a total mass [kg]."""
    import pinocchio as pin

    bodies = [shape.form.coal() for shape in shapes]
    volumes = np.array([body.computeVolume() for body in bodies])
    density = mass / volumes.sum()
    total = pin.Inertia.Zero()
    for shape, body, volume in zip(shapes, bodies, volumes, strict=True):
        # Coal returns the inertia at unit density, about the center of mass
        inertia = density * np.array(body.computeMomentofInertiaRelatedToCOM())
        center = np.array(body.computeCOM())
        placement = pin.SE3(turned(*shape.rotation), np.array(shape.position))
        # Inertias add up in one frame: that of the poses.
        total += placement.act(pin.Inertia(density * volume, center, inertia))
    return total


def _inertial(inertia: pin.Inertia) -> Element:
    """Return the element of an inertia: mass, center of mass, and inertias about it along the axes of the link."""
    element = Element("inertial")
    SubElement(element, "origin", xyz=numbers_text(inertia.lever), rpy="0 0 0")
    SubElement(element, "mass", value=numbers_text([inertia.mass]))
    inertias = {
        key: numbers_text([inertia.inertia[index]]) for key, index in _INERTIA.items()
    }
    SubElement(element, "inertia", inertias)
    return element
