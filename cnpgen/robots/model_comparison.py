"""Comparison of a Pinocchio model with the XML of its URDF: urdfdom drops elements that it cannot read, silently."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.robots.chain import LINK_SUFFIX
from cnpgen.robots.shape.hull import Array
from cnpgen.robots.urdf_parameters import IDENTITY, LinkFrame, LinkInertia, UrdfJoint, UrdfParameters

if TYPE_CHECKING:
    import pinocchio as pin


MAX_RELATIVE_DIFFERENCE = 1e-9  # of values from two parsers, which round differently
WORLD = 0  # index of Pinocchio's joint of the root link


def check_model(model: "pin.Model", parameters: UrdfParameters) -> None:
    """Raise an error that lists how a model, all joints of a URDF or some with others at zero, differs from its XML."""
    if mistakes := list(_Comparison(model, parameters).mistakes()):
        raise RecipeError(mistakes)


class _Comparison:
    """Comparison of one model with the parameters of its URDF."""

    def __init__(self, model: "pin.Model", parameters: UrdfParameters) -> None:
        self.model, self.parameters = model, parameters
        self.joints = {name: index for index, name in enumerate(model.names) if index != WORLD}
        self.bodies: dict[str, tuple[int, LinkFrame]] = {}  # link -> joint that moves it, and its placement in that
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
            inner, link = joint.origin.of(inner), joint.parent
        return WORLD, inner

    def mistakes(self) -> Iterator[str]:
        """Yield an error message for every difference."""
        for joint in self.parameters.joints.values():
            if joint.name in self.joints:
                yield from self._of_joint(joint)
        for index in self.joints.values():
            yield from self._of_inertia(index)
        yield from self._of_frames()

    def _of_joint(self, joint: UrdfJoint) -> Iterator[str]:
        """Compare placement, axis and limits of a joint."""
        model, index = self.model, self.joints[joint.name]
        parent, placement = self.bodies.get(joint.parent, (WORLD, IDENTITY))
        actual = model.jointPlacements[index]
        if model.parents[index] != parent or not _same_placement(actual, placement.of(joint.origin)):
            yield _difference(f"joint {joint.name!r}", "its <origin> or parent")
        if not joint.limits:  # of a joint that neither turns nor slides, or without a <limit>
            return
        subspace = np.asarray(model.createData().joints[index].S, float).ravel()  # (linear, angular)
        axis = subspace[:3] if joint.kind == "prismatic" else subspace[3:]
        if not _same(axis, joint.axis):
            yield _difference(f"joint {joint.name!r}", "its <axis>", axis, joint.axis)
        q, v = model.idx_qs[index], model.idx_vs[index]
        limits = {
            "lower": model.lowerPositionLimit[q],
            "upper": model.upperPositionLimit[q],
            "velocity": model.velocityLimit[v],
            "effort": model.effortLimit[v],
        }
        for name, value in joint.limits.items():
            if not _same(limits[name], value):
                yield _difference(f"joint {joint.name!r}", f"its limit {name!r}", limits[name], value)

    def _of_inertia(self, index: int) -> Iterator[str]:
        """Compare the body that a joint moves with the links of which it consists."""
        links = [link for link, (joint, _) in self.bodies.items() if joint == index]
        values = [
            _dynamic_parameters(inertia, self.bodies[link][1])
            for link in links
            if (inertia := self.parameters.inertias[link]) is not None
        ]
        expected = np.sum(values, axis=0) if values else np.zeros(10)
        scale = np.abs(values).sum(axis=0) if values else np.zeros(10)
        actual = self.model.inertias[index]
        lever = np.asarray(actual.lever)
        found = _parameters_about_origin(actual.mass, lever, np.asarray(actual.inertia))
        for name, part in (("mass", slice(0, 1)), ("center of mass", slice(1, 4)), ("inertia", slice(4, 10))):
            if not _same(found[part], expected[part], scale=scale[part].max()):
                subject = f"the body of joint {self.model.names[index]!r}, of the links {', '.join(map(repr, links))}"
                yield _difference(subject, f"its {name}", found[part], expected[part])

    def _of_frames(self) -> Iterator[str]:
        """Compare the placements of the links."""
        import pinocchio as pin

        frames = {frame.name: frame for frame in self.model.frames if frame.type == pin.FrameType.BODY}
        for link, (joint, placement) in self.bodies.items():
            frame = frames.get(link + LINK_SUFFIX) or frames.get(link)
            if frame is None or frame.parentJoint != joint or not _same_placement(frame.placement, placement):
                yield _difference(f"link {link!r}", "its placement")


def _dynamic_parameters(inertia: LinkInertia, link: LinkFrame) -> Array:
    """Return the parameters of a link about the origin of the joint that moves it, shape (10,)."""
    com = link.of(inertia.com)
    return _parameters_about_origin(inertia.mass, com.translation, com.rotation @ inertia.inertia @ com.rotation.T)


def _parameters_about_origin(mass: float, com: Array, inertia: Array) -> Array:
    """Return mass, mass times center and inertia about the origin, which add up, shape (10,)."""
    with np.errstate(all="ignore"):  # overflow is a difference
        about_origin = inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))
        return np.array([mass, *(mass * com), *about_origin[np.triu_indices(3)]])


def _same_placement(actual: "pin.SE3", expected: LinkFrame) -> bool:
    return _same(actual.rotation, expected.rotation, scale=1.0) and _same(
        actual.translation, expected.translation, scale=max(np.abs(expected.translation).max(), 1e-3)
    )


def _same(actual: object, expected: object, *, scale: float | None = None) -> bool:
    """Return whether values are equal up to rounding; values that are not finite never are."""
    found, wanted = np.asarray(actual, float), np.asarray(expected, float)
    size = np.abs(wanted).max() if scale is None else scale
    with np.errstate(all="ignore"):
        close = np.abs(found - wanted) <= MAX_RELATIVE_DIFFERENCE * size
    return bool((close & np.isfinite(found) & np.isfinite(wanted)).all())


def _difference(subject: str, part: str, actual: object = None, expected: object = None) -> str:
    text = f"{subject}: Pinocchio reads {part} differently from the XML"
    if expected is None:
        return text
    values = (np.array2string(np.asarray(item), precision=4) for item in (expected, actual))
    return "{}: {} in the XML, {} in the model".format(text, *values)
