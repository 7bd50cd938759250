"""Dynamics of a chain as CasADi SX: recursive Newton-Euler in the frames of its joints."""

from dataclasses import dataclass, replace

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
from cnpgen.robots.attached import PayloadBody
from cnpgen.robots.chain import Chain, Joint


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

    Args:
        chain: The chain.
        q: Joint positions [rad], n scalars.
        dq: Joint velocities [rad/s].
        ddq: Joint accelerations [rad/s^2].
    """
    omega: Vec = [0.0, 0.0, 0.0]
    alpha: Vec = [0.0, 0.0, 0.0]
    acceleration: Vec = constants(-chain.gravity)
    motions = []
    for joint, angle, rate, rate2 in zip(chain.joints, q, dq, ddq, strict=True):
        rotation = product(rows_of(joint.rotation), joint_rotation(joint, angle))
        offset = _offset(joint, angle)
        acceleration = acceleration_at(acceleration, omega, alpha, offset)
        acceleration, omega, alpha = (transposed_times(rotation, x) for x in (acceleration, omega, alpha))
        axis = constants(joint.axis)
        if joint.prismatic:
            coriolis = scale(cross(omega, scale(axis, rate)), 2.0)
            acceleration = add(acceleration, add(coriolis, scale(axis, rate2)))
        else:
            alpha = add(alpha, add(cross(omega, scale(axis, rate)), scale(axis, rate2)))
            omega = add(omega, scale(axis, rate))
        motions.append(BodyMotion(rotation, offset, omega, alpha, acceleration))
    return motions


def inverse_dynamics(chain: Chain, q: Vec, dq: Vec, ddq: Vec, *, load: tuple[PayloadBody, Scalar] | None = None) -> Vec:
    """Return joint torques [N m] by recursive Newton-Euler in joint frames.

    Args:
        chain: The chain.
        q: Joint positions [rad], n scalars.
        dq: Joint velocities [rad/s].
        ddq: Joint accelerations [rad/s^2].
        load: A body at the tip, and the factor by which the last body holds more of it.
    """
    motions = body_motions(chain, q, dq, ddq)
    wrenches = [_body_wrench(joint, motion) for joint, motion in zip(chain.joints, motions, strict=True)]
    if load is not None:
        body, factor = load
        added = _body_wrench(_at_tip(chain, body), motions[-1])
        (force, torque), (more_force, more_torque) = wrenches[-1], added
        wrenches[-1] = add(force, scale(more_force, factor)), add(torque, scale(more_torque, factor))
    force, torque = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    torques: Vec = []
    for joint, motion, wrench in zip(chain.joints[::-1], motions[::-1], wrenches[::-1], strict=True):
        force, torque = add(force, wrench[0]), add(torque, wrench[1])
        torques.append(dot(constants(joint.axis), force if joint.prismatic else torque))
        force = times(motion.rotation, force)
        torque = add(times(motion.rotation, torque), cross(motion.offset, force))
    return torques[::-1]


def acceleration_at(acceleration: Vec, omega: Vec, alpha: Vec, offset: Vec) -> Vec:
    """Return the acceleration of a point of a body at ``offset`` from a point with ``acceleration``."""
    return add(acceleration, add(cross(alpha, offset), cross(omega, cross(omega, offset))))


def _body_wrench(joint: Joint, motion: BodyMotion) -> tuple[Vec, Vec]:
    """Return the force and the torque about the joint origin that move the body of a joint."""
    com, inertia, omega = constants(joint.com), rows_of(joint.inertia), motion.omega
    force = scale(acceleration_at(motion.acceleration, omega, motion.alpha, com), joint.mass)
    spin = add(times(inertia, motion.alpha), cross(omega, times(inertia, omega)))
    return force, add(spin, cross(com, force))


def _at_tip(chain: Chain, body: PayloadBody) -> Joint:
    """Return the last joint with a body at the tip in place of its own."""
    turn = chain.tip_rotation
    com, inertia = chain.tip_translation + turn @ body.com, turn @ body.inertia @ turn.T
    return replace(chain.joints[-1], mass=body.mass, com=com, inertia=inertia)


def _offset(joint: Joint, angle: Scalar) -> Vec:
    """Return the origin of the moved joint frame in the previous frame."""
    offset = constants(joint.translation)
    if joint.prismatic:
        offset = add(offset, scale(constants(joint.rotation @ joint.axis), angle))
    return offset
