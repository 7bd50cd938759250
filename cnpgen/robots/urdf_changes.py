"""Changes of the text of a URDF: locked joints, disabled pairs of links, and the payload as a link."""

import logging
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from cnpgen.errors import RecipeError, counted, listed, nearest
from cnpgen.robots.robot_spec import Payload, RobotSpec
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.urdf import number_in, numbers_in, numbers_text, read_urdf, urdf_tree
from cnpgen.robots.urdf_elements import (
    DISABLED,
    NO_DEFAULT,
    PAIR,
    SRDF_NAMES,
    check_elements,
)
from cnpgen.robots.urdf_parameters import placement_of

_TURNING = ("revolute", "continuous")
_SLIDING = ("prismatic",)
# Elements of a joint that moves.
_MOTION = "axis", "limit", "mimic", "calibration", "dynamics", "safety_controller"
PAYLOAD = "carried payload"  # name of the link and of its joint

_LOG = logging.getLogger(__name__)


def with_locked_joints(
    urdf: str, positions: Mapping[str, float], *, is_stored: bool
) -> str:
    """Return a URDF whose locked joints are fixed at their positions [rad or m], with those that mimic them.

    The joints of a stored problem are fixed already.
    """
    if not positions:
        return urdf
    errors = list[str]()
    try:
        robot = urdf_tree(urdf)
        joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
        errors += [
            f"the URDF has no joint {name!r}{nearest(name, joints)}"
            for name in positions
            if name not in joints
        ]
        if not errors:
            all_positions = dict(positions) | _mimicking(joints, positions)
            for name, position in all_positions.items():
                try:
                    errors += _fix(joints[name], position, is_stored)
                except ValueError as error:
                    errors.append(f"joint {name!r}: {error}")
    except ValueError as error:
        errors.append(str(error))
    if errors:
        raise RecipeError([f"robot.locked_joints: {text}" for text in errors])
    return ElementTree.tostring(robot, encoding="unicode")


def _mimicking(
    joints: Mapping[str, Element], positions: Mapping[str, float]
) -> dict[str, float]:
    """Return the positions of joints that mimic a locked one and have none of their own."""
    found = {}
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if (
            mimic is not None
            and mimic.get("joint") in positions
            and name not in positions
        ):
            factor = number_in(mimic, "multiplier", 1.0)
            offset = number_in(mimic, "offset", 0.0)
            found[name] = factor * positions[mimic.get("joint", "")] + offset
    return found


def _fix(joint: Element, position: float, is_stored: bool) -> list[str]:
    """Make a joint fixed at a position; return its errors."""
    import pinocchio as pin

    name = joint.get("name", "")
    kind = joint.get("type", "")
    if kind == "fixed" and is_stored:
        return []
    if kind not in _TURNING + _SLIDING:
        return [
            f"joint {name!r} is {kind} and has no position, expected a revolute, continuous or prismatic joint"
        ]
    limit = joint.find("limit")
    low = number_in(limit, "lower", 0.0)
    high = number_in(limit, "upper", 0.0)
    if kind != "continuous" and not low - 1e-9 <= position <= high + 1e-9:
        unit = "m" if kind in _SLIDING else "rad"
        return [
            f"joint {name!r} is locked at {position:g} {unit}, outside of its limits {low:g} to {high:g} {unit}"
        ]
    axis = np.array(numbers_in(joint.find("axis"), "xyz", (1.0, 0.0, 0.0)))
    if not np.linalg.norm(axis):
        return [f"joint {name!r} has the axis 0 0 0"]
    axis /= np.linalg.norm(axis)
    placement = placement_of(joint)
    xyz, rotation = placement.translation, placement.rotation
    if kind in _SLIDING:
        xyz = xyz + rotation @ (position * axis)
    else:
        rotation = rotation @ _turn(axis, position)
    for part in [part for part in joint if part.tag in (*_MOTION, "origin")]:
        joint.remove(part)
    joint.set("type", "fixed")
    rpy = numbers_text(pin.rpy.matrixToRpy(rotation))
    joint.insert(0, Element("origin", xyz=numbers_text(xyz), rpy=rpy))
    return []


def with_point_masses(urdf: str) -> str:
    """Return a URDF in which a mass without an <inertia> is a point.

    URDF parsers drop the mass, with errors on stderr.
    """
    try:
        robot = urdf_tree(urdf)
    except ValueError:
        # The reader of the robot raises the error.
        return urdf
    inertials = [
        inertial
        for inertial in robot.iterfind("link/inertial")
        if inertial.find("inertia") is None and inertial.find("mass") is not None
    ]
    for inertial in inertials:
        zeros = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
        inertial.append(Element("inertia", zeros))
    return ElementTree.tostring(robot, encoding="unicode") if inertials else urdf


def with_collision_geometry(
    urdf: str, visual: Iterable[str], skipped: Iterable[str]
) -> str:
    """Return a URDF with other collision elements.

    Args:
        urdf: Text of the URDF.
        visual: Links without a <collision> element that get one for each <visual>.
        skipped: Links whose collision meshes are removed.

    Raises:
        RecipeError: There is no such link.
    """
    visual = tuple(visual)
    skipped = tuple(skipped)
    if not visual and not skipped:
        return urdf
    robot = urdf_tree(urdf)
    links = {link.get("name", ""): link for link in robot.findall("link")}
    errors = list[str]()
    for name in visual:
        error = _link_error(links, name, "visual", none_of="collision")
        errors += [f"robot.visual_links: {error}"] if error else []
    for name in skipped:
        error = _link_error(links, name, "collision/geometry/mesh")
        errors += [f"robot.skipped_meshes: {error}"] if error else []
    if errors:
        raise RecipeError(errors)
    for name in visual:
        links[name].extend(map(_as_collision, links[name].findall("visual")))
    for name in skipped:
        for element in links[name].findall("collision"):
            if element.find("geometry/mesh") is not None:
                links[name].remove(element)
    return ElementTree.tostring(robot, encoding="unicode")


def _link_error(
    links: Mapping[str, Element], name: str, element: str, none_of: str = ""
) -> str:
    """Return an error message for a link without an element, or with another one; empty if there is none."""
    if name not in links:
        return f"the URDF has no link {name!r}{nearest(name, links)}"
    if links[name].find(element) is None:
        return f"the link {name!r} has no {element}"
    if none_of and links[name].find(none_of) is not None:
        return f"the link {name!r} has <{none_of}> elements, which count"
    return ""


def _as_collision(visual: Element) -> Element:
    """Return a <collision> element with the place and the geometry of a <visual> element."""
    collision = Element("collision")
    collision.extend(
        part for tag in ("origin", "geometry") for part in visual.findall(tag)
    )
    return collision


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation about a unit axis (Rodrigues), shape (3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(
        np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    )


def without_disabled_pairs(urdf: str) -> str:
    """Return a URDF without the link pairs that it disables: only an SRDF, or the problem, does so."""
    robot = urdf_tree(urdf)
    if not (entries := robot.findall(f".//{DISABLED}/..")):
        return urdf
    for parent in entries:
        for entry in parent.findall(DISABLED):
            parent.remove(entry)
    return ElementTree.tostring(robot, encoding="unicode")


def with_disabled_pairs(
    urdf: str,
    srdf: Path,
    *,
    planned: Collection[str] = (),
    allow_unused: Collection[str] = (),
) -> str:
    """Return a URDF with the disabled link pairs of an SRDF file, in which some names may be left unused.

    No planned joint may be passive.

    URDF parsers ignore unknown elements. Pairs with links that the URDF lacks, such as
    those of another gripper, are left out with a warning that lists the links.
    """
    try:
        tree = urdf_tree(read_urdf(srdf))
    except ValueError as error:
        raise RecipeError([f"{srdf}: not an SRDF that can be read: {error}"]) from error
    if tree.find("link") is not None:
        raise RecipeError(
            [f"{srdf}: is a URDF, expected an SRDF with <{DISABLED}> elements"]
        )
    _account_srdf(tree, srdf, allow_unused)
    passive = {each.get("name", "") for each in tree.iter("passive_joint")}
    if moved := sorted(passive.intersection(planned)):
        text = f"<passive_joint> names the planned joint {moved[0]!r}"
        raise RecipeError([f"{srdf}: {text}: no motor moves it, remove one of both"])
    entries = [dict(entry.attrib) for entry in tree.iter(DISABLED)]
    robot = urdf_tree(urdf)
    names = tree.get("name", ""), robot.get("name", "")
    if all(names) and names[0] != names[1]:
        _LOG.warning("%s is of the robot %r, the URDF of %r", srdf, *names)
    links = {link.get("name", "") for link in robot.iter("link")}
    named = {entry[key] for entry in entries for key in PAIR if key in entry}
    if unknown := sorted(named - links):
        count = counted(len(unknown), "link")
        _LOG.warning(
            "%s names %s that the URDF lacks: %s", srdf, count, listed(unknown)
        )
    known = [
        entry
        for entry in entries
        if not {entry.get(key, "") for key in PAIR} & set(unknown)
    ]
    return _with_entries(urdf, known, str(srdf))


def _account_srdf(tree: Element, srdf: Path, allow_unused: Collection[str]) -> None:
    """Raise RecipeError for elements of an SRDF that are not honoured or unknown, and list those that are not used."""
    check_elements(tree, srdf, SRDF_NAMES, allow_unused=allow_unused)
    if tree.find(NO_DEFAULT) is not None:
        text = f"its link would collide with no obstacle: give pairs by <{DISABLED}>"
        raise RecipeError([f"{srdf}: <{NO_DEFAULT}> is not supported: {text}"])
    if unused := sorted({f"<{element.tag}>" for element in tree} - {f"<{DISABLED}>"}):
        _LOG.info("%s: not used: %s", srdf, listed(unused))


def with_ignored_pairs(urdf: str, pairs: Iterable[tuple[str, str]]) -> str:
    """Return a URDF with disabled link pairs of a problem."""
    entries = [
        {"link1": first, "link2": second, "reason": "User"} for first, second in pairs
    ]
    return _with_entries(urdf, entries, "robot.ignored_pairs")


def _with_entries(urdf: str, entries: list[dict[str, str]], source: str) -> str:
    robot = urdf_tree(urdf)
    links = {link.get("name", "") for link in robot.iter("link")}
    for entry in entries:
        if missing := [key for key in PAIR if key not in entry]:
            raise RecipeError([f"{source}: {entry} lacks {', '.join(missing)}"])
        if entry["link1"] == entry["link2"]:
            text = f"a pair names the link {entry['link1']!r} twice"
            raise RecipeError([f"{source}: {text}"])
    named = {entry[key] for entry in entries for key in PAIR}
    if unknown := sorted(named - links):
        raise RecipeError([f"{source}: the URDF has no link {', '.join(unknown)}"])
    known = [
        frozenset((one.get("link1"), one.get("link2"))) for one in robot.iter(DISABLED)
    ]
    for entry in entries:
        if frozenset((entry["link1"], entry["link2"])) not in known:
            robot.append(ElementTree.Element(DISABLED, entry))
    return ElementTree.tostring(robot, encoding="unicode")


def disabled_pairs(urdf: str) -> frozenset[frozenset[str]] | None:
    """Return the disabled link pairs; None without any."""
    entries = list(urdf_tree(urdf).iter(DISABLED))
    pairs = frozenset(
        frozenset((entry.get("link1", ""), entry.get("link2", ""))) for entry in entries
    )
    return pairs or None


def with_payload_link(
    urdf: str, spec: RobotSpec, payload: Payload | None, *, is_stored: bool
) -> str:
    """Return a URDF with the box of the payload as a link without mass, fixed to the tip.

    The mass belongs to the robot's attachments. A payload with touch links is a body. A
    stored problem has the link already, which is replaced if it differs.
    """
    is_body = payload is not None and bool(payload.touch_links)
    if not is_body and PAYLOAD not in urdf:
        return urdf
    robot = urdf_tree(urdf)
    old = [
        part
        for part in robot
        if part.tag in {"link", "joint"} and part.get("name") == PAYLOAD
    ]
    if old and not is_stored:
        raise RecipeError(
            [
                f"payload: the URDF has a link or joint {PAYLOAD!r}, which is the name of the payload's own"
            ]
        )
    new = (
        list(_elements(robot, spec, payload)) if payload is not None and is_body else []
    )
    if [ElementTree.tostring(part) for part in old] == [
        ElementTree.tostring(part) for part in new
    ]:
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
        raise RecipeError(
            [f"robot.tip: the URDF has no frame {spec.tip!r}{nearest(spec.tip, links)}"]
        )
    for name in payload.touch_links:
        if name not in links:
            text = f"the URDF has no link {name!r}{nearest(name, links)}"
            raise RecipeError([f"payload.touch_links: {text}"])
    link = ElementTree.Element("link", name=PAYLOAD)
    for kind in ("visual", "collision"):
        element = ElementTree.SubElement(link, kind)
        geometry = ElementTree.SubElement(element, "geometry")
        ElementTree.SubElement(geometry, "box", size=numbers_text(payload.size or ()))
    joint = ElementTree.Element("joint", name=PAYLOAD, type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=PAYLOAD)
    offset = turned(*spec.tip_rotation) @ np.array(payload.centre)
    xyz = numbers_text((np.array(spec.tip_offset) + offset).tolist())
    rpy = numbers_text(spec.tip_rotation)
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    return link, joint
