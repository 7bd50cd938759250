"""The payload as a link of a URDF: a box that touches neither other links nor obstacles."""

from xml.etree import ElementTree

import numpy as np

from cnpgen.errors import RecipeError, nearest
from cnpgen.robots.robot_spec import Payload, RobotSpec
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.urdf import urdf_tree

PAYLOAD = "payload"  # name of the link


def with_payload_link(urdf: str, spec: RobotSpec, payload: Payload) -> str:
    """Return a URDF with the box of the payload as a link without mass, fixed to the tip.

    The mass belongs to the robot's attachments. A URDF with such a link, for example of a stored problem, is returned
    unchanged.

    Args:
        urdf: Text of the URDF.
        spec: The robot of the problem, with the pose of the tip.
        payload: The payload, with a size.

    Raises:
        RecipeError: A touch link or the tip does not exist.
    """
    robot = urdf_tree(urdf)
    links = [link.get("name", "") for link in robot.findall("link")]
    if PAYLOAD in links:
        return urdf
    children = {
        joint.get("name", ""): child.get("link", "")
        for joint in robot.findall("joint")
        if (child := joint.find("child")) is not None
    }
    parent = spec.tip if spec.tip in links else children.get(spec.tip, "")
    if not parent:
        raise RecipeError([f"robot.tip: the URDF has no frame {spec.tip!r}{nearest(spec.tip, links)}"])
    for link in payload.touch_links:
        if link not in links:
            raise RecipeError([f"payload.touch_links: the URDF has no link {link!r}{nearest(link, links)}"])
    box = ElementTree.SubElement(robot, "link", name=PAYLOAD)
    for kind in ("visual", "collision"):
        geometry = ElementTree.SubElement(ElementTree.SubElement(box, kind), "geometry")
        ElementTree.SubElement(geometry, "box", size=_numbers(payload.size or ()))
    joint = ElementTree.SubElement(robot, "joint", name=f"{PAYLOAD}_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=PAYLOAD)
    center = np.array(spec.tip_offset) + turned(*spec.tip_rotation) @ np.array(payload.centre)
    ElementTree.SubElement(joint, "origin", xyz=_numbers(center.tolist()), rpy=_numbers(spec.tip_rotation))
    return ElementTree.tostring(robot, encoding="unicode")


def _numbers(values: tuple[float, ...] | list[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)
