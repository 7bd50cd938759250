"""Kinematics and dynamics of a chain as CasADi SX: positions, Jacobian, bias acceleration, recursive Newton-Euler.

All vectors are Python lists of SX scalars in the world frame unless said otherwise; structural zeros of the URDF cost
nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.chain import Chain, Joint
from cnpgen.symbolic.linalg import Scalar, add, cross, dot, scale, subtract

if TYPE_CHECKING:
    from cnpgen.robots.obstacle import Obstacle
    from cnpgen.robots.robot import Robot
    from cnpgen.robots.shape.capsule import Capsule

Vec = list[Scalar]


@dataclass(frozen=True)
class Kinematics:
    """Positions of a chain at q.

    Attributes:
        axes: Joint axes z_i, n lists of 3.
        origins: Joint origins o_i [m], n lists of 3.
        tip: Tip position p [m], 3.
        rotation: Tip rotation, 3 rows of 3.
        jacobian: Columns dp/dq_i [m/rad], n lists of 3.
        turning: Whether joint i is revolute.
        frames: Rotations of the joints' frames, n times 3 rows of 3.
    """

    axes: list[Vec]
    origins: list[Vec]
    tip: Vec
    rotation: list[Vec]
    jacobian: list[Vec]
    turning: list[bool]
    frames: list[list[Vec]]


def forward_kinematics(chain: Chain, q: Vec) -> Kinematics:
    """Positions, axes and tip Jacobian of a chain.

    Args:
        chain: The chain.
        q: Joint positions [rad], n scalars.
    """
    rotation: list[Vec] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    position: Vec = [0.0, 0.0, 0.0]
    axes, origins, frames = [], [], []
    for joint, angle in zip(chain.joints, q, strict=True):
        position = add(position, _times(rotation, _constants(joint.translation)))
        rotation = _product(rotation, _product(_rows(joint.rotation), _turn(joint, angle)))
        axis = _times(rotation, _constants(joint.axis))
        if joint.prismatic:
            position = add(position, scale(axis, angle))
        axes.append(axis)
        origins.append(position)
        frames.append(rotation)
    tip = add(position, _times(rotation, _constants(chain.tip_translation)))
    turning = [not joint.prismatic for joint in chain.joints]
    jacobian = [cross(z, subtract(tip, o)) if turns else z for z, o, turns in zip(axes, origins, turning, strict=True)]
    return Kinematics(axes, origins, tip, _product(rotation, _rows(chain.tip_rotation)), jacobian, turning, frames)


def tip_velocity(kin: Kinematics, dq: Vec) -> Vec:
    """Linear velocity of the tip [m/s] for joint velocities dq [rad/s]."""
    return [dot([column[row] for column in kin.jacobian], dq) for row in range(3)]


def bias_acceleration(kin: Kinematics, dq: Vec) -> Vec:
    """Acceleration of the tip at ddq = 0, ``dJ/dt dq`` [m/s^2]."""
    omega: Vec = [0.0, 0.0, 0.0]
    velocity: Vec = [0.0, 0.0, 0.0]  # of the current joint's origin
    bias: Vec = [0.0, 0.0, 0.0]
    previous: Vec = [0.0, 0.0, 0.0]
    tip = tip_velocity(kin, dq)
    for z, o, column, rate, turns in zip(kin.axes, kin.origins, kin.jacobian, dq, kin.turning, strict=True):
        velocity = add(velocity, cross(omega, subtract(o, previous)))
        if turns:
            moving = cross(z, subtract(tip, velocity))
            turning = cross(cross(omega, z), subtract(kin.tip, o))
            bias = add(bias, scale(add(moving, turning), rate))
            omega = add(omega, scale(z, rate))
        else:
            bias = add(bias, scale(cross(omega, column), rate))
            velocity = add(velocity, scale(z, rate))
        previous = o
    return bias


@dataclass(frozen=True)
class BodyMotion:
    """How the body of a joint moves, in its joint's frame.

    Attributes:
        rotation: From the joint's frame to the previous one, 3 rows of 3.
        offset: Origin of the joint's frame in the previous one [m].
        omega: Angular velocity [rad/s].
        alpha: Angular acceleration [rad/s^2].
        acceleration: Acceleration of the origin less gravity [m/s^2].
    """

    rotation: list[Vec]
    offset: Vec
    omega: Vec
    alpha: Vec
    acceleration: Vec


def body_motions(chain: Chain, q: Vec, dq: Vec, ddq: Vec) -> list[BodyMotion]:
    """Motion of every body, the outward recursion of Newton-Euler.

    Args:
        chain: The chain.
        q: Joint positions [rad], n scalars.
        dq: Joint velocities [rad/s].
        ddq: Joint accelerations [rad/s^2].
    """
    omega: Vec = [0.0, 0.0, 0.0]
    alpha: Vec = [0.0, 0.0, 0.0]
    acceleration: Vec = _constants(-chain.gravity)
    motions = []
    for joint, angle, rate, rate2 in zip(chain.joints, q, dq, ddq, strict=True):
        rotation = _product(_rows(joint.rotation), _turn(joint, angle))
        offset = _offset(joint, angle)
        acceleration = carried(acceleration, omega, alpha, offset)
        acceleration, omega, alpha = (_transposed_times(rotation, x) for x in (acceleration, omega, alpha))
        axis = _constants(joint.axis)
        if joint.prismatic:
            coriolis = scale(cross(omega, scale(axis, rate)), 2.0)
            acceleration = add(acceleration, add(coriolis, scale(axis, rate2)))
        else:
            alpha = add(alpha, add(cross(omega, scale(axis, rate)), scale(axis, rate2)))
            omega = add(omega, scale(axis, rate))
        motions.append(BodyMotion(rotation, offset, omega, alpha, acceleration))
    return motions


def inverse_dynamics(chain: Chain, q: Vec, dq: Vec, ddq: Vec) -> Vec:
    """Joint torques [N m] by recursive Newton-Euler, in joint frames.

    Args:
        chain: The chain.
        q: Joint positions [rad], n scalars.
        dq: Joint velocities [rad/s].
        ddq: Joint accelerations [rad/s^2].
    """
    motions = body_motions(chain, q, dq, ddq)
    wrenches = [_body_wrench(joint, motion) for joint, motion in zip(chain.joints, motions, strict=True)]
    force: Vec = [0.0, 0.0, 0.0]
    moment: Vec = [0.0, 0.0, 0.0]
    torques: Vec = []
    for joint, motion, wrench in zip(chain.joints[::-1], motions[::-1], wrenches[::-1], strict=True):
        force, moment = add(force, wrench[0]), add(moment, wrench[1])
        torques.append(dot(_constants(joint.axis), force if joint.prismatic else moment))
        force = _times(motion.rotation, force)
        moment = add(_times(motion.rotation, moment), cross(motion.offset, force))
    return torques[::-1]


def carried(acceleration: Vec, omega: Vec, alpha: Vec, offset: Vec) -> Vec:
    """Acceleration of a point of a body at ``offset`` from the one that has ``acceleration``."""
    return add(acceleration, add(cross(alpha, offset), cross(omega, cross(omega, offset))))


def _body_wrench(joint: Joint, motion: BodyMotion) -> tuple[Vec, Vec]:
    """Force and moment about the joint origin that the body of a joint needs for its motion."""
    com, inertia, omega = _constants(joint.com), _rows(joint.inertia), motion.omega
    force = scale(carried(motion.acceleration, omega, motion.alpha, com), joint.mass)
    spin = add(_times(inertia, motion.alpha), cross(omega, _times(inertia, omega)))
    return force, add(spin, cross(com, force))


@dataclass(frozen=True)
class SymbolicState:
    """A robot state as SX, and what constraints ask of it, each built on first use.

    Attributes:
        robot: The robot.
        q: Joint positions [rad], n scalars.
        dq: Joint velocities [rad/s].
        ddq: Joint accelerations [rad/s^2].
        tops: The numbers of the obstacles (``cnpgen.robots.solid``): heights of upright boxes [m], and what poses say.
        obstacles: The obstacles.
        object_size: Edge lengths of the held object [m], or None.
    """

    robot: "Robot"
    q: Vec
    dq: Vec
    ddq: Vec
    tops: Vec
    obstacles: "tuple[Obstacle, ...]"
    object_size: tuple[float, float, float] | None
    jerk: Vec | None = None

    @cached_property
    def kinematics(self) -> Kinematics:
        """Positions and Jacobian at q."""
        return forward_kinematics(self.robot.chain, self.q)

    @cached_property
    def torque(self) -> Vec:
        """Inverse dynamics [N m]."""
        return inverse_dynamics(self.robot.chain, self.q, self.dq, self.ddq)

    @cached_property
    def tip_velocity(self) -> Vec:
        """Linear velocity of the tip [m/s]."""
        return tip_velocity(self.kinematics, self.dq)

    @cached_property
    def tip_acceleration(self) -> Vec:
        """Linear acceleration of the tip [m/s^2]."""
        return add(tip_velocity(self.kinematics, self.ddq), bias_acceleration(self.kinematics, self.dq))

    @cached_property
    def tip_angular_velocity(self) -> Vec:
        """Angular velocity of the tip [rad/s]."""
        return self._turning[0]

    @cached_property
    def tip_angular_acceleration(self) -> Vec:
        """Angular acceleration of the tip [rad/s^2]."""
        return self._turning[1]

    @cached_property
    def _turning(self) -> tuple[Vec, Vec]:
        omega: Vec = [0.0, 0.0, 0.0]
        alpha: Vec = [0.0, 0.0, 0.0]
        kin = self.kinematics
        for z, rate, rate2, turns in zip(kin.axes, self.dq, self.ddq, kin.turning, strict=True):
            if turns:
                alpha = add(alpha, add(scale(z, rate2), scale(cross(omega, z), rate)))
                omega = add(omega, scale(z, rate))
        return omega, alpha

    @property
    def segments(self) -> list[tuple[Vec, Vec]]:
        """The moving segments of the robot's skeleton: pairs of points [m]."""
        points = [*self.kinematics.origins, self.kinematics.tip]
        return [(points[a], points[b]) for a, b in self.robot.skeleton]

    @cached_property
    def capsules(self) -> dict[str, tuple[Vec, Vec, float]]:
        """Link -> both ends [m] and the radius [m] of its capsule; nothing for a robot without a shape."""
        shape = self.robot.shape
        found = () if shape is None else ((each, shape.joints[each.link]) for each in shape.capsules)
        return {capsule.link: self._placed(capsule, joint) for capsule, joint in found}

    def _placed(self, capsule: "Capsule", joint: int) -> tuple[Vec, Vec, float]:
        first, second = _constants(capsule.first), _constants(capsule.second)
        if joint == 0:
            return first, second, capsule.radius
        rotation, origin = self.kinematics.frames[joint - 1], self.kinematics.origins[joint - 1]
        return add(origin, _times(rotation, first)), add(origin, _times(rotation, second)), capsule.radius

    def hold(self, value: Scalar) -> Scalar:
        """Return a value that the derivative of what it is used in may take as a constant; here nothing is held."""
        return value


@dataclass(frozen=True)
class HeldState(SymbolicState):
    """A state whose held values are symbols until the derivatives are built.

    Attributes:
        held: Pairs of a symbol and the value that it stands for.
    """

    held: list[tuple[Any, Any]] = field(default_factory=list)

    def hold(self, value: Scalar) -> Scalar:
        """Return a symbol for a value, so that derivatives pass it by."""
        import casadi as ca

        symbol = ca.SX.sym(f"held_{len(self.held)}")
        self.held.append((symbol, value))
        return symbol

    def released(self, results: list[Any]) -> list[Any]:
        """Put held values back in the place of their symbols."""
        import casadi as ca

        symbols, values = [symbol for symbol, _ in self.held], [value for _, value in self.held]
        found: list[Any] = ca.substitute(results, symbols, values) if symbols else results
        return found


def jerk_along(path: Sequence[Vec], rate: Sequence[Scalar]) -> Vec | None:
    """Return the jerk ``p''' r^3 + 3 p'' r' r^2 + p' (r'' r + r'^2) r``; None where p''' is not given.

    Args:
        path: p', p'' and p'''.
        rate: r, r' and r''.
    """
    if len(path) < 3:
        return None
    (p1, p2, p3), (r, r1, r2) = path, rate
    return [c * r**3 + 3 * b * r1 * r**2 + a * (r2 * r + r1**2) * r for a, b, c in zip(p1, p2, p3, strict=True)]


def symbols(name: str, width: int) -> tuple[Any, Vec]:
    """Return a fresh SX column of ``width`` symbols and the list of its scalars."""
    import casadi as ca

    column = ca.SX.sym(name, width)
    return column, ca.vertsplit(column)


def tip_position(robot: "Robot") -> Any:
    """Build ``q -> p``, the tip's position [m], as an SX function."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    return ca.Function("tip_position", [q_sx], [ca.vertcat(*forward_kinematics(robot.chain, q).tip)])


def _turn(joint: Joint, angle: Scalar) -> list[Vec]:
    """Rotation about the joint axis: a a^T + cos (I - a a^T) + sin [a]x, identity for prismatic joints."""
    import casadi as ca

    if joint.prismatic:
        return _rows(np.eye(3))
    a = joint.axis
    outer, cosine, sine = np.outer(a, a), ca.cos(angle), ca.sin(angle)
    skew = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    rest = np.eye(3) - outer
    return [[_sum3(outer[i, j], rest[i, j], cosine, skew[i, j], sine) for j in range(3)] for i in range(3)]


def _sum3(constant: float, a: float, cosine: Scalar, b: float, sine: Scalar) -> Scalar:
    total: Scalar = float(constant)
    for factor, value in ((a, cosine), (b, sine)):
        if factor != 0.0:
            term = value * float(factor)
            total = term if isinstance(total, float) and total == 0.0 else total + term
    return total


def _offset(joint: Joint, angle: Scalar) -> Vec:
    """Origin of the moved joint frame in the previous frame."""
    offset = _constants(joint.translation)
    if joint.prismatic:
        offset = add(offset, scale(_constants(joint.rotation @ joint.axis), angle))
    return offset


def _constants(values: NDArray[np.float64]) -> Vec:
    return [float(value) for value in values]


def _rows(matrix: NDArray[np.float64]) -> list[Vec]:
    return [_constants(row) for row in matrix]


def _times(matrix: list[Vec], vector: Vec) -> Vec:
    return [dot(row, vector) for row in matrix]


def _transposed_times(matrix: list[Vec], vector: Vec) -> Vec:
    return [dot([matrix[row][column] for row in range(3)], vector) for column in range(3)]


def _product(a: list[Vec], b: list[Vec]) -> list[Vec]:
    return [[dot(row, [b[k][column] for k in range(3)]) for column in range(3)] for row in a]
