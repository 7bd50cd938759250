"""Kinematics of a chain as CasADi SX: positions, axes, Jacobian, bias acceleration, in the world frame.

Structural zeros of the URDF cause no operations.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

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
    subtract,
    symbols,
    times,
)
from cnpgen.robots.chain import Chain, Joint
from cnpgen.robots.robot import Robot


@dataclass(frozen=True)
class Kinematics:
    """Forward kinematics of a chain at q.

    Attributes:
        axes: Joint axes z_i, n lists of 3.
        origins: Joint origins o_i [m], n lists of 3.
        tip: Tip position p [m], 3.
        rotation: Tip rotation, 3 rows of 3.
        jacobian: Columns dp/dq_i [m/rad], n lists of 3.
        revolute: Whether joint i is revolute.
        frames: Rotations of the joints' frames, n times 3 rows of 3.
    """

    axes: list[Vec]
    origins: list[Vec]
    tip: Vec
    rotation: list[Vec]
    jacobian: list[Vec]
    revolute: list[bool]
    frames: list[list[Vec]]


def forward_kinematics(chain: Chain, q: Vec) -> Kinematics:
    """Return positions, axes and the tip Jacobian of a chain at joint positions q [rad], n scalars."""
    rotation: list[Vec] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    position: Vec = [0.0, 0.0, 0.0]
    axes = []
    origins = []
    frames = []
    for joint, angle in zip(chain.joints, q, strict=True):
        position = add(position, times(rotation, constants(joint.translation)))
        rotation = product(
            rotation, product(rows_of(joint.rotation), joint_rotation(joint, angle))
        )
        axis = times(rotation, constants(joint.axis))
        # A prismatic joint moves the origin of its own frame along the axis.
        if joint.prismatic:
            position = add(position, scale(axis, angle))
        axes.append(axis)
        origins.append(position)
        frames.append(rotation)
    tip = add(position, times(rotation, constants(chain.tip_translation)))
    revolute = [not joint.prismatic for joint in chain.joints]
    # dp/dq_i = z_i x (p - o_i) for revolute joints, z_i for prismatic ones.
    jacobian = [
        cross(z, subtract(tip, o)) if turns else z
        for z, o, turns in zip(axes, origins, revolute, strict=True)
    ]
    return Kinematics(
        axes,
        origins,
        tip,
        product(rotation, rows_of(chain.tip_rotation)),
        jacobian,
        revolute,
        frames,
    )


def tip_velocity(kin: Kinematics, dq: Vec) -> Vec:
    """Return the linear velocity of the tip [m/s] for joint velocities dq [rad/s]."""
    return [dot([column[row] for column in kin.jacobian], dq) for row in range(3)]


def bias_acceleration(kin: Kinematics, dq: Vec) -> Vec:
    """Return the acceleration of the tip at ddq = 0, ``dJ/dt dq`` [m/s^2]."""
    omega: Vec = [0.0, 0.0, 0.0]
    velocity: Vec = [0.0, 0.0, 0.0]  # of the current joint's origin
    bias: Vec = [0.0, 0.0, 0.0]
    previous: Vec = [0.0, 0.0, 0.0]
    tip = tip_velocity(kin, dq)
    # dJ_i/dt = (w_{i-1} x z_i) x (p - o_i) + z_i x (dp/dt - do_i/dt): the axis turns
    # with the links before it, and both ends of the lever arm move.
    for z, o, column, rate, turns in zip(
        kin.axes, kin.origins, kin.jacobian, dq, kin.revolute, strict=True
    ):
        velocity = add(velocity, cross(omega, subtract(o, previous)))
        if turns:
            moving = cross(z, subtract(tip, velocity))
            turning = cross(cross(omega, z), subtract(kin.tip, o))
            bias = add(bias, scale(add(moving, turning), rate))
            omega = add(omega, scale(z, rate))
        else:
            # A prismatic axis turns with the links before it, and then moves the
            # origins behind it.
            bias = add(bias, scale(cross(omega, column), rate))
            velocity = add(velocity, scale(z, rate))
        previous = o
    return bias


def tip_position(robot: Robot) -> Any:
    """Build ``q -> p``, the position of the tip [m], as an SX function."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    return ca.Function(
        "tip_position", [q_sx], [ca.vertcat(*forward_kinematics(robot.chain, q).tip)]
    )


def joint_rotation(joint: Joint, angle: Scalar) -> list[Vec]:
    """Return the rotation about the joint axis: a a^T + cos (I - a a^T) + sin [a]x, identity for prismatic joints."""
    import casadi as ca

    if joint.prismatic:
        return rows_of(np.eye(3))
    a = joint.axis
    skew = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    # Each entry is a combination of 1, cos and sin with constant factors, of which
    # zeros are left out in ``dot``.
    factors = np.stack(
        [np.outer(a, a), np.eye(3) - np.outer(a, a), skew], axis=2
    ).tolist()
    terms = [1.0, ca.cos(angle), ca.sin(angle)]
    return [[dot(terms, entry) for entry in row] for row in factors]
