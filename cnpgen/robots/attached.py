"""Attachments of a problem to the robot of a URDF: tool offset, payload, joint ranges."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError, listed, nearest
from cnpgen.robots.chain import frame_of

if TYPE_CHECKING:
    import pinocchio as pin

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PayloadBody:
    """Rigid body of the payload: mass [kg], center of mass [m] and inertia about it [kg m^2] along the tip frame."""

    mass: float
    com: Array
    inertia: Array


@dataclass(frozen=True)
class Attached:
    """Attachments to the robot of a URDF.

    Attributes:
        frame: URDF frame to which the tip frame is fixed.
        rotation: Rotation of the tip frame in it, shape (3, 3).
        translation: Origin of the tip frame in it [m], shape (3,).
        payload: Body carried at the tip frame, or None.
        ranges: Planned joint -> position limits [rad] that replace those of the URDF.
    """

    frame: str
    rotation: Array = field(default_factory=lambda: np.eye(3))
    translation: Array = field(default_factory=lambda: np.zeros(3))
    payload: PayloadBody | None = None
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def tip(self) -> str:
        """Name of the tip frame: the URDF's own, or that of a new one."""
        moved = not np.array_equal(self.rotation, np.eye(3)) or self.translation.any()
        return f"{self.frame} with offset" if moved else self.frame


def attach(model: "pin.Model", attached: Attached) -> None:
    """Add the attachments of a problem to a reduced model.

    Raises:
        RecipeError: The model has no such frame.
    """
    import pinocchio as pin

    if not model.existFrame(attached.frame):
        known = [frame.name for frame in model.frames]
        text = f"{model.name} has no frame {attached.frame!r}{nearest(attached.frame, known)}"
        raise RecipeError([f"robot.tip: {text}; its frames: {listed(known)}"])
    index = frame_of(model, attached.frame)
    frame = model.frames[index]
    placement = frame.placement * pin.SE3(attached.rotation, attached.translation)
    if attached.tip != attached.frame:
        model.addFrame(pin.Frame(attached.tip, frame.parentJoint, index, placement, pin.FrameType.OP_FRAME), False)
    if body := attached.payload:
        model.appendBodyToJoint(frame.parentJoint, pin.Inertia(body.mass, body.com, body.inertia), placement)
    for name, (low, high) in attached.ranges.items():
        place = model.idx_qs[model.getJointId(name)]
        model.lowerPositionLimit[place], model.upperPositionLimit[place] = low, high


def bounded(urdf: str, tree: ElementTree.Element, attached: Attached) -> str:
    """Return a URDF in which continuous joints with a given range are revolute; the tree is modified in place."""
    turning = [joint for joint in tree.iter("joint") if joint.get("type") == "continuous"]
    given = [joint for joint in turning if joint.get("name") in attached.ranges]
    for joint in given:
        joint.set("type", "revolute")
        limit = joint.find("limit")
        if limit is None:
            limit = ElementTree.SubElement(joint, "limit", velocity="0", effort="0")
        limit.attrib.update(lower="0", upper="0")
    return ElementTree.tostring(tree, encoding="unicode") if given else urdf
