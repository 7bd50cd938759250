"""An arm in a URDF: its frames and links, the joints that move a tip, and missing limits."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from cnpgen.addons.init.doubts import doubts
from cnpgen.documents import NamedNumbers, Names
from cnpgen.errors import RecipeError, UsageError, listed
from cnpgen.problems.checks import frames_of, missing_frame, unread_xacro
from cnpgen.problems.urdf_dynamics import (
    JointFriction,
    friction_in,
    joint_notes,
    suggested_use,
)
from cnpgen.robots.robot import recipe_errors_in
from cnpgen.robots.urdf import number_in, read_urdf, urdf_tree
from cnpgen.robots.urdf_parameters import (
    LinkInertia,
    UrdfJoint,
    UrdfParameters,
    urdf_parameters,
)

# Ranges to either side, where the URDF has none.
DEFAULT_RANGE_RAD = math.pi
DEFAULT_RANGE_M = 0.5
MAX_INERTIA_ERROR = 0.01  # relative; published URDFs round their numbers
MAX_LIMITED_RAD = 1000.0  # largest limit of a revolute joint that is one
_FINGER = re.compile(r"finger|knuckle|thumb|jaw|claw")  # in names of links
DEFAULT_SPEED = 1.0  # rad/s or m/s, where the URDF has none


@dataclass(frozen=True)
class ArmJoint:
    """A movable joint with the limits of the URDF or placeholders."""

    name: str
    # Type in the URDF: "revolute", "continuous", "prismatic" or one that cannot be
    # planned.
    kind: str
    lower: float  # limit of the position [rad or m]
    upper: float
    velocity: float  # limit [rad/s or m/s]
    effort: float  # limit of the torque or force [N m or N]; 0 where the URDF has none
    # Limits that the URDF does not have: "position", "velocity", "torque".
    missing: Names
    replaced: Names = ()  # limits of the same names that another file states
    jerk: float = math.inf  # limit of a URDF 1.2 [rad/s^3 or m/s^3]


@dataclass(frozen=True)
class Arm:
    """An arm in a URDF."""

    urdf: Path
    tip: str  # frame
    # Joints between the root and the tip, from the root outwards.
    planned: tuple[ArmJoint, ...]
    locked: Names  # names of all other joints that move: they stay at zero
    moved: Names  # links that planned joints move
    frames: Names  # names of all links and joints
    masses: NamedNumbers  # link -> mass [kg]; 0 where it has none
    # Links that planned joints move with inertias that no body has.
    impossible: Names
    shaped: Names  # links that have a ``<collision>`` element
    meshes: Names  # mesh files that links name
    visual: Names  # links that have a ``<visual>`` and no ``<collision>``
    # Locked joints that do not stay at zero -> position [rad or m].
    locked_positions: NamedNumbers
    doubts: Names  # sentences about numbers that are probably wrong
    friction: tuple[JointFriction, ...]  # friction of planned joints that have any
    joint_notes: Names  # about further elements of planned joints

    @property
    def urdf_dynamics(self) -> str:
        """The key of [drive]: whether the problem uses the friction of the URDF."""
        return suggested_use(self.friction, len(self.planned))

    @property
    def has_shape(self) -> bool:
        """Whether links that move have collision geometry."""
        return bool(set(self.shaped) & set(self.moved))

    def with_visual_shapes(self) -> Arm:
        """Return the arm whose links without ``<collision>`` elements have their visual geometry."""
        return replace(self, shaped=(*self.shaped, *self.visual))


def read_arm(urdf: Path, tip: str | None) -> Arm:
    """Read an arm, whose tip frame is a link or a joint, by default the only link without a child.

    Raises:
        RecipeError: The file cannot be read, needs xacro, or has no joint that moves
            the tip.
        UsageError: The frame does not exist, or several links have no child.
    """
    tree, parameters = _tree_and_parameters(urdf)
    inertias = parameters.inertias
    joints = parameters.joints
    # Without a choice, only an unambiguous end of the robot is the tip.
    tip = tip if tip is not None else _default_tip(urdf, list(inertias), joints)
    if text := missing_frame(tree, urdf, tip):
        raise UsageError(f"--tip: {text}")
    moving = [joint for joint in _path(tip, joints) if joint.kind != "fixed"]
    if not moving:
        text = (
            f"no joint moves the frame {tip!r}; its frames: {listed(frames_of(tree))}"
        )
        raise RecipeError([f"{urdf}: {text}"])
    # The first planned joint moves all links beyond it.
    moved = tuple(link for link in inertias if moving[0] in _path(link, joints))
    names = {joint.name for joint in moving}
    movable = [joint.name for joint in joints.values() if joint.kind != "fixed"]
    shaped = _links_with(tree, "collision")
    drawn = _links_with(tree, "visual")
    return Arm(
        urdf=urdf,
        tip=tip,
        planned=tuple(map(_joint, moving)),
        locked=tuple(name for name in movable if name not in names),
        moved=moved,
        frames=tuple(frames_of(tree)),
        masses={link: body.mass if body else 0.0 for link, body in inertias.items()},
        impossible=tuple(link for link in moved if _is_impossible(inertias[link])),
        shaped=shaped,
        meshes=tuple(mesh.get("filename", "") for mesh in tree.iterfind("link//mesh")),
        visual=tuple(link for link in drawn if link not in shaped),
        locked_positions=_locked_positions(tree, joints.values(), names),
        doubts=_doubts(urdf, tree),
        friction=tuple(friction_in(moving)),
        joint_notes=tuple(joint_notes(tree, moving)),
    )


def _tree_and_parameters(urdf: Path) -> tuple[Element, UrdfParameters]:
    """Read the elements of a URDF, and its inertias and joints; raise RecipeError if that is impossible."""
    try:
        tree = urdf_tree(read_urdf(urdf))
    except ValueError as error:
        raise RecipeError([f"{urdf}: {error}"]) from error
    if text := unread_xacro(tree, urdf):
        raise RecipeError([text])
    with recipe_errors_in(urdf):
        parameters = urdf_parameters(tree)
    if not parameters.inertias:
        raise RecipeError(
            [f"{urdf}: has no <link>, expected a URDF (an SRDF is given by --srdf)"]
        )
    return tree, parameters


def _links_with(tree: Element, tag: str) -> Names:
    """Return the names of the links that have an element."""
    return tuple(
        link.get("name", "")
        for link in tree.findall("link")
        if link.find(tag) is not None
    )


def _doubts(urdf: Path, tree: Element) -> Names:
    try:
        return tuple(doubts(tree))
    except ValueError as error:
        raise RecipeError([f"{urdf}: {error}"]) from error


def _locked_positions(
    tree: Element, joints: Iterable[UrdfJoint], planned: Collection[str]
) -> dict[str, float]:
    """Return the positions of locked joints that cannot stay at zero: the nearest limit.

    Joints that others mimic with an offset are locked at zero by name, so that their
    followers get the offset. Followers are not listed: they follow.
    """
    mimics = {
        joint.get("name", ""): mimic
        for joint in tree.findall("joint")
        if (mimic := joint.find("mimic")) is not None
    }
    offset_of = {
        mimic.get("joint", "")
        for mimic in mimics.values()
        if number_in(mimic, "offset", 0.0)
    }
    positions = {}
    for joint in joints:
        if joint.kind not in {"revolute", "prismatic", "continuous"}:
            continue
        if joint.name in planned or joint.name in mimics:
            continue
        low = joint.limits.get("lower", 0.0)
        high = joint.limits.get("upper", 0.0)
        # Zero, clipped to the limits; continuous joints have none.
        nearest = 0.0 if joint.kind == "continuous" else min(max(0.0, low), high)
        if nearest or joint.name in offset_of:
            positions[joint.name] = nearest
    return positions


def arm_notes(arm: Arm) -> Iterator[str]:
    """Yield a sentence for each finding: planned joints, placeholders of limits, doubtful numbers, and missing elements."""
    yield f"the tip is {arm.tip}; planned joints: {', '.join(joint.name for joint in arm.planned)}"
    placeholders = {
        "position": f"{DEFAULT_RANGE_RAD:.3g} rad or {DEFAULT_RANGE_M:g} m to either side",
        "velocity": f"{DEFAULT_SPEED:g} rad/s or m/s",
        "torque": "the largest torque of random states in motion",
    }
    for limit, placeholder in placeholders.items():
        if joints := [joint.name for joint in arm.planned if limit in joint.missing]:
            reason = (
                ", or the joint is continuous"
                if limit == "position"
                else ", or it is zero"
            )
            text = f"the URDF has no {limit} limit of {', '.join(joints)}{reason}"
            yield f"{text}: [limits] has a placeholder, {placeholder}; enter the value of the data sheet"
    yield from arm.joint_notes
    if arm.friction:
        use = arm.urdf_dynamics
        shares = ", ".join(map(str, arm.friction))
        reason = {"use": "", "ignore": ", since the values look like placeholders"}[use]
        yield f'friction in the URDF: {shares}; [drive] has urdf_dynamics = "{use}"{reason}'
    if light := [
        link for link in arm.moved if link in arm.shaped and not arm.masses.get(link)
    ]:
        yield f"no mass: {', '.join(light)}"
    if arm.impossible:
        text = "a principal inertia is negative or exceeds the sum of the others; torques may be wrong"
        yield f"no body has the <inertia> of {', '.join(arm.impossible)}: {text}"
    yield from arm.doubts
    if unchecked := [link for link in arm.visual if link not in arm.shaped]:
        text = "nothing checks their collisions; --collision-from-visual uses their <visual> elements"
        yield f"links with a <visual> and no <collision> element: {', '.join(unchecked)}: {text}"
    for name, position in arm.locked_positions.items():
        if position:
            yield f"the locked joint {name} is at {position:g}, its limit nearest to zero, as zero is outside of its limits"


def with_torques(arm: Arm, torques: list[float]) -> Arm:
    """Return an arm with torques [N m] in place of missing ones."""
    pairs = zip(arm.planned, torques, strict=True)
    return replace(
        arm,
        planned=tuple(
            replace(each, effort=each.effort or torque) for each, torque in pairs
        ),
    )


def _default_tip(urdf: Path, links: list[str], joints: Mapping[str, UrdfJoint]) -> str:
    """Return the only link without a child; in place of fingers, the link that carries them."""
    parents = {joint.parent for joint in joints.values()}
    ends = [link for link in links if link not in parents]
    leaves = list(dict.fromkeys(_without_fingers(link, joints) for link in ends))
    # An end on the way to another end is no tip of its own.
    inner = {joint.parent for leaf in leaves for joint in _path(leaf, joints)}
    leaves = [leaf for leaf in leaves if leaf not in inner or len(leaves) == 1]
    if len(leaves) != 1:
        leaf_text = (
            f"{len(leaves)} links have no child: {', '.join(leaves)}"
            if leaves
            else "every link has a child"
        )
        raise UsageError(f"--tip must name the tip frame of {urdf.name}: {leaf_text}")
    return leaves[0]


def _without_fingers(link: str, joints: Mapping[str, UrdfJoint]) -> str:
    """Return the nearest link towards the root that is no finger by its name."""
    while _FINGER.search(link.lower()) and link in joints:
        link = joints[link].parent
    return link


def _path(frame: str, joints: Mapping[str, UrdfJoint]) -> list[UrdfJoint]:
    """Return the joints between the root and a frame, from the root outwards."""
    child_of = {joint.name: child for child, joint in joints.items()}
    found = list[UrdfJoint]()
    link = frame if frame in joints else child_of.get(frame, frame)
    while link in joints:
        found.append(joints[link])
        link = joints[link].parent
    return found[::-1]


def _is_impossible(inertia: LinkInertia | None) -> bool:
    """Return whether a principal inertia is negative or exceeds the sum of the others."""
    if inertia is None:
        return False
    # Principal inertias a <= b <= c of a body meet a >= 0 and c <= a + b.
    low, medium, high = np.linalg.eigvalsh(inertia.inertia)
    return bool(
        low < -MAX_INERTIA_ERROR * high
        or high > (1 + MAX_INERTIA_ERROR) * (low + medium)
    )


def _joint(joint: UrdfJoint) -> ArmJoint:
    """Fill in missing limits of a joint; limits of many turns stand for none."""
    lower, upper, velocity, effort = (
        joint.limits.get(key, 0.0) for key in ("lower", "upper", "velocity", "effort")
    )
    endless = joint.kind == "revolute" and max(abs(lower), abs(upper)) > MAX_LIMITED_RAD
    missing = {
        "position": joint.kind == "continuous" or lower == upper or endless,
        "velocity": velocity == 0,
        "torque": effort == 0,
    }
    # Soft limits narrow the range.
    lower = max(lower, joint.soft[0])
    upper = min(upper, joint.soft[1])
    half = DEFAULT_RANGE_M if joint.kind == "prismatic" else DEFAULT_RANGE_RAD
    return ArmJoint(
        name=joint.name,
        kind=joint.kind,
        lower=-half if missing["position"] else lower,
        upper=half if missing["position"] else upper,
        velocity=DEFAULT_SPEED if missing["velocity"] else velocity,
        effort=effort,
        missing=tuple(name for name, is_missing in missing.items() if is_missing),
        jerk=joint.rates.get("jerk", math.inf),
    )
