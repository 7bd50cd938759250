"""One robot state as Pinocchio and Coal see it: what the constraints' ``measured`` forms ask of it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.world.bodies import NO_SHAPE, Bodies
from cnpgen.world.scene import Scene

if TYPE_CHECKING:
    from cnpgen.robots.obstacle import Obstacle
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


class World:
    """A robot at one state, among the obstacles.

    ``set_state`` runs the forward kinematics; everything else is computed when it is read. Vectors are in the world
    frame. A world belongs to one process and one thread: Pinocchio's and Coal's memory is reused from state to state.

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
        jerk: Joint jerks [rad/s^3], shape (n,); None at a boundary state, and where no constraint is about them.
    """

    def __init__(
        self,
        robot: "Robot",
        obstacles: "Sequence[Obstacle]" = (),
        object_size: tuple[float, float, float] | None = None,
    ) -> None:
        self.robot, self.obstacles = robot, obstacles
        self._model = robot.model
        self._data = self._model.createData()
        self._dynamics_data = self._model.createData()  # RNEA's accelerations include gravity: kept apart
        self._tip = robot.tip_frame
        self._object_size = object_size
        self._scene = Scene(object_size, len(robot.skeleton))
        self._bodies = None if robot.shape is None else Bodies(robot.shape, len(obstacles), robot.n)
        self._skeleton = robot.skeleton
        self._joints = sorted({point for segment in robot.skeleton for point in segment} - {robot.n})
        zero = np.zeros(robot.n)
        self.set_state(robot.base, zero, zero, place_obstacles(obstacles))

    def set_state(self, q: Array, dq: Array, ddq: Array, tops: Array, jerk: Array | None = None) -> None:
        """Move to a state.

        Args:
            q: Joint positions [rad], shape (n,).
            dq: Joint velocities [rad/s], shape (n,).
            ddq: Joint accelerations [rad/s^2], shape (n,).
            tops: The numbers of the obstacles (``cnpgen.robots.solid``).
            jerk: Joint jerks [rad/s^3], shape (n,), if the state has any.
        """
        import pinocchio as pin

        self.q, self.dq, self.ddq, self.jerk = q, dq, ddq, jerk
        pin.forwardKinematics(self._model, self._data, q, dq, ddq)
        self._T_world_tip = pin.updateFramePlacement(self._model, self._data, self._tip)
        self._solids, self._placed = solids_of(self.obstacles, tops), False
        self._scene.place(self._solids)
        self._distances: list[float] | None = None

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
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return np.array(pin.getFrameVelocity(self._model, self._data, self._tip, frame).linear)

    @property
    def tip_angular_velocity(self) -> Array:
        """Angular velocity of the tip [rad/s], shape (3,)."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return np.array(pin.getFrameVelocity(self._model, self._data, self._tip, frame).angular)

    @property
    def tip_angular_acceleration(self) -> Array:
        """Angular acceleration of the tip [rad/s^2], shape (3,)."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return np.array(pin.getFrameAcceleration(self._model, self._data, self._tip, frame).angular)

    @property
    def tip_jacobian(self) -> Array:
        """Translational Jacobian of the tip in world axes [m], shape (3, n)."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        found = pin.computeFrameJacobian(self._model, self._dynamics_data, self.q, self._tip, frame)
        return np.array(found).reshape(6, -1)[:3]  # Pinocchio gives one column as a vector

    @property
    def tip_acceleration(self) -> Array:
        """Linear acceleration of the tip [m/s^2], shape (3,)."""
        import pinocchio as pin

        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return np.array(pin.getFrameClassicalAcceleration(self._model, self._data, self._tip, frame).linear)

    def segment_distances(self, enough: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is exact
        """Measure how far every segment of the robot's skeleton is from every obstacle, segment by segment [m]."""
        if self._distances is None:
            poses = self._data.oMi  # of the universe and joints 1 to n
            points = {joint: poses[joint + 1].translation.tolist() for joint in self._joints}
            points[self.robot.n] = self._T_world_tip.translation.tolist()
            self._distances = self._scene.segment_distances([(points[a], points[b]) for a, b in self._skeleton])
        return self._distances

    def shape_distances(self, enough: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is exact
        """Measure the signed distance of every moving piece of the robot's shape from every obstacle, one by one [m].

        The smallest is exact, the others are lower bounds above it (``cnpgen.world.sweep.sweep``).

        Raises:
            RecipeError: The robot has no shape.
        """
        bodies = self._placed_bodies()
        return [float(each[0]) for each in bodies.between(bodies.from_obstacles).smallest()]

    def self_distances(self, enough: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is exact
        """Measure the signed distance of every two pieces of the robot's shape that must not touch [m]; likewise."""
        bodies = self._placed_bodies()
        return [float(each[0]) for each in bodies.between(bodies.among_links).smallest()]

    def _placed_bodies(self) -> Bodies:
        """Return the robot's shape where the robot is."""
        if self._bodies is None:
            raise RecipeError([NO_SHAPE])
        if not self._placed:
            poses = list(self._data.oMi)
            rotations = np.array([pose.rotation for pose in poses])[..., None]
            self._bodies.place(rotations, np.array([pose.translation for pose in poses])[..., None], self._solids)
            self._placed = True
        return self._bodies

    def object_distances(self, enough: float = np.inf) -> list[float]:  # noqa: ARG002 - one state is exact
        """Measure the signed distance of the held object from every obstacle [m]; negative is the depth of penetration.

        Raises:
            RecipeError: The problem has no object.
        """
        if self._object_size is None:
            raise RecipeError(["a constraint is about the held object, but the problem has no [object]"])
        return self._scene.object_distances(self._T_world_tip.translation, self._T_world_tip.rotation)
