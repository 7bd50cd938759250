"""K robot states at once as Pinocchio and Coal see them: what the constraints' ``measured`` forms ask along a path."""

from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.verify.scene import Scene
from cnpgen.verify.sweep import Measure, sweep, travel_of

if TYPE_CHECKING:
    from cnpgen.recipes import Problem
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))


class PathWorld:
    """The robot of a problem along a path, among the obstacles.

    It answers what ``cnpgen.verify.world.World`` answers, with a trailing axis of K states, so that a constraint's
    ``measured`` form, written for one state, gives arrays of shape (K,). ``set_path`` runs the forward kinematics;
    everything else is computed when it is first read. Vectors are in the world frame. A world belongs to one process
    and one thread: Pinocchio's and Coal's memory is reused from path to path.

    Args:
        problem: The problem.
        robot: Its robot.

    Attributes:
        robot: The robot.
        q: Joint positions [rad], shape (n, K).
        dq: Joint velocities [rad/s], shape (n, K).
        ddq: Joint accelerations [rad/s^2], shape (n, K).
        tip_position: Positions of the tip [m], shape (3, K).
        tip_rotation: Rotation matrices of the tip frame, shape (3, 3, K).
    """

    def __init__(self, problem: "Problem", robot: "Robot") -> None:
        import pinocchio as pin

        self.robot = robot
        self._model = robot.model
        self._data = self._model.createData()
        self._pool = pin.ModelPool(self._model, 1)
        self._tip = self._model.getFrameId(robot.tip)
        self._object_size = None if problem.object is None else problem.object.size
        self._n_boxes = len(problem.obstacle)
        self._segment_scene = Scene(problem.obstacle, None, 1)
        self._object_scene = Scene(problem.obstacle, self._object_size, 0)
        rest = np.zeros((robot.n, 1))
        self.set_path(robot.base[:, None], rest, rest, np.zeros(self._n_boxes))

    def set_path(self, q: Array, dq: Array, ddq: Array, tops: Array) -> None:
        """Move to K states.

        Args:
            q: Joint positions [rad], shape (n, K), K > 0.
            dq: Joint velocities [rad/s], shape (n, K).
            ddq: Joint accelerations [rad/s^2], shape (n, K).
            tops: Heights of the obstacles' upper faces [m], shape (n_obstacles,).
        """
        import pinocchio as pin

        self.q, self.dq, self.ddq = q, dq, ddq
        self._torque: Array | None = None
        self._tip_motion: tuple[Array, Array] | None = None
        move, place = pin.forwardKinematics, pin.updateFramePlacement
        model, data, tip = self._model, self._data, self._tip
        poses = np.empty((q.shape[1], 4, 4))
        for k, state in enumerate(np.ascontiguousarray(q.T)):
            move(model, data, state)
            poses[k] = place(model, data, tip).homogeneous
        self.tip_position = np.ascontiguousarray(poses[:, :3, 3].T)
        self.tip_rotation = np.ascontiguousarray(poses[:, :3, :3].transpose(1, 2, 0))
        self._segment_scene.set_tops(tops.tolist())
        self._object_scene.set_tops(tops.tolist())

    @property
    def torque(self) -> Array:
        """Inverse dynamics [N m], shape (n, K)."""
        import pinocchio as pin

        if self._torque is None:
            q, dq, ddq = (np.asfortranarray(values) for values in (self.q, self.dq, self.ddq))
            self._torque = np.array(pin.rneaInParallel(1, self._pool, q, dq, ddq))
        return self._torque

    @property
    def tip_velocity(self) -> Array:
        """Linear velocities of the tip [m/s], shape (3, K)."""
        return self._moving_tip()[0]

    @property
    def tip_acceleration(self) -> Array:
        """Linear accelerations of the tip [m/s^2], shape (3, K)."""
        return self._moving_tip()[1]

    def tip_velocity_at(self, k: int) -> Array:
        """Linear velocity of the tip at one of the states [m/s], shape (3,)."""
        return self._tip_motion_at(*(np.ascontiguousarray(values[:, k]) for values in (self.q, self.dq, self.ddq)))[0]

    def _moving_tip(self) -> tuple[Array, Array]:
        if self._tip_motion is None:
            states = (np.ascontiguousarray(values.T) for values in (self.q, self.dq, self.ddq))
            found = np.array([self._tip_motion_at(*state) for state in zip(*states, strict=True)])
            velocity, acceleration = np.ascontiguousarray(found.transpose(1, 2, 0))
            self._tip_motion = velocity, acceleration
        return self._tip_motion

    def _tip_motion_at(self, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array]:
        """Velocity [m/s] and acceleration [m/s^2] of the tip at one state, each of shape (3,)."""
        import pinocchio as pin

        model, data, tip, frame = self._model, self._data, self._tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        pin.forwardKinematics(model, data, q, dq, ddq)
        velocity = np.array(pin.getFrameVelocity(model, data, tip, frame).linear)
        return velocity, np.array(pin.getFrameClassicalAcceleration(model, data, tip, frame).linear)

    def segment_distances(self) -> list[Array]:
        """Measure how far every segment of the robot's skeleton is from every obstacle, segment by segment [m].

        Returns:
            Arrays of shape (K,), of which the smallest value is exact; see ``cnpgen.verify.sweep.sweep``.
        """
        segments = self.segments()
        if not np.all(np.isfinite(segments)):
            return self._unknown(len(segments) * self._n_boxes)

        def measure(segment: Array, k: int) -> list[float]:
            a, b = segment[..., k].tolist()
            return self._segment_scene.segment_distances([(a, b)])

        travel = np.array([travel_of(segment) for segment in segments])
        return self._swept([partial(measure, segment) for segment in segments], travel, floor=0.0)

    def object_distances(self) -> list[Array]:
        """Measure the signed distance of the held object from every obstacle [m]; negative is the depth of penetration.

        Returns:
            Arrays of shape (K,), of which the smallest value is exact; see ``cnpgen.verify.sweep.sweep``.

        Raises:
            RecipeError: The problem has no object.
        """
        corners = self.object_corners()
        if not np.all(np.isfinite(corners)):
            return self._unknown(self._n_boxes)
        positions, rotations = self.tip_position.T.copy(), self.tip_rotation.transpose(2, 0, 1).copy()

        def measure(k: int) -> list[float]:
            return self._object_scene.object_distances(positions[k], rotations[k])

        return self._swept([measure], travel_of(corners)[None])

    def _swept(self, measures: list[Measure], travel: Array, floor: float = -np.inf) -> list[Array]:
        return [distances for body in sweep(measures, travel, floor=floor) for distances in body]

    def object_corners(self) -> Array:
        """Compute the corners of the held object [m], shape (8, 3, K).

        Raises:
            RecipeError: The problem has no object.
        """
        if self._object_size is None:
            raise RecipeError(["a constraint is about the held object, but the problem has no [object]"])
        offsets = _CORNERS * np.array(self._object_size)
        return np.asarray(np.tensordot(offsets, self.tip_rotation, axes=(1, 1)) + self.tip_position)

    def segments(self) -> Array:
        """Compute both ends of every segment of the robot's skeleton [m], shape (segments, 2, 3, K)."""
        import pinocchio as pin

        move, model, data, n = pin.forwardKinematics, self._model, self._data, self.robot.n
        used = sorted({point for segment in self.robot.skeleton for point in segment} - {n})
        poses = [(joint, data.oMi[joint + 1]) for joint in used]  # references: they follow the kinematics
        origins = np.zeros((self.q.shape[1], n + 1, 3))
        origins[:, n] = self.tip_position.T
        for state, found in zip(np.ascontiguousarray(self.q.T), origins, strict=True):
            move(model, data, state)
            for joint, pose in poses:
                found[joint] = pose.translation
        pairs = np.array(self.robot.skeleton, np.int64).reshape(-1, 2)
        return origins.transpose(1, 2, 0)[pairs]

    def _unknown(self, count: int) -> list[Array]:
        return [np.full(self.q.shape[1], np.nan) for _ in range(count)]
