"""Robot states as CasADi SX: lists of scalars in the world frame."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

from cnpgen.kernels.symbolic.drive import linear_torque, motor_torque
from cnpgen.kernels.symbolic.dynamics import (
    Load,
    acceleration_at,
    body_motions,
    inverse_dynamics,
)
from cnpgen.kernels.symbolic.kinematics import (
    Kinematics,
    bias_acceleration,
    forward_kinematics,
    tip_velocity,
)
from cnpgen.kernels.symbolic.linalg import (
    Scalar,
    Vec,
    add,
    constants,
    cross,
    dot,
    scale,
    subtract,
    symbols,
    times,
)
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.parameter_ranges import (
    PAYLOAD_CENTRE,
    PAYLOAD_PARAMETERS,
    UPRIGHT_TURN,
)
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.shape import Shape
from cnpgen.robots.solid import pose_width
from cnpgen.robots.table_frame import table_axes


@dataclass(frozen=True)
class SymbolicState:
    """A robot state as SX with derived quantities, each built on first use.

    Attributes:
        robot: The robot.
        q: Joint positions [rad], n scalars.
        dq: Joint velocities [rad/s].
        ddq: Joint accelerations [rad/s^2].
        obstacle_poses: Poses and sizes of the obstacles (``cnpgen.robots.solid``), then
            values for a constraint, then the parameters of the problem.
        obstacles: The obstacles.
        object_size: Edge lengths of the held object [m], or None.
        jerk: Joint jerks [rad/s^3], or None.
        friction_rates: Velocities that determine the direction of friction in place of
            dq (``motor_torque`` of ``cnpgen.kernels.symbolic.drive``), or None.
    """

    robot: Robot
    q: Vec
    dq: Vec
    ddq: Vec
    obstacle_poses: Vec
    obstacles: tuple[Obstacle, ...]
    object_size: tuple[float, float, float] | None
    jerk: Vec | None = None
    friction_rates: Vec | None = None

    @classmethod
    def of_symbols(
        cls,
        robot: Robot,
        obstacles: tuple[Obstacle, ...],
        object_size: tuple[float, float, float] | None,
        width: int,
        *,
        uses_jerk: bool = False,
    ) -> tuple[list[Any], Self]:
        """Return the columns q, dq, ddq, the jerk if used, and ``width`` obstacle poses, and the state they define."""
        widths = dict.fromkeys(("q", "dq", "ddq", "jerk")[: 3 + uses_jerk], robot.n) | {
            "obstacle_poses": width
        }
        columns, (q, dq, ddq, *jerk, poses) = zip(
            *(symbols(*item) for item in widths.items()), strict=True
        )
        return list(columns), cls(
            robot, q, dq, ddq, poses, obstacles, object_size, *jerk
        )

    @property
    def scene_values(self) -> Vec:
        """Values of the motion for a constraint (``Constraint.scene_values``)."""
        values: Vec = self._after_obstacles[0]
        return values

    @property
    def parameters(self) -> dict[str, Scalar]:
        """Parameters of the sample, by name."""
        return self._after_obstacles[1]

    @cached_property
    def _after_obstacles(self) -> tuple[Vec, dict[str, Scalar]]:
        values = self.obstacle_poses[pose_width(self.obstacles) :]
        return self.robot.parameters.split(values, self.robot.nominal_parameters)

    def on_table(self, position: Vec) -> Vec:
        """Return a position [m] in the frame of the table, which is the world's unless parameters move the table."""
        axes = self._table_axes
        if axes is None:
            return position
        # The table turns about its pivot and is lifted before: first undo the lift,
        # then the turn.
        pivot: Vec = constants(self.robot.table_origin)
        relative = subtract(position, pivot)
        relative[2] = relative[2] - self.parameters.get("table_height", 0.0)
        return add([dot(axis, relative) for axis in axes], pivot)

    def along_table(self, vector: Vec) -> Vec:
        """Return a vector along the axes of the table."""
        axes = self._table_axes
        return vector if axes is None else [dot(axis, vector) for axis in axes]

    def along_upright(self, vector: Vec) -> Vec:
        """Return a vector along axes that are the world's unless parameters turn the upright direction."""
        if not self.robot.parameters.turns_upright:
            return vector
        return [dot(axis, vector) for axis in self._turned_axes(*UPRIGHT_TURN)]

    @cached_property
    def _table_axes(self) -> tuple[Vec, ...] | None:
        return (
            self._turned_axes("table_roll", "table_pitch")
            if self.robot.parameters.tilts_table
            else None
        )

    def _turned_axes(self, *names: str) -> tuple[Vec, ...]:
        """Return axes that two parameters turn: a roll, then a pitch."""
        import casadi as ca

        roll, pitch = (ca.SX(self.parameters.get(name, 0.0)) for name in names)
        return table_axes(ca.sin(roll), ca.cos(roll), ca.sin(pitch), ca.cos(pitch))

    @cached_property
    def kinematics(self) -> Kinematics:
        """Positions and Jacobian at q."""
        return forward_kinematics(self.robot.chain, self.q)

    @cached_property
    def torque(self) -> Vec:
        """Inverse dynamics of the rigid body [N m]."""
        return self.inverse_dynamics(self.ddq)

    @cached_property
    def motor_torque(self) -> tuple[Vec, Vec]:
        """Lowest and highest torque at the motors over all friction that may act [N m]."""
        if self.robot.drive is None:
            return self.torque, self.torque
        moving = self.torque, self.dq, self.ddq
        return motor_torque(self.robot.drive, *moving, self.friction_rates)

    @cached_property
    def linear_torque(self) -> Vec:
        """Torque at the motors without dry friction [N m], that of the rigid body without drives."""
        if self.robot.drive is None:
            return self.torque
        return linear_torque(self.robot.drive, self.torque, self.dq, self.ddq)

    def inverse_dynamics(self, ddq: Vec) -> Vec:
        """Return the torque [N m] of the sample's load at other accelerations [rad/s^2]."""
        chain = self.robot.chain
        payload = self.robot.attached.payload
        values = self.parameters
        if payload is None or not self.robot.parameters.changes_payload:
            return inverse_dynamics(chain, self.q, self.dq, ddq)
        mass = values.get("payload_mass", payload.mass)
        nominal = list(payload.centre)
        # The torque is linear in mass, first moment and inertia. If only the mass
        # changes, one multiple of the nominal payload is the difference.
        if values.keys().isdisjoint(PAYLOAD_PARAMETERS[1:]):
            loads = [Load((mass - payload.mass) / payload.mass, nominal, 1.0)]
        else:
            # The load in place of the nominal one.
            centre = [
                values.get(name, value)
                for name, value in zip(PAYLOAD_CENTRE, nominal, strict=True)
            ]
            loads = [
                Load(mass / payload.mass, centre, values.get("payload_inertia", 1.0)),
                Load(-1.0, nominal, 1.0),
            ]
        return inverse_dynamics(
            chain, self.q, self.dq, ddq, payload=payload, loads=loads
        )

    @cached_property
    def tip_velocity(self) -> Vec:
        """Linear velocity of the tip [m/s]."""
        return tip_velocity(self.kinematics, self.dq)

    @cached_property
    def tip_acceleration(self) -> Vec:
        """Linear acceleration of the tip [m/s^2]."""
        return add(
            tip_velocity(self.kinematics, self.ddq),
            bias_acceleration(self.kinematics, self.dq),
        )

    @cached_property
    def recursive_tip_acceleration(self) -> Vec:
        """Linear acceleration of the tip [m/s^2] by the recursion of the inverse dynamics, for a third of the cost."""
        chain = self.robot.chain
        last = body_motions(chain, self.q, self.dq, self.ddq)[-1]
        without_gravity = acceleration_at(
            last.acceleration, last.omega, last.alpha, chain.tip_translation.tolist()
        )
        # The tip's rotation is R_joint R_tip: R_tip^T turns it back to the last joint's
        # frame, in which the recursion ends.
        rotation = [
            [dot(row, column) for column in chain.tip_rotation.tolist()]
            for row in self.kinematics.rotation
        ]
        # The recursion contains -g of the base; adding g leaves the motion alone.
        return [
            dot(row, without_gravity) + g
            for row, g in zip(rotation, chain.gravity.tolist(), strict=True)
        ]

    @cached_property
    def tip_angular_velocity(self) -> Vec:
        """Angular velocity of the tip [rad/s]."""
        return self._tip_rotation_rates[0]

    @cached_property
    def tip_angular_acceleration(self) -> Vec:
        """Angular acceleration of the tip [rad/s^2]."""
        return self._tip_rotation_rates[1]

    @cached_property
    def _tip_rotation_rates(self) -> tuple[Vec, Vec]:
        omega: Vec = [0.0, 0.0, 0.0]
        alpha: Vec = [0.0, 0.0, 0.0]
        kin = self.kinematics
        for z, rate, rate2, turns in zip(
            kin.axes, self.dq, self.ddq, kin.revolute, strict=True
        ):
            # d(w)/dt = sum of z ddq + w x z dq, joint by joint from the base.
            if turns:
                alpha = add(alpha, add(scale(z, rate2), scale(cross(omega, z), rate)))
                omega = add(omega, scale(z, rate))
        return omega, alpha

    @property
    def segments(self) -> list[tuple[Vec, Vec]]:
        """The moving capsule axes of the robot: pairs of points [m]."""
        points = [*self.kinematics.origins, self.kinematics.tip]
        return [(points[a], points[b]) for a, b in self.robot.capsule_axes]

    @cached_property
    def capsules(self) -> dict[str, tuple[Vec, Vec, float]]:
        """Link -> ends [m] and radius [m] of its capsule.

        Empty for a robot without link geometry.
        """
        return self._placed_capsules(self.robot.shape)

    @cached_property
    def held_capsules(self) -> dict[str, tuple[Vec, Vec, float]]:
        """Link -> ends [m] and radius [m] of its capsule, for links that may not touch the held object."""
        return self._placed_capsules(self.robot.held_shape)

    def _placed_capsules(
        self, shape: Shape | None
    ) -> dict[str, tuple[Vec, Vec, float]]:
        if shape is None:
            return {}
        placed = {}
        # Capsules are given in the frames of their joints; those of the base do not
        # move.
        for capsule in shape.capsules:
            first = constants(capsule.first)
            second = constants(capsule.second)
            joint = shape.joints[capsule.link]
            if joint > 0:
                rotation = self.kinematics.frames[joint - 1]
                origin = self.kinematics.origins[joint - 1]
                first, second = (
                    add(origin, times(rotation, end)) for end in (first, second)
                )
            placed[capsule.link] = first, second, capsule.radius
        return placed

    def freeze(self, value: Scalar) -> Scalar:
        """Return a value that derivatives may treat as constant.

        Here it is returned unchanged.
        """
        return value


@dataclass(frozen=True)
class FrozenState(SymbolicState):
    """A state whose frozen values are symbols until the derivatives are built.

    Attributes:
        frozen: Pairs of a symbol and its value.
    """

    frozen: list[tuple[Any, Any]] = field(default_factory=list)

    def freeze(self, value: Scalar) -> Scalar:
        """Return a symbol for a value, so that derivatives treat the value as constant."""
        import casadi as ca

        symbol = ca.SX.sym(f"frozen_{len(self.frozen)}")
        self.frozen.append((symbol, value))
        return symbol

    def unfrozen(self, results: list[Any]) -> list[Any]:
        """Replace the symbols of frozen values by the values."""
        import casadi as ca

        symbols = [symbol for symbol, _ in self.frozen]
        values = [value for _, value in self.frozen]
        substituted: list[Any] = (
            ca.substitute(results, symbols, values) if symbols else results
        )
        return substituted


def time_derivatives(
    path: Sequence[Vec], rate: Sequence[Scalar]
) -> tuple[Vec, Vec, Vec | None]:
    """Return ``dq = p' r``, ``ddq = p'' r^2 + p' r r'`` and the jerk ``p''' r^3 + 3 p'' r' r^2 + p' (r'' r + r'^2) r``.

    It is ``cnpgen.trajectory.spline_motion.time_derivatives`` in SX. Without p''' the
    jerk is None, and r'' not needed.
    """
    (p1, p2), (r, r1) = path[:2], rate[:2]
    dq = [a * r for a in p1]
    ddq = [b * r * r + a * r * r1 for a, b in zip(p1, p2, strict=True)]
    if len(path) < 3:
        return dq, ddq, None
    r2 = rate[2]
    terms = zip(p1, p2, path[2], strict=True)
    return (
        dq,
        ddq,
        [c * r**3 + 3 * b * r1 * r**2 + a * (r2 * r + r1**2) * r for a, b, c in terms],
    )
