"""The payload as a link of a URDF: a box that touches neither other links nor obstacles."""

from xml.etree import ElementTree

import numpy as np

from cnpgen.errors import RecipeError, nearest
from cnpgen.robots.robot_spec import Payload, RobotSpec
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.urdf import numbers_text, urdf_tree

PAYLOAD = "carried payload"  # name of the link and of its joint


def with_payload_link(urdf: str, spec: RobotSpec, payload: Payload | None, *, is_stored: bool) -> str:
    """Return a URDF with the box of the payload as a link without mass, fixed to the tip.

    The mass belongs to the robot's attachments. A payload with touch links is a body. A stored problem has the link
    already, which is replaced if it differs.

    Raises:
        RecipeError: A touch link or the tip does not exist, or the URDF has a link of this name.
    """
    is_body = payload is not None and bool(payload.touch_links)
    if not is_body and PAYLOAD not in urdf:
        return urdf
    robot = urdf_tree(urdf)
    old = [part for part in robot if part.tag in {"link", "joint"} and part.get("name") == PAYLOAD]
    if old and not is_stored:
        raise RecipeError(
            [f"payload: the URDF has a link or joint {PAYLOAD!r}, which is the name of the payload's own"]
        )
    new = list(_elements(robot, spec, payload)) if payload is not None and is_body else []
    if [ElementTree.tostring(part) for part in old] == [ElementTree.tostring(part) for part in new]:
        return urdf
    for part in old:
        robot.remove(part)
    robot.extend(new)
    return ElementTree.tostring(robot, encoding="unicode")


def _elements(
    robot: ElementTree.Element, spec: RobotSpec, payload: Payload
) -> tuple[ElementTree.Element, ElementTree.Element]:
    """Return the link and the joint of the payload."""
    links = [link.get("name", "") for link in robot.findall("link")]
    children = {
        joint.get("name", ""): child.get("link", "")
        for joint in robot.findall("joint")
        if (child := joint.find("child")) is not None
    }
    parent = spec.tip if spec.tip in links else children.get(spec.tip, "")
    if not parent:
        raise RecipeError([f"robot.tip: the URDF has no frame {spec.tip!r}{nearest(spec.tip, links)}"])
    for name in payload.touch_links:
        if name not in links:
            raise RecipeError([f"payload.touch_links: the URDF has no link {name!r}{nearest(name, links)}"])
    link, joint = ElementTree.Element("link", name=PAYLOAD), ElementTree.Element("joint", name=PAYLOAD, type="fixed")
    for kind in ("visual", "collision"):
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, kind), "geometry")
        ElementTree.SubElement(geometry, "box", size=numbers_text(payload.size or ()))
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=PAYLOAD)
    center = np.array(spec.tip_offset) + turned(*spec.tip_rotation) @ np.array(payload.centre)
    ElementTree.SubElement(joint, "origin", xyz=numbers_text(center.tolist()), rpy=numbers_text(spec.tip_rotation))
    return link, joint
