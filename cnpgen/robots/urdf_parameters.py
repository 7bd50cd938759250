"""Parameters of the links and joints of a URDF, read from its XML without Pinocchio."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np

from cnpgen.errors import RecipeError, nearest
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.hull import Array
from cnpgen.robots.urdf import number_in, numbers_in

_INERTIA_ENTRIES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_PARTS = {  # element -> the elements whose numbers are read
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": ("origin", "axis", "limit", "parent", "child"),
}
_LIMITED = ("revolute", "prismatic")
_TURNING_OR_SLIDING = (*_LIMITED, "continuous")
_ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LinkFrame:
    """Pose of a frame in another one: rotation matrix, shape (3, 3), and origin [m], shape (3,)."""

    rotation: Array
    translation: Array

    def of(self, inner: "LinkFrame") -> "LinkFrame":
        """Return a placement in this frame as a placement in the frame around it."""
        return LinkFrame(self.rotation @ inner.rotation, self.rotation @ inner.translation + self.translation)


IDENTITY = LinkFrame(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class LinkInertia:
    """Inertial parameters of a link.

    Attributes:
        mass: Mass [kg].
        com: LinkFrame of the center of mass and of the axes of the inertia in the link.
        inertia: Inertia about the center of mass [kg m^2], shape (3, 3).
    """

    mass: float
    com: LinkFrame
    inertia: Array


@dataclass(frozen=True)
class UrdfJoint:
    """Joint of a URDF.

    Attributes:
        name: Name of the joint.
        kind: Type of the joint.
        parent: Link that carries the joint.
        child: Link that the joint moves.
        origin: LinkFrame of the child at position zero in the parent.
        axis: Unit axis, shape (3,).
        limits: Limit -> value [rad, rad/s, N m, or with m and N]: "lower", "upper", "velocity" and "effort".
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: LinkFrame
    axis: Array
    limits: dict[str, float]


@dataclass(frozen=True)
class UrdfParameters:
    """Link -> inertial parameters, None for links without them, and child link -> joint of a URDF."""

    inertias: dict[str, LinkInertia | None]
    joints: dict[str, UrdfJoint]


def urdf_parameters(tree: Element) -> UrdfParameters:
    """Read the numbers of all links and joints; RecipeError lists missing ones and those not plain finite decimals."""
    mistakes: list[str] = []
    inertias: dict[str, LinkInertia | None] = {}
    joints: dict[str, UrdfJoint] = {}
    for link in tree.findall("link"):
        _read_named(link, lambda link: inertias.update({link.get("name", ""): _inertia(link)}), mistakes)
    for element in tree.findall("joint"):
        _read_named(element, lambda element: joints.update({(joint := _joint(element)).child: joint}), mistakes)
    mistakes += [f"link {link!r}: its joints form a cycle" for link in _links_in_cycles(joints)]
    if mistakes:
        raise RecipeError(mistakes)
    return UrdfParameters(inertias, joints)


def _links_in_cycles(joints: Mapping[str, UrdfJoint]) -> list[str]:
    """List a link of every cycle of joints; the parser ignores cycles that no root moves."""
    rooted, found = set[str](), list[str]()
    for first in joints:
        link, path = first, set[str]()
        while link in joints and link not in rooted and link not in path:
            path.add(link)
            link = joints[link].parent
        if link in path:
            found.append(link)
        rooted |= path
    return found


def _read_named(element: Element, read: Callable[[Element], None], mistakes: list[str]) -> None:
    """Read an element; add its error to the mistakes, with the name of the element."""
    problems = list(_unread(element))
    try:
        if not problems:
            read(element)
    except ValueError as error:
        problems.append(str(error))
    mistakes += [f"{element.tag} {element.get('name', '')!r}: {problem}" for problem in problems]


def _unread(element: Element) -> Iterator[str]:
    """Yield error messages for elements that a parser ignores: repeated or misspelled ones."""
    parts = _PARTS.get(element.tag, ())
    for tag in parts:
        if (count := len(element.findall(tag))) > 1:
            yield f"it has {count} elements <{tag}>, expected one"
    for child in element:
        if child.tag not in parts and child.tag.lower() in parts:
            yield f"<{child.tag}> is not an element of a URDF{nearest(child.tag, parts)}"
        if child.tag in parts:
            yield from _unread(child)


def _inertia(link: Element) -> LinkInertia | None:
    element = link.find("inertial")
    if element is None:
        return None
    mass, tensor = element.find("mass"), element.find("inertia")
    if mass is None or mass.get("value") is None:
        raise ValueError("its <inertial> has no <mass value=...>")
    if tensor is not None and (missing := [name for name in _INERTIA_ENTRIES if tensor.get(name) is None]):
        raise ValueError(f"its <inertia> has no {', '.join(missing)}: all of its numbers would be ignored")
    rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    matrix = np.array([[number_in(tensor, name, 0.0) for name in row] for row in rows])
    if (value := number_in(mass, "value", 0.0)) < 0:
        raise ValueError(f"<mass value={mass.get('value')!r}> must not be negative: give the mass of the link in kg")
    return LinkInertia(value, placement_of(element), matrix)


def _joint(element: Element) -> UrdfJoint:
    limit, kind = element.find("limit"), element.get("type", "")
    keys = ("velocity", "effort") if kind == "continuous" else ("lower", "upper", "velocity", "effort")
    limits = {} if limit is None else {key: number_in(limit, key, 0.0) for key in keys}
    for key in ("velocity", "effort"):
        if kind in _TURNING_OR_SLIDING and limits.get(key, 0.0) < 0:
            raise ValueError(f"{key}={limits[key]:g} must not be negative")
    ends = {tag: found.get("link", "") for tag in ("parent", "child") if (found := element.find(tag)) is not None}
    axis = np.array(numbers_in(element.find("axis"), "xyz", (1.0, 0.0, 0.0)))
    length = float(np.linalg.norm(axis))
    if kind in _TURNING_OR_SLIDING and not math.isfinite(1 / length if length else math.inf):
        raise ValueError(f"<axis xyz={element.find('axis').get('xyz')!r}> has no direction")  # type: ignore[union-attr]
    return UrdfJoint(
        name=element.get("name", ""),
        kind=kind,
        parent=ends.get("parent", ""),
        child=ends.get("child", ""),
        origin=placement_of(element),
        axis=axis / (length or 1.0),
        limits=limits if kind in _TURNING_OR_SLIDING else {},
    )


def placement_of(element: Element) -> LinkFrame:
    """Return the <origin> of an element."""
    origin = element.find("origin")
    if origin is not None and origin.get("quat_xyzw") is not None:
        raise ValueError("<origin quat_xyzw=...> is not supported: give rpy, the angles of roll, pitch and yaw")
    return LinkFrame(turned(*numbers_in(origin, "rpy", _ZERO)), np.array(numbers_in(origin, "xyz", _ZERO)))
