"""An arm in a URDF: its frames and links, the joints that move a tip, and missing limits."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

from cnpgen.errors import RecipeError, UsageError, listed
from cnpgen.problems.checks import frames_of, missing_frame, unread_xacro
from cnpgen.robots.urdf import number_in, read_urdf, urdf_tree

DEFAULT_RANGE_RAD, DEFAULT_RANGE_M = math.pi, 0.5  # ranges to either side, where the URDF has none
DEFAULT_SPEED = 1.0  # rad/s or m/s, where the URDF has none


@dataclass(frozen=True)
class ArmJoint:
    """A movable joint with the limits of the URDF or placeholders.

    Attributes:
        name: Its name.
        kind: Its type in the URDF: "revolute", "continuous", "prismatic" or what cannot be planned.
        lower: Lower limit of its position [rad or m].
        upper: Upper limit.
        velocity: Limit of its velocity [rad/s or m/s].
        effort: Limit of its torque or force [N m or N]; 0 where the URDF has none.
        missing: Which limits the URDF does not have: "position", "velocity", "torque".
    """

    name: str
    kind: str
    lower: float
    upper: float
    velocity: float
    effort: float
    missing: tuple[str, ...]


@dataclass(frozen=True)
class Arm:
    """An arm in a URDF.

    Attributes:
        urdf: The URDF file.
        tip: The tip frame.
        planned: The joints between the root and the tip, from the root outwards.
        locked: Names of all other joints that move: they stay at zero.
        moved: The links that planned joints move.
        frames: Names of all links and joints.
        masses: Link -> its mass [kg]; 0 where it has none.
        shaped: The links that have a ``<collision>`` element.
        meshes: The mesh files that links name.
    """

    urdf: Path
    tip: str
    planned: tuple[ArmJoint, ...]
    locked: tuple[str, ...]
    moved: tuple[str, ...]
    frames: tuple[str, ...]
    masses: Mapping[str, float]
    shaped: tuple[str, ...]
    meshes: tuple[str, ...]

    @property
    def has_shape(self) -> bool:
        """Whether links that move have collision geometry."""
        return bool(set(self.shaped) & set(self.moved))


def read_arm(urdf: Path, tip: str | None) -> Arm:
    """Read an arm.

    Args:
        urdf: The URDF file.
        tip: The tip frame: a link or a joint; by default the only link without a child.

    Raises:
        RecipeError: The file cannot be read, needs xacro, or has no joint that moves the tip.
        UsageError: The frame does not exist, or several links have no child.
    """
    try:
        tree = urdf_tree(read_urdf(urdf))
    except ValueError as error:
        raise RecipeError([f"{urdf}: {error}"]) from error
    if text := unread_xacro(tree, urdf):
        raise RecipeError([text])
    links = [link.get("name", "") for link in tree.findall("link")]
    joints = {_end(joint, "child"): joint for joint in tree.findall("joint") if joint.find("child") is not None}
    tip = tip if tip is not None else _only_leaf(urdf, links, joints)
    if text := missing_frame(tree, urdf, tip):
        raise UsageError(f"--tip: {text}")
    path = list(_path(urdf, tip, joints))
    moving = [joint for joint in path if _moves(joint)]
    if not moving:
        raise RecipeError([f"{urdf}: no joint moves the frame {tip!r}; its frames: {listed(frames_of(tree))}"])
    planned = tuple(_joint(urdf, joint) for joint in moving)
    names = {joint.name for joint in planned}
    return Arm(
        urdf=urdf,
        tip=tip,
        planned=planned,
        locked=tuple(
            str(joint.get("name")) for joint in joints.values() if _moves(joint) and joint.get("name") not in names
        ),
        moved=tuple(link for link in links if moving[0] in _path(urdf, link, joints)),
        frames=tuple(frames_of(tree)),
        masses={link.get("name", ""): _mass(urdf, link) for link in tree.findall("link")},
        shaped=tuple(link.get("name", "") for link in tree.findall("link") if link.find("collision") is not None),
        meshes=tuple(mesh.get("filename", "") for mesh in tree.iterfind("link//mesh")),
    )


def with_torques(arm: Arm, torques: list[float]) -> Arm:
    """Return an arm with torques [N m] in place of missing ones."""
    pairs = zip(arm.planned, torques, strict=True)
    return replace(arm, planned=tuple(replace(each, effort=each.effort or torque) for each, torque in pairs))


def _only_leaf(urdf: Path, links: list[str], joints: Mapping[str, ElementTree.Element]) -> str:
    parents = {_end(joint, "parent") for joint in joints.values()}
    leaves = [link for link in links if link not in parents]
    if len(leaves) != 1:
        leaf_text = f"{len(leaves)} links have no child: {', '.join(leaves)}" if leaves else "every link has a child"
        raise UsageError(f"--tip must name the tip frame of {urdf.name}: {leaf_text}")
    return leaves[0]


def _path(urdf: Path, frame: str, joints: Mapping[str, ElementTree.Element]) -> Iterator[ElementTree.Element]:
    """Return the joints between the root and a frame, from the root outwards."""
    named = {joint.get("name"): child for child, joint in joints.items()}
    found, link = list[ElementTree.Element](), frame if frame in joints else named.get(frame, frame)
    while link in joints:
        found.append(joints[link])
        link = _end(joints[link], "parent")
        if len(found) > len(joints):
            raise RecipeError([f"{urdf}: its joints form a cycle at link {link!r}"])
    return reversed(found)


def _end(joint: ElementTree.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def _moves(joint: ElementTree.Element) -> bool:
    return joint.get("type", "fixed") != "fixed"


def _joint(urdf: Path, joint: ElementTree.Element) -> ArmJoint:
    """Read a joint, and fill in missing limits."""
    limit, kind = joint.find("limit"), joint.get("type", "")
    owner = f"joint {joint.get('name', '')!r}: "
    lower, upper, velocity, effort = (
        _number(urdf, limit, key, owner) for key in ("lower", "upper", "velocity", "effort")
    )
    if lower > upper and kind in ("revolute", "prismatic"):
        text = f"its limits lower={lower:g} and upper={upper:g} are swapped: exchange them"
        raise RecipeError([f"{urdf}: {owner}{text}"])
    missing = {"position": kind == "continuous" or not lower < upper, "velocity": velocity <= 0, "torque": effort <= 0}
    half = DEFAULT_RANGE_M if kind == "prismatic" else DEFAULT_RANGE_RAD
    return ArmJoint(
        name=joint.get("name", ""),
        kind=kind,
        lower=-half if missing["position"] else lower,
        upper=half if missing["position"] else upper,
        velocity=DEFAULT_SPEED if missing["velocity"] else velocity,
        effort=max(effort, 0.0),
        missing=tuple(name for name, is_missing in missing.items() if is_missing),
    )


def _mass(urdf: Path, link: ElementTree.Element) -> float:
    return _number(urdf, link.find("inertial/mass"), "value", f"link {link.get('name', '')!r}: ")


def _number(urdf: Path, element: ElementTree.Element | None, attribute: str, owner: str) -> float:
    """Return a number of an element, 0 without it; an error begins with the element's owner."""
    try:
        return number_in(element, attribute, 0.0)
    except ValueError as error:
        raise RecipeError([f"{urdf}: {owner}{error}"]) from error
