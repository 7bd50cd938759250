"""Parameters of a serial chain: joint placements, axes and inertias of a reduced Pinocchio model."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import RecipeError

if TYPE_CHECKING:
    import pinocchio as pin


SNAP_TOLERANCE = 1e-12  # maximum deviation of entries that are rounded to -1, 0 or 1
LINK_SUFFIX = " (link)"  # suffix of links with the name of a joint
_PLANNED = "only revolute and prismatic joints can be planned"
_KINDS = {  # Pinocchio's name of a joint type -> URDF's name
    "JointModelRUB": "a continuous joint, which has no limits (give ranges to all joints: 'position' in [limits])",
    "JointModelFreeFlyer": "a floating joint",
    "JointModelPlanar": "a planar joint",
    "JointModelSpherical": "a spherical joint",
}


@dataclass(frozen=True)
class Joint:
    """Planned joint and the rigid body that it moves.

    Attributes:
        rotation: Rotation of the joint frame in the previous joint frame at q = 0,
            shape (3, 3).
        translation: Origin of the joint frame in the previous one [m], shape (3,).
        axis: Unit axis in the joint frame, shape (3,).
        prismatic: Whether q is a displacement [m] and not an angle [rad].
        mass: Mass of the body with all fixed parts [kg].
        com: Center of mass in the joint frame [m], shape (3,).
        inertia: Inertia about the center of mass, joint axes [kg m^2], shape (3, 3).
    """

    rotation: Array
    translation: Array
    axis: Array
    prismatic: bool
    mass: float
    com: Array
    inertia: Array


@dataclass(frozen=True)
class Chain:
    """Serial chain from the world to a tip frame.

    Attributes:
        joints: The planned joints, from the base outwards.
        tip_rotation: Rotation of the tip frame in the last joint frame, shape (3, 3).
        tip_translation: Origin of the tip frame in the last joint frame [m], shape
            (3,).
        gravity: Gravity in the world frame [m/s^2], shape (3,).
    """

    joints: tuple[Joint, ...]
    tip_rotation: Array
    tip_translation: Array
    gravity: Array

    @property
    def reach(self) -> float:
        """Upper bound of the distance of the tip from the first joint's origin [m].

        Infinite with prismatic joints.
        """
        # A prismatic joint lengthens the chain by its position, which is not bounded
        # here.
        if any(joint.prismatic for joint in self.joints):
            return np.inf
        # Links can be stretched at most to the sum of their lengths.
        lengths = [
            float(np.linalg.norm(joint.translation)) for joint in self.joints[1:]
        ]
        return sum(lengths) + float(np.linalg.norm(self.tip_translation))


def chain_from_model(model: "pin.Model", tip: str) -> Chain:
    """Read the chain that ends in a tip frame.

    RecipeError if the model is not one serial chain that carries it.
    """
    data = model.createData()
    for index in range(1, model.njoints):
        name = model.names[index]
        joint = model.joints[index]
        if joint.nq != 1 or joint.nv != 1:
            raise RecipeError(
                [f"robot.joints: {name!r} is {_kind(joint.shortname())}: {_PLANNED}"]
            )
        # In one serial chain every joint moves the next one; the parent of joint 1 is
        # the world, 0.
        if model.parents[index] != index - 1:
            before = model.names[index - 1]
            raise RecipeError(
                [
                    f"robot.joints: {name!r} is not moved by {before!r}, expected one serial chain"
                ]
            )
    frame = model.frames[frame_of(model, tip)]
    if frame.parentJoint != model.njoints - 1:
        raise RecipeError(
            [
                f"robot.tip: frame {tip!r} is not moved by the last planned joint {model.names[-1]!r}"
            ]
        )
    joints = tuple(_joint(model, data, index) for index in range(1, model.njoints))
    return Chain(
        joints,
        _snap(frame.placement.rotation),
        _snap(frame.placement.translation),
        np.array(model.gravity.linear),
    )


def name_links_uniquely(model: "pin.Model") -> None:
    """Rename link frames with the name of a joint, since Pinocchio finds frames by name."""
    import pinocchio as pin

    joints = {frame.name for frame in model.frames if frame.type != pin.FrameType.BODY}
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY and frame.name in joints:
            frame.name += LINK_SUFFIX


def frame_of(model: "pin.Model", name: str) -> int:
    """Return the index of a frame.

    A link has priority over a joint of the same name.
    """
    return int(
        model.getFrameId(
            name + LINK_SUFFIX if model.existFrame(name + LINK_SUFFIX) else name
        )
    )


def _kind(name: str) -> str:
    """Return the URDF name of a joint's Pinocchio type."""
    return next(
        (text for start, text in _KINDS.items() if name.startswith(start)),
        "a joint of another kind",
    )


def _joint(model: "pin.Model", data: "pin.Data", index: int) -> Joint:
    placement = model.jointPlacements[index]
    inertia = model.inertias[index]
    # The angular part of the motion subspace is zero for a joint that slides.
    subspace = np.asarray(data.joints[index].S, float).ravel()  # (linear, angular)
    prismatic = bool(np.abs(subspace[3:]).max() < 0.5)
    return Joint(
        rotation=_snap(placement.rotation),
        translation=_snap(placement.translation),
        axis=_snap(subspace[:3] if prismatic else subspace[3:]),
        prismatic=prismatic,
        mass=float(inertia.mass),
        com=np.array(inertia.lever),
        inertia=np.array(inertia.inertia),
    )


def _snap(values: Array) -> Array:
    """Round entries close to -1, 0 or 1, so that a URDF's pi/2 adds no operations to kernels."""
    values = np.array(values, float)
    nearest = np.rint(values)
    close = (np.abs(values - nearest) < SNAP_TOLERANCE) & (np.abs(nearest) <= 1)
    values[close] = nearest[close]
    return values
