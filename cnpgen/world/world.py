"""A robot among its obstacles at one state, evaluated with Pinocchio and Coal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import place_obstacles, pose_width, solids_of
from cnpgen.world.collision_world import CollisionWorld
from cnpgen.world.measured_parameters import MeasuredParameters
from cnpgen.world.rigid_bodies import NO_HELD_SHAPE, NO_SHAPE, RigidBodies

Array = NDArray[np.float64]


class World:
    """A robot at one state, among the obstacles.

    Constraints evaluate their ``measured`` forms on it. ``set_state`` runs the forward kinematics; every other quantity
    is computed when it is read. Vectors are in the world frame. The memory of Pinocchio and Coal is reused: use a world
    in one process and one thread only.

    Args:
        robot: The robot.
        obstacles: The obstacles.
        object_size: Edge lengths of the held object [m], or None.

    Attributes:
        robot: The robot.
        obstacles: The obstacles.
        q: Joint positions [rad], shape (n,).
        dq: Joint velocities [rad/s], shape (n,).
        ddq: Joint accelerations [rad/s^2], shape (n,).
        jerk: Joint jerks [rad/s^3], shape (n,); None at a boundary state or if no constraint needs them.
        parameters: Parameters of the sample.
    """

    def __init__(
        self,
        robot: Robot,
        obstacles: Sequence[Obstacle] = (),
        object_size: tuple[float, float, float] | None = None,
    ) -> None:
        self.robot, self.obstacles = robot, obstacles
        self.parameters = MeasuredParameters(robot)
        self._model = self.parameters.model
        self._data = self._model.createData()
        self._dynamics_data = self._model.createData()  # separate: RNEA's accelerations include gravity
        self._tip = robot.tip_frame
        self._object_size = object_size
        self._collisions = CollisionWorld(object_size, len(robot.capsule_axes))
        self._bodies = None if robot.shape is None else RigidBodies(robot.shape, len(obstacles), robot.n)
        self._held = None if robot.held_shape is None else RigidBodies(robot.held_shape, 0, robot.n)
        self._segments = robot.capsule_axes
        self._joints = sorted({point for segment in robot.capsule_axes for point in segment} - {robot.n})
        zero = np.zeros(robot.n)
        self.set_state(robot.base, zero, zero, place_obstacles(obstacles))

    def set_state(self, q: Array, dq: Array, ddq: Array, obstacle_poses: Array, jerk: Array | None = None) -> None:
        """Move to a state.

        Args:
            q: Joint positions [rad], shape (n,).
            dq: Joint velocities [rad/s], shape (n,).
            ddq: Joint accelerations [rad/s^2], shape (n,).
            obstacle_poses: Poses and sizes of the obstacles (``cnpgen.robots.solid``), then values for a constraint,
                then the parameters of the problem, shape (width,).
            jerk: Joint jerks [rad/s^3], shape (n,), if the state has any.
        """
        import pinocchio as pin

        self.q, self.dq, self.ddq, self.jerk = q, dq, ddq, jerk
        pin.forwardKinematics(self._model, self._data, q, dq, ddq)
        self._T_world_tip = pin.updateFramePlacement(self._model, self._data, self._tip)
        self._solids, self._placed = solids_of(self.obstacles, obstacle_poses), False
        self.parameters.set(obstacle_poses[pose_width(self.obstacles) :])
        self._collisions.place(self._solids)
        self._distances: list[float] | None = None

    @property
    def scene_values(self) -> Array:
        """Values for a constraint (``Constraint.scene_values``); empty if none were given."""
        return self.parameters.scene_values

    @property
    def torque(self) -> Array:
        """Inverse dynamics [N m], shape (n,)."""
        import pinocchio as pin

        return np.array(pin.rnea(self._model, self._dynamics_data, self.q, self.dq, self.ddq))

    @property
    def holding_torque(self) -> Array:
        """Torque that holds the arm still at ``q`` [N m], shape (n,)."""
        import pinocchio as pin

        return np.array(pin.computeGeneralizedGravity(self._model, self._dynamics_data, self.q))

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
        jacobian = pin.computeFrameJacobian(self._model, self._dynamics_data, self.q, self._tip, frame)
        return np.array(jacobian).reshape(6, -1)[:3]  # Pinocchio returns a single column as a vector

    @property
    def tip_acceleration(self) -> Array:
        """Linear acceleration of the tip [m/s^2], shape (3,)."""
        return np.array(self._in_world_axes("getFrameClassicalAcceleration").linear)

    def _in_world_axes(self, quantity: str) -> Any:
        """Return the motion vector of the tip that a function of Pinocchio computes, in the axes of the world."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return getattr(pin, quantity)(self._model, self._data, self._tip, frame)

    def segment_distances(self, sufficient: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is always exact
        """Measure the signed distance of every segment of the robot from every obstacle, segment by segment [m]."""
        if self._distances is None:
            poses = self._data.oMi  # of the universe and joints 1 to n
            points = {joint: poses[joint + 1].translation.tolist() for joint in self._joints}
            points[self.robot.n] = self._T_world_tip.translation.tolist()
            self._distances = self._collisions.segment_distances([(points[a], points[b]) for a, b in self._segments])
        return self._distances

    def shape_distances(self, sufficient: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is always exact
        """Measure the signed distance of every moving part of the robot's links from every obstacle, part by part [m].

        The smallest is exact, the others are lower bounds above it (``cnpgen.world.pair_distances``).

        Raises:
            RecipeError: The robot has no link geometry.
        """
        bodies = self._placed_bodies()
        return [float(distances[0]) for distances in bodies.pair_distances(bodies.obstacle_pairs).smallest()]

    def self_distances(self, sufficient: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is always exact
        """Measure the signed distance of every two parts of links that must not touch [m]; see ``shape_distances``."""
        bodies = self._placed_bodies()
        return [float(distances[0]) for distances in bodies.pair_distances(bodies.link_pairs).smallest()]

    def _placed_bodies(self) -> RigidBodies:
        """Return the parts of the robot's links, placed at the state."""
        if self._bodies is None:
            raise RecipeError([NO_SHAPE])
        if not self._placed:
            self._bodies.place(*self._joint_poses(), self._solids)
            self._placed = True
        return self._bodies

    def _joint_poses(self) -> tuple[Array, Array]:
        """Return the rotations and positions [m] of the base and the joints, as ``RigidBodies.place`` takes them."""
        poses = list(self._data.oMi)
        rotations = np.array([pose.rotation for pose in poses])[..., None]
        return rotations, np.array([pose.translation for pose in poses])[..., None]

    def held_object_distances(self, sufficient: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is always exact
        """Measure the signed distance of the held object from parts of links [m]; see ``shape_distances``.

        Raises:
            RecipeError: The robot has no geometry for it.
        """
        if self._held is None:
            raise RecipeError([NO_HELD_SHAPE])
        self._held.place(*self._joint_poses(), [])
        return [float(distances[0]) for distances in self._held.pair_distances(self._held.link_pairs).smallest()]

    def object_distances(self, sufficient: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is always exact
        """Measure the signed distance of the held object from every obstacle [m], negative if they overlap.

        Raises:
            RecipeError: The problem has no held object.
        """
        if self._object_size is None:
            raise RecipeError(["a constraint needs the held object, but the problem has no [object]"])
        return self._collisions.object_distances(self._T_world_tip.translation, self._T_world_tip.rotation)
