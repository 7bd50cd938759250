"""A robot among its obstacles at one state, evaluated with Pinocchio and Coal."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import RecipeError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.convex_solid import Solid
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import place_obstacles, pose_width, solids_of
from cnpgen.world.collision_world import CollisionWorld
from cnpgen.world.drive import linear_torque, motor_torque
from cnpgen.world.measured_parameters import MeasuredParameters
from cnpgen.world.pair_distances import PairDistances
from cnpgen.world.rigid_bodies import NO_HELD_SHAPE, NO_SHAPE, RigidBodies

Value = TypeVar("Value", float, Array)  # of one state, or of K states


class RobotWorld(ABC, Generic[Value]):
    """A robot among its obstacles, at one or at many states: the parts that ``World`` and ``PathWorld`` share.

    Vectors are in the world frame. The memory of Pinocchio and Coal is reused: use a
    world in one process and one thread only.

    Args:
        robot: The robot.
        obstacles: The obstacles.
        object_size: Edge lengths of the held object [m], or None.

    Attributes:
        robot: The robot.
        obstacles: The obstacles.
        parameters: Parameters of the sample.
        q: Joint positions [rad], shape (n,) or (n, K).
        dq: Joint velocities [rad/s], of the same shape.
        ddq: Joint accelerations [rad/s^2], of the same shape.
        torque: Inverse dynamics of the rigid body [N m], of the same shape.
    """

    q: Array
    dq: Array
    ddq: Array
    torque: Any  # a property of either kind of world

    def __init__(
        self,
        robot: Robot,
        obstacles: Sequence[Obstacle] = (),
        object_size: tuple[float, float, float] | None = None,
    ) -> None:
        self.robot = robot
        self.obstacles = tuple(obstacles)
        self.parameters = MeasuredParameters(robot)
        self._model = self.parameters.model
        self._data = self._model.createData()
        self._tip = robot.tip_frame
        self._object_size = None if object_size is None else np.array(object_size)
        self._collisions = CollisionWorld(object_size)
        self._solids = list[Solid]()
        self._bodies = (
            None
            if robot.shape is None
            else RigidBodies(robot.shape, len(obstacles), robot.n)
        )
        self._held = (
            None
            if robot.held_shape is None
            else RigidBodies(robot.held_shape, 0, robot.n)
        )
        self._pose_width = pose_width(self.obstacles)
        self._poses: Array | None = None  # of the obstacles
        self._start()

    @abstractmethod
    def _start(self) -> None:
        """Allocate further memory, and move to the base configuration."""

    @property
    def scene_values(self) -> Array:
        """Values for a constraint (``Constraint.scene_values``).

        Empty if none were given.
        """
        return self.parameters.scene_values

    @property
    def motor_torque(self) -> tuple[Array, Array]:
        """Lowest and highest torques at the motors over all friction that may act [N m], shape (n,) or (n, K)."""
        if self.robot.drive is None:
            return self.torque, self.torque
        return motor_torque(self.robot.drive, self.torque, self.dq, self.ddq)

    @property
    def linear_torque(self) -> Array:
        """Torques at the motors without dry friction [N m], those of the rigid body without drives."""
        if self.robot.drive is None:
            return np.asarray(self.torque)
        return linear_torque(self.robot.drive, self.torque, self.dq, self.ddq)

    def segment_distances(self, sufficient: float = np.inf) -> list[Value]:
        """Measure the signed distance of every segment of the robot from every obstacle, segment by segment [m].

        A path that is not exact returns lower bounds without measuring if these are
        sufficient.

        Returns:
            Exact distances at one state. At K states, arrays of shape (K,), of which
            the smallest value is exact.
        """
        return self._smallest("segments", sufficient)

    def shape_distances(self, sufficient: float = np.inf) -> list[Value]:
        """Measure the signed distance of every moving part of the robot's links from every obstacle, part by part [m].

        The smallest is exact, the others are lower bounds above it
        (``cnpgen.world.pair_distances``).

        Raises:
            RecipeError: The robot has no link geometry.
        """
        return self._smallest("links", sufficient)

    def self_distances(self, sufficient: float = np.inf) -> list[Value]:
        """Measure the signed distance of every two parts of links that must not touch [m]; see ``shape_distances``."""
        return self._smallest("self", sufficient)

    def held_object_distances(self, sufficient: float = np.inf) -> list[Value]:
        """Measure the signed distance of the held object from parts of links [m]; see ``shape_distances``.

        Raises:
            RecipeError: The robot has no geometry for it.
        """
        return self._smallest("held object", sufficient)

    def object_distances(self, sufficient: float = np.inf) -> list[Value]:
        """Measure the signed distance of the held object from every obstacle [m], negative if they overlap.

        At K states, the smallest value of each array is exact.

        Raises:
            RecipeError: The problem has no held object.
        """
        return self._smallest("object", sufficient)

    @abstractmethod
    def _smallest(self, bodies: str, sufficient: float) -> list[Value]:
        """Measure distances, or return their bounds if these are sufficient and need not be exact."""

    def _require_object(self) -> Array:
        """Return the edge lengths of the held object [m], shape (3,)."""
        if self._object_size is None:
            raise RecipeError(
                ["a constraint needs the held object, but the problem has no [object]"]
            )
        return self._object_size

    def joint_pose(self, joint: int) -> tuple[Array, Array]:
        """Return rotation and position [m] of a joint's frame, shape (3, 3) and (3,), or with an axis of K states.

        Joints are counted from 1.
        """
        rotations, origins = self._joint_poses()
        shape = np.shape(self.q)[1:]  # () or (K,)
        return (
            rotations[joint].reshape(3, 3, *shape),
            origins[joint].reshape(3, *shape),
        )

    @abstractmethod
    def _joint_poses(self) -> tuple[Array, Array]:
        """Return the rotations and positions [m] of the base and the joints, as ``RigidBodies.place`` takes them."""

    def _place(self, obstacle_poses: Array) -> None:
        """Take the poses of the obstacles, unless they stand there already, and discard the distances of the states."""
        self._pairs = dict[str, PairDistances]()
        self._placed = False
        poses = obstacle_poses[: self._pose_width]
        values = obstacle_poses[self._pose_width :]
        if self._poses is None or not np.array_equal(poses, self._poses):
            self._poses = None
            copied = poses.copy()
            self._solids = solids_of(self.obstacles, copied)
            self._collisions.place(self._solids)
            # Last: after an error the obstacles are placed again.
            self._poses = copied
        self.parameters.set(values)

    def _pairs_of(self, bodies: str) -> PairDistances:
        """Return the signed distances of pairs of bodies, made once per state: "links", "self" or "held object"."""
        if bodies not in self._pairs:
            self._pairs[bodies] = self._make_pairs(bodies)
        return self._pairs[bodies]

    def _make_pairs(self, bodies: str) -> PairDistances:
        """Return the distances of parts of links from obstacles, from each other, or from the held object."""
        if bodies != "held object":
            placed = self._placed_bodies()
            return placed.pair_distances(
                {"self": placed.link_pairs, "links": placed.obstacle_pairs}[bodies]
            )
        if self._held is None:
            raise RecipeError([NO_HELD_SHAPE])
        self._held.place(*self._joint_poses(), [])
        return self._held.pair_distances(self._held.link_pairs)

    def _placed_bodies(self) -> RigidBodies:
        """Return the parts of the robot's links, placed at the states."""
        if self._bodies is None:
            raise RecipeError([NO_SHAPE])
        if not self._placed:
            self._bodies.place(*self._joint_poses(), self._solids)
            self._placed = True
        return self._bodies


class World(RobotWorld[float]):
    """A robot at one state, among the obstacles.

    Constraints evaluate their ``measured`` forms on it. ``set_state`` runs the forward
    kinematics; every other quantity is computed when it is read. Vectors are in the
    world frame. The memory of Pinocchio and Coal is reused: use a world in one process
    and one thread only.

    Args:
        robot: The robot.
        obstacles: The obstacles.
        object_size: Edge lengths of the held object [m], or None.

    Attributes:
        robot: The robot.
        obstacles: The obstacles.
        parameters: Parameters of the sample.
        q: Joint positions [rad], shape (n,).
        dq: Joint velocities [rad/s], shape (n,).
        ddq: Joint accelerations [rad/s^2], shape (n,).
        jerk: Joint jerks [rad/s^3], shape (n,); None at a boundary state or if no
            constraint needs them.
    """

    def _start(self) -> None:
        # Separate: RNEA's accelerations include gravity.
        self._dynamics_data = self._model.createData()
        self._joints = sorted(
            {point for segment in self.robot.capsule_axes for point in segment}
            - {self.robot.n}
        )
        zero = np.zeros(self.robot.n)
        self.set_state(self.robot.home, zero, zero, place_obstacles(self.obstacles))

    def set_state(
        self,
        q: Array,
        dq: Array,
        ddq: Array,
        obstacle_poses: Array,
        jerk: Array | None = None,
    ) -> None:
        """Move to a state.

        Args:
            q: Joint positions [rad], shape (n,).
            dq: Joint velocities [rad/s], shape (n,).
            ddq: Joint accelerations [rad/s^2], shape (n,).
            obstacle_poses: Poses and sizes of the obstacles (``cnpgen.robots.solid``),
                then values for a constraint, then the parameters of the problem, shape
                (width,).
            jerk: Joint jerks [rad/s^3], shape (n,), if the state has any.
        """
        import pinocchio as pin

        self.q = q
        self.dq = dq
        self.ddq = ddq
        self.jerk = jerk
        pin.forwardKinematics(self._model, self._data, q, dq, ddq)
        self._T_world_tip = pin.updateFramePlacement(self._model, self._data, self._tip)
        self._place(obstacle_poses)
        self.__dict__.pop("_segment_distances", None)  # of the last state

    @property
    def torque(self) -> Array:
        """Inverse dynamics of the rigid body [N m], shape (n,)."""
        import pinocchio as pin

        return np.array(
            pin.rnea(self._model, self._dynamics_data, self.q, self.dq, self.ddq)
        )

    @property
    def holding_torque(self) -> Array:
        """Torque that holds the arm still at ``q`` [N m], shape (n,)."""
        import pinocchio as pin

        return np.array(
            pin.computeGeneralizedGravity(self._model, self._dynamics_data, self.q)
        )

    @property
    def tip_position(self) -> Array:
        """Position of the tip [m], shape (3,)."""
        return np.array(self._T_world_tip.translation)

    @property
    def tip_rotation(self) -> Array:
        """Rotation matrix of the tip frame, shape (3, 3)."""
        return np.array(self._T_world_tip.rotation)

    @property
    def tip_velocity(self) -> Array:
        """Linear velocity of the tip [m/s], shape (3,)."""
        return np.array(self._in_world_axes("getFrameVelocity").linear)

    @property
    def tip_angular_velocity(self) -> Array:
        """Angular velocity of the tip [rad/s], shape (3,)."""
        return np.array(self._in_world_axes("getFrameVelocity").angular)

    @property
    def tip_angular_acceleration(self) -> Array:
        """Angular acceleration of the tip [rad/s^2], shape (3,)."""
        return np.array(self._in_world_axes("getFrameAcceleration").angular)

    @property
    def tip_jacobian(self) -> Array:
        """Translational Jacobian of the tip in world axes [m], shape (3, n)."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pin.computeFrameJacobian(
            self._model, self._dynamics_data, self.q, self._tip, frame
        )
        # Pinocchio returns a single column as a vector
        return np.array(jacobian).reshape(6, -1)[:3]

    @property
    def tip_acceleration(self) -> Array:
        """Linear acceleration of the tip [m/s^2], shape (3,)."""
        return np.array(self._in_world_axes("getFrameClassicalAcceleration").linear)

    def _in_world_axes(self, quantity: str) -> Any:
        """Return the motion vector of the tip that a function of Pinocchio computes, in the axes of the world."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return getattr(pin, quantity)(self._model, self._data, self._tip, frame)

    def _smallest(self, bodies: str, sufficient: float) -> list[float]:  # noqa: ARG002 - one state is always exact
        if bodies == "segments":
            return self._segment_distances
        if bodies == "object":
            self._require_object()
            return self._collisions.object_distances(
                self._T_world_tip.translation, self._T_world_tip.rotation
            )
        return [float(distances[0]) for distances in self._pairs_of(bodies).smallest()]

    @cached_property
    def _segment_distances(self) -> list[float]:
        # Of the universe and joints 1 to n.
        poses = self._data.oMi
        points = {
            joint: poses[joint + 1].translation.tolist() for joint in self._joints
        }
        points[self.robot.n] = self._T_world_tip.translation.tolist()
        return self._collisions.segment_distances(
            [(points[a], points[b]) for a, b in self.robot.capsule_axes]
        )

    def _joint_poses(self) -> tuple[Array, Array]:
        """Return the rotations and positions [m] of the base and the joints, as ``RigidBodies.place`` takes them."""
        poses = list(self._data.oMi)
        rotations = np.array([pose.rotation for pose in poses])[..., None]
        return rotations, np.array([pose.translation for pose in poses])[..., None]
