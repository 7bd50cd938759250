"""Parameters of a URDF, read from its XML, and their comparison with Pinocchio, whose parser drops elements."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import RecipeError, nearest
from cnpgen.robots.chain import LINK_SUFFIX
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.urdf import number_in, numbers_in

if TYPE_CHECKING:
    import pinocchio as pin

_INERTIA_ENTRIES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_PARTS = {  # element -> the elements whose numbers are read
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": (
        *("origin", "axis", "limit", "parent", "child"),
        *("dynamics", "safety_controller"),
    ),
}
LIMITED = ("revolute", "prismatic")  # joints that need a <limit>
_TURNING_OR_SLIDING = (*LIMITED, "continuous")
NO_SOFT_LIMITS = (-math.inf, math.inf)
_ZERO = (0.0, 0.0, 0.0)
MAX_RELATIVE_DIFFERENCE = 1e-9  # of values from two parsers, which round differently
WORLD = 0  # index of Pinocchio's joint of the root link


@dataclass(frozen=True)
class LinkFrame:
    """Pose of a frame in another one: rotation matrix, shape (3, 3), and origin [m], shape (3,)."""

    rotation: Array
    translation: Array

    def of(self, inner: "LinkFrame") -> "LinkFrame":
        """Return a placement in this frame as a placement in the frame around it."""
        return LinkFrame(
            self.rotation @ inner.rotation,
            self.rotation @ inner.translation + self.translation,
        )


IDENTITY = LinkFrame(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class LinkInertia:
    """Mass of a link [kg], frame of its center of mass, and inertia about it in this frame [kg m^2], shape (3, 3)."""

    mass: float
    com: LinkFrame
    inertia: Array


@dataclass(frozen=True)
class UrdfJoint:
    """Joint of a URDF, which moves the link ``child`` on the link ``parent``.

    Attributes:
        origin: LinkFrame of the child at position zero in the parent.
        axis: Unit axis, shape (3,).
        limits: Limit -> value [rad, rad/s, N m, or with m and N]: "lower", "upper",
            "velocity" and "effort".
        rates: Limits of URDF 1.2: "acceleration" [rad/s^2], the smaller one if
            "deceleration" is given, too, and "jerk" [rad/s^3]; without those that are
            absent or zero.
        damping: Viscous friction [N m s/rad].
        friction: Dry friction [N m].
        soft: Lower and upper soft limits of the position [rad]; infinite for none.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: LinkFrame
    axis: Array
    limits: dict[str, float]
    rates: dict[str, float]
    damping: float
    friction: float
    soft: tuple[float, float]


@dataclass(frozen=True)
class UrdfParameters:
    """Link -> inertial parameters, None for links without them, and child link -> joint of a URDF."""

    inertias: dict[str, LinkInertia | None]
    joints: dict[str, UrdfJoint]


def urdf_parameters(tree: Element) -> UrdfParameters:
    """Read the numbers of all links and joints.

    RecipeError lists missing ones and those not plain finite decimals.
    """
    errors: list[str] = []
    inertias: dict[str, LinkInertia | None] = {}
    joints: dict[str, UrdfJoint] = {}
    for link in tree.findall("link"):
        _read_named(
            link,
            lambda link: inertias.update({link.get("name", ""): _inertia(link)}),
            errors,
        )
    for element in tree.findall("joint"):
        _read_named(
            element,
            lambda element: joints.update({(joint := _joint(element)).child: joint}),
            errors,
        )
    errors += [
        f"link {link!r}: its joints form a cycle" for link in _links_in_cycles(joints)
    ]
    if errors:
        raise RecipeError(errors)
    return UrdfParameters(inertias, joints)


def _links_in_cycles(joints: Mapping[str, UrdfJoint]) -> list[str]:
    """List a link of every cycle of joints.

    The parser ignores cycles that no root moves.
    """
    rooted = set[str]()
    found = list[str]()
    for first in joints:
        link = first
        path = set[str]()
        while link in joints and link not in rooted and link not in path:
            path.add(link)
            link = joints[link].parent
        if link in path:
            found.append(link)
        # All links of the path lead to a root, or to a cycle that is listed.
        rooted |= path
    return found


def _read_named(
    element: Element, read: Callable[[Element], None], errors: list[str]
) -> None:
    """Read an element; add its error to the errors, with the name of the element."""
    problems = list(_unread(element))
    try:
        if not problems:
            read(element)
    except ValueError as error:
        problems.append(str(error))
    errors += [
        f"{element.tag} {element.get('name', '')!r}: {problem}" for problem in problems
    ]


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
    mass = element.find("mass")
    tensor = element.find("inertia")
    if mass is None or mass.get("value") is None:
        raise ValueError("its <inertial> has no <mass value=...>")
    if tensor is not None and (
        missing := [name for name in _INERTIA_ENTRIES if tensor.get(name) is None]
    ):
        raise ValueError(
            f"its <inertia> has no {', '.join(missing)}: all of its numbers would be ignored"
        )
    rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    matrix = np.array([[number_in(tensor, name, 0.0) for name in row] for row in rows])
    if (value := number_in(mass, "value", 0.0)) < 0:
        raise ValueError(
            f"<mass value={mass.get('value')!r}> must not be negative: give the mass of the link in kg"
        )
    return LinkInertia(value, placement_of(element), matrix)


def _joint(element: Element) -> UrdfJoint:
    limit = element.find("limit")
    kind = element.get("type", "")
    movable = kind in _TURNING_OR_SLIDING
    keys = (
        ("velocity", "effort")
        if kind == "continuous"
        else ("lower", "upper", "velocity", "effort")
    )
    limits = {} if limit is None else {key: number_in(limit, key, 0.0) for key in keys}
    for key in ("velocity", "effort"):
        if movable and limits.get(key, 0.0) < 0:
            raise ValueError(f"{key}={limits[key]:g} must not be negative")
    damping, friction = _dynamics(element)
    ends = {
        tag: found.get("link", "")
        for tag in ("parent", "child")
        if (found := element.find(tag)) is not None
    }
    axis = np.array(numbers_in(element.find("axis"), "xyz", (1.0, 0.0, 0.0)))
    length = float(np.linalg.norm(axis))
    # An axis of length 0, or of an infinite inverse length, cannot be normalized.
    if movable and not math.isfinite(1 / length if length else math.inf):
        written = element.find("axis")
        text = None if written is None else written.get("xyz")
        raise ValueError(f"<axis xyz={text!r}> has no direction")
    return UrdfJoint(
        name=element.get("name", ""),
        kind=kind,
        parent=ends.get("parent", ""),
        child=ends.get("child", ""),
        origin=placement_of(element),
        axis=axis / (length or 1.0),
        limits=limits if movable else {},
        rates=_rates(limit) if movable else {},
        damping=damping if movable else 0.0,
        friction=friction if movable else 0.0,
        soft=_soft_limits(element) if kind in LIMITED else NO_SOFT_LIMITS,
    )


def _rates(limit: Element | None) -> dict[str, float]:
    """Read the limits of acceleration and jerk of URDF 1.2; a zero is none."""
    keys = ("acceleration", "deceleration", "jerk")
    given = {key: number_in(limit, key, 0.0) for key in keys}
    for key, value in given.items():
        if value < 0:
            raise ValueError(f"{key}={value:g} must not be negative")
    # The planned limit holds in both directions, so the smaller one counts.
    symmetric = [value for key in keys[:2] if (value := given[key])]
    rates = {"acceleration": min(symmetric, default=0.0), "jerk": given["jerk"]}
    return {key: value for key, value in rates.items() if value}


def _dynamics(joint: Element) -> tuple[float, float]:
    """Read damping and friction of a joint."""
    element = joint.find("dynamics")
    values = {key: number_in(element, key, 0.0) for key in ("damping", "friction")}
    for key, value in values.items():
        if value < 0:
            raise ValueError(f"<dynamics {key}={value:g}> must not be negative")
    return values["damping"], values["friction"]


def _soft_limits(joint: Element) -> tuple[float, float]:
    """Read the soft limits of a joint; an absent attribute, or zero for both, is none."""
    element = joint.find("safety_controller")
    if element is None:
        return NO_SOFT_LIMITS
    keys = ("soft_lower_limit", "soft_upper_limit")
    low, high = (
        number_in(element, key, none)
        for key, none in zip(keys, NO_SOFT_LIMITS, strict=True)
    )
    if low > high:
        raise ValueError(
            f"its soft limits {low:g} and {high:g} are swapped: exchange them"
        )
    return NO_SOFT_LIMITS if low == high == 0 else (low, high)


def placement_of(element: Element) -> LinkFrame:
    """Return the <origin> of an element."""
    origin = element.find("origin")
    if origin is not None and origin.get("quat_xyzw") is not None:
        raise ValueError(
            "<origin quat_xyzw=...> is not supported: give rpy, the angles of roll, pitch and yaw"
        )
    return LinkFrame(
        turned(*numbers_in(origin, "rpy", _ZERO)),
        np.array(numbers_in(origin, "xyz", _ZERO)),
    )


def check_model(model: "pin.Model", parameters: UrdfParameters) -> None:
    """Raise an error that lists how a model, all joints of a URDF or some with others at zero, differs from its XML."""
    if errors := list(_Comparison(model, parameters).errors()):
        raise RecipeError(errors)


class _Comparison:
    """Comparison of one model with the parameters of its URDF."""

    def __init__(self, model: "pin.Model", parameters: UrdfParameters) -> None:
        self.model = model
        self.parameters = parameters
        self.joints = {
            name: index for index, name in enumerate(model.names) if index != WORLD
        }
        # Link -> joint that moves it, and its placement in that.
        self.bodies: dict[str, tuple[int, LinkFrame]] = {}
        for link in parameters.inertias:
            self.bodies[link] = self._body(link)

    def _body(self, link: str) -> tuple[int, LinkFrame]:
        """Follow fixed joints from a link towards the root until a joint of the model or a known link."""
        inner = IDENTITY
        while link in self.parameters.joints:
            if link in self.bodies:
                index, outer = self.bodies[link]
                return index, outer.of(inner)
            joint = self.parameters.joints[link]
            if joint.name in self.joints:
                return self.joints[joint.name], inner
            inner = joint.origin.of(inner)
            link = joint.parent
        return WORLD, inner

    def errors(self) -> Iterator[str]:
        """Yield an error message for every difference."""
        for joint in self.parameters.joints.values():
            if joint.name in self.joints:
                yield from self._of_joint(joint)
        for index in self.joints.values():
            yield from self._of_inertia(index)
        yield from self._of_frames()

    def _of_joint(self, joint: UrdfJoint) -> Iterator[str]:
        """Compare placement, axis and limits of a joint."""
        model = self.model
        index = self.joints[joint.name]
        parent, placement = self.bodies.get(joint.parent, (WORLD, IDENTITY))
        actual = model.jointPlacements[index]
        if model.parents[index] != parent or not _same_placement(
            actual, placement.of(joint.origin)
        ):
            yield _difference(f"joint {joint.name!r}", "its <origin> or parent")
        if not joint.limits:
            # Of a joint that neither turns nor slides, or without a <limit>.
            return
        # (linear, angular)
        subspace = np.asarray(model.createData().joints[index].S, float).ravel()
        axis = subspace[:3] if joint.kind == "prismatic" else subspace[3:]
        if not _same(axis, joint.axis):
            yield _difference(f"joint {joint.name!r}", "its <axis>", axis, joint.axis)
        q = model.idx_qs[index]
        v = model.idx_vs[index]
        limits = {
            "lower": model.lowerPositionLimit[q],
            "upper": model.upperPositionLimit[q],
            "velocity": model.velocityLimit[v],
            "effort": model.effortLimit[v],
        }
        for name, value in joint.limits.items():
            if not _same(limits[name], value):
                yield _difference(
                    f"joint {joint.name!r}", f"its limit {name!r}", limits[name], value
                )
        friction = {
            "damping": (model.damping[v], joint.damping),
            "friction": (model.upperDryFrictionLimit[v], joint.friction),
        }
        for name, (found, value) in friction.items():
            if not _same(found, value):
                yield _difference(f"joint {joint.name!r}", f"its {name}", found, value)

    def _of_inertia(self, index: int) -> Iterator[str]:
        """Compare the body that a joint moves with the links of which it consists."""
        links = [link for link, (joint, _) in self.bodies.items() if joint == index]
        values = [
            _dynamic_parameters(inertia, self.bodies[link][1])
            for link in links
            if (inertia := self.parameters.inertias[link]) is not None
        ]
        expected = np.sum(values, axis=0) if values else np.zeros(10)
        # Rounding errors grow with the terms of the sum, which may cancel in the sum
        # itself.
        scale = np.abs(values).sum(axis=0) if values else np.zeros(10)
        actual = self.model.inertias[index]
        lever = np.asarray(actual.lever)
        found = _parameters_about_origin(actual.mass, lever, np.asarray(actual.inertia))
        for name, part in (
            ("mass", slice(0, 1)),
            ("center of mass", slice(1, 4)),
            ("inertia", slice(4, 10)),
        ):
            if not _same(found[part], expected[part], scale=scale[part].max()):
                subject = f"the body of joint {self.model.names[index]!r}, of the links {', '.join(map(repr, links))}"
                yield _difference(subject, f"its {name}", found[part], expected[part])

    def _of_frames(self) -> Iterator[str]:
        """Compare the placements of the links."""
        import pinocchio as pin

        frames = {
            frame.name: frame
            for frame in self.model.frames
            if frame.type == pin.FrameType.BODY
        }
        for link, (joint, placement) in self.bodies.items():
            # Links with the name of a joint have a suffix; see ``name_links_uniquely``.
            frame = frames.get(link + LINK_SUFFIX) or frames.get(link)
            if (
                frame is None
                or frame.parentJoint != joint
                or not _same_placement(frame.placement, placement)
            ):
                yield _difference(f"link {link!r}", "its placement")


def _dynamic_parameters(inertia: LinkInertia, link: LinkFrame) -> Array:
    """Return the parameters of a link about the origin of the joint that moves it, shape (10,)."""
    com = link.of(inertia.com)
    return _parameters_about_origin(
        inertia.mass, com.translation, com.rotation @ inertia.inertia @ com.rotation.T
    )


def _parameters_about_origin(mass: float, com: Array, inertia: Array) -> Array:
    """Return mass, mass times center and inertia about the origin, which add up, shape (10,)."""
    # Overflow is a difference.
    with np.errstate(all="ignore"):
        # Parallel axes: I_o = I_c + m (c.c E - c c^T), with the center of mass c.
        about_origin = inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))
        return np.array([mass, *(mass * com), *about_origin[np.triu_indices(3)]])


def _same_placement(actual: "pin.SE3", expected: LinkFrame) -> bool:
    # Entries of a rotation are at most 1; translations below 1 mm count as 1 mm.
    return _same(actual.rotation, expected.rotation, scale=1.0) and _same(
        actual.translation,
        expected.translation,
        scale=max(np.abs(expected.translation).max(), 1e-3),
    )


def _same(actual: object, expected: object, *, scale: float | None = None) -> bool:
    """Return whether values are equal up to rounding.

    Values that are not finite never are.
    """
    found = np.asarray(actual, float)
    wanted = np.asarray(expected, float)
    size = np.abs(wanted).max() if scale is None else scale
    with np.errstate(all="ignore"):
        close = np.abs(found - wanted) <= MAX_RELATIVE_DIFFERENCE * size
    return bool((close & np.isfinite(found) & np.isfinite(wanted)).all())


def _difference(
    subject: str, part: str, actual: object = None, expected: object = None
) -> str:
    text = f"{subject}: Pinocchio reads {part} differently from the XML"
    if expected is None:
        return text
    values = (
        np.array2string(np.asarray(item), precision=4) for item in (expected, actual)
    )
    return "{}: {} in the XML, {} in the model".format(text, *values)
