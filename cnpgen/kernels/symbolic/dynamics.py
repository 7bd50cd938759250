"""Dynamics of a chain as CasADi SX: recursive Newton-Euler in the frames of its joints."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from cnpgen.kernels.symbolic.kinematics import joint_rotation
from cnpgen.kernels.symbolic.linalg import (
    Scalar,
    Vec,
    add,
    constants,
    cross,
    dot,
    product,
    rows_of,
    scale,
    times,
    transposed_times,
)
from cnpgen.robots.chain import Chain
from cnpgen.robots.robot_spec import Payload


@dataclass(frozen=True)
class BodyMotion:
    """Motion of the body of a joint, in the joint's frame.

    Attributes:
        rotation: Rotation from the joint's frame to the previous one, 3 rows of 3.
        offset: Origin of the joint's frame in the previous one [m].
        omega: Angular velocity [rad/s].
        alpha: Angular acceleration [rad/s^2].
        acceleration: Acceleration of the origin minus gravity [m/s^2].
    """

    rotation: list[Vec]
    offset: Vec
    omega: Vec
    alpha: Vec
    acceleration: Vec


def body_motions(chain: Chain, q: Vec, dq: Vec, ddq: Vec) -> list[BodyMotion]:
    """Return the motion of every body by the outward recursion of Newton-Euler.

    See ``inverse_dynamics``.
    """
    omega: Vec = [0.0, 0.0, 0.0]
    alpha: Vec = [0.0, 0.0, 0.0]
    # A base that accelerates against gravity replaces the weight of every body.
    acceleration: Vec = constants(-chain.gravity)
    motions = []
    for joint, angle, rate, rate2 in zip(chain.joints, q, dq, ddq, strict=True):
        rotation = product(rows_of(joint.rotation), joint_rotation(joint, angle))
        offset = constants(joint.translation)
        if joint.prismatic:
            offset = add(offset, scale(constants(joint.rotation @ joint.axis), angle))
        acceleration = acceleration_at(acceleration, omega, alpha, offset)
        acceleration, omega, alpha = (
            transposed_times(rotation, x) for x in (acceleration, omega, alpha)
        )
        # With z the joint's axis and w the angular velocity of the previous link, a
        # revolute joint has
        #   w_i = w + z dq,   alpha_i = alpha + w x z dq + z ddq.
        axis = constants(joint.axis)
        if joint.prismatic:
            # The axis turns with the link: 2 w x v is the Coriolis acceleration of a
            # sliding joint.
            coriolis = scale(cross(omega, scale(axis, rate)), 2.0)
            acceleration = add(acceleration, add(coriolis, scale(axis, rate2)))
        else:
            alpha = add(alpha, add(cross(omega, scale(axis, rate)), scale(axis, rate2)))
            omega = add(omega, scale(axis, rate))
        motions.append(BodyMotion(rotation, offset, omega, alpha, acceleration))
    return motions


class Load(NamedTuple):
    """A multiple of the payload that the last body holds in addition.

    Attributes:
        share: Its mass, as a fraction of that of the payload.
        centre: Center of mass in the tip frame [m], 3 scalars.
        shape: Its inertia about the center, as a fraction of that of the payload at
            equal mass.
    """

    share: Scalar
    centre: Vec
    shape: Scalar


def inverse_dynamics(
    chain: Chain,
    q: Vec,
    dq: Vec,
    ddq: Vec,
    *,
    payload: Payload | None = None,
    loads: Sequence[Load] = (),
) -> Vec:
    """Return joint torques [N m] by recursive Newton-Euler in joint frames, at q [rad], dq and ddq of n scalars.

    Loads are multiples of the payload, at the tip beside those of the chain.
    """
    motions = body_motions(chain, q, dq, ddq)
    wrenches = [
        _body_wrench(joint.mass, constants(joint.com), rows_of(joint.inertia), motion)
        for joint, motion in zip(chain.joints, motions, strict=True)
    ]
    for load in loads:
        # The nominal payload belongs to the last body already; a load adds its
        # difference.
        assert payload is not None
        more = _load_wrench(chain, payload, load, motions[-1])
        wrenches[-1] = (
            add(wrenches[-1][0], scale(more[0], load.share)),
            add(wrenches[-1][1], scale(more[1], load.share)),
        )
    # Inward: the joint carries the wrenches of all bodies beyond it. Its torque is the
    # component along its axis.
    force = [0.0, 0.0, 0.0]
    torque = [0.0, 0.0, 0.0]
    torques: Vec = []
    for joint, motion, wrench in zip(
        chain.joints[::-1], motions[::-1], wrenches[::-1], strict=True
    ):
        force = add(force, wrench[0])
        torque = add(torque, wrench[1])
        torques.append(dot(constants(joint.axis), force if joint.prismatic else torque))
        # Into the frame of the previous joint; the lever arm is the frame's offset.
        force = times(motion.rotation, force)
        torque = add(times(motion.rotation, torque), cross(motion.offset, force))
    return torques[::-1]


def acceleration_at(acceleration: Vec, omega: Vec, alpha: Vec, offset: Vec) -> Vec:
    """Return the acceleration of a point of a body at ``offset`` from a point with ``acceleration``."""
    return add(
        acceleration, add(cross(alpha, offset), cross(omega, cross(omega, offset)))
    )


def _body_wrench(
    mass: float, com: Vec, inertia: list[Vec], motion: BodyMotion
) -> tuple[Vec, Vec]:
    """Return the force and the torque about the joint origin that move a body of a joint."""
    omega = motion.omega
    force = scale(acceleration_at(motion.acceleration, omega, motion.alpha, com), mass)
    # Newton and Euler: f = m a_com, n = I alpha + w x I w, and com x f about the
    # origin.
    spin = add(times(inertia, motion.alpha), cross(omega, times(inertia, omega)))
    return force, add(spin, cross(com, force))


def _load_wrench(
    chain: Chain, payload: Payload, load: Load, motion: BodyMotion
) -> tuple[Vec, Vec]:
    """Return the wrench of a load of the payload's mass in the last joint frame.

    See ``_body_wrench``.
    """
    turn = chain.tip_rotation
    com = add(constants(chain.tip_translation), times(rows_of(turn), load.centre))
    # The inertia tensor turns with the tip frame: R I R^T.
    inertia = [
        scale(row, load.shape)
        for row in rows_of(turn @ payload.inertia_matrix @ turn.T)
    ]
    return _body_wrench(payload.mass, com, inertia, motion)
