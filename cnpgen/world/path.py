"""A robot among its obstacles at K states at once, evaluated with Pinocchio and Coal."""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.solid import Solid, place_obstacles, pose_width, solids_of
from cnpgen.world.collision_world import CollisionWorld
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.measured_parameters import MeasuredParameters
from cnpgen.world.pair_distances import PairDistances
from cnpgen.world.rigid_bodies import NO_HELD_SHAPE, NO_SHAPE, RigidBodies
from cnpgen.world.separation import cuboid_gaps, cuboid_separation, gaps, separation

Array = NDArray[np.float64]
States = slice | NDArray[np.intp]


class PathWorld:
    """A robot along a path, among the obstacles.

    It has the interface of ``cnpgen.world.world.World`` with a trailing axis of K states, so that a constraint's
    ``measured`` form, written for one state, returns arrays of shape (K,). ``set_path`` runs the forward kinematics;
    every other quantity is computed when it is first read. Vectors are in the world frame. The memory of Pinocchio and
    Coal is reused from path to path: use a world in one process and one thread only.

    Args:
        robot: The robot.
        obstacles: The obstacles.
        object_size: Edge lengths of the held object [m], or None.

    Attributes:
        robot: The robot.
        obstacles: The obstacles.
        q: Joint positions [rad], shape (n, K).
        dq: Joint velocities [rad/s], shape (n, K).
        ddq: Joint accelerations [rad/s^2], shape (n, K).
        jerk: Joint jerks [rad/s^3], shape (n, K); None if no constraint needs them.
        tip_position: Positions of the tip [m], shape (3, K).
        parameters: Parameters of the sample.
    """

    def __init__(
        self,
        robot: Robot,
        obstacles: Sequence[Obstacle] = (),
        object_size: tuple[float, float, float] | None = None,
    ) -> None:
        import pinocchio as pin

        self.robot = robot
        self.obstacles = tuple(obstacles)
        self.parameters = MeasuredParameters(robot)
        self._model = self.parameters.model
        self._data, self._kinematics = self._model.createData(), ForwardKinematics(self._model)
        self._pool = pin.ModelPool(self._model, 1)
        self._tip = robot.tip_frame
        frame = self._model.frames[self._tip]
        self._carrier, tip = frame.parentJoint, frame.placement.homogeneous
        self._turn, self._offset = tip[:3, :3], tip[:3, 3].copy()
        self._segment_ends = np.array(robot.capsule_axes, np.int64).reshape(-1, 2)
        self._object_size = None if object_size is None else np.array(object_size)
        self._collisions = CollisionWorld(object_size, 1)
        self._bodies = None if robot.shape is None else RigidBodies(robot.shape, len(obstacles), robot.n)
        self._held = None if robot.held_shape is None else RigidBodies(robot.held_shape, 0, robot.n)
        self._pose_width, self._solids = pose_width(self.obstacles), list[Solid]()
        self._poses: Array | None = None
        rest = np.zeros((robot.n, 1))
        self.set_path(robot.base[:, None], rest, rest, place_obstacles(obstacles), rest)

    def set_path(
        self, q: Array, dq: Array, ddq: Array, obstacle_poses: Array, jerk: Array | None = None, *, exact: bool = True
    ) -> None:
        """Move to K states.

        Args:
            q: Joint positions [rad], shape (n, K), K > 0; the other arrays of joints have the same shape.
            dq: Joint velocities [rad/s].
            ddq: Joint accelerations [rad/s^2].
            obstacle_poses: Poses and sizes of the obstacles (``cnpgen.robots.solid``), then values for a constraint,
                then the parameters of the problem, shape (width,).
            jerk: Joint jerks [rad/s^3], or None if no constraint needs them.
            exact: Whether the smallest distance must be exact even if bounds prove that all distances are sufficient.
        """
        import pinocchio as pin

        self.q, self.dq, self.ddq, self.jerk, self._exact = q, dq, ddq, jerk, exact
        self._placed = False
        self._torque: Array | None = None
        self._tip_motion: tuple[Array, Array] | None = None
        self._segments: Array | None = None
        self._pairs: dict[str, PairDistances] = {}
        self._place_obstacles(obstacle_poses[: self._pose_width])
        self.parameters.set(obstacle_poses[self._pose_width :])
        if self.parameters.changes_payload:
            self._pool = pin.ModelPool(self._model, 1)  # a pool has its own copy of the model
        self._move()

    def _place_obstacles(self, poses: Array) -> None:
        """Move the obstacles, unless they stand there already."""
        if self._poses is None or not np.array_equal(poses, self._poses):
            self._poses, copied = None, poses.copy()
            self._solids = solids_of(self.obstacles, copied)
            self._collisions.place(self._solids)
            self._poses = copied  # last: after an error the obstacles are placed again

    def _move(self) -> None:
        """Run the forward kinematics of every state and store the poses of the joints and the tip."""
        self._rotations, self._origins = self._kinematics.poses(self.q)
        self._tip_rotation: Array | None = None
        along = self._offset @ self._axes_of_tip()
        self.tip_position = along.reshape(3, -1) + self._origins[self._carrier]

    def _axes_of_tip(self) -> Array:
        """Return the axes of the joint that carries the tip, components and states flattened, shape (3, 3 K)."""
        axes: Array = self._rotations[self._carrier].swapaxes(0, 1)
        return axes.reshape(3, -1)

    @property
    def tip_rotation(self) -> Array:
        """Rotation matrices of the tip frame, shape (3, 3, K)."""
        if self._tip_rotation is None:
            self._tip_rotation = (self._turn.T @ self._axes_of_tip()).reshape(3, 3, -1).swapaxes(0, 1)
        return self._tip_rotation

    @property
    def scene_values(self) -> Array:
        """Values for a constraint (``Constraint.scene_values``); empty if none were given."""
        return self.parameters.scene_values

    @property
    def torque(self) -> Array:
        """Inverse dynamics [N m], shape (n, K)."""
        import pinocchio as pin

        if self._torque is None:
            q, dq, ddq = (np.asfortranarray(values) for values in (self.q, self.dq, self.ddq))
            torque = pin.rneaInParallel(1, self._pool, q, dq, ddq)
            self._torque = np.array(torque).reshape(self.q.shape)  # for one joint Pinocchio returns a list of numbers
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
            motions = np.array([self._tip_motion_at(*state) for state in zip(*states, strict=True)])
            velocity, acceleration = np.ascontiguousarray(motions.transpose(1, 2, 0))
            self._tip_motion = velocity, acceleration
        return self._tip_motion

    def _tip_motion_at(self, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array]:
        """Compute the velocity [m/s] and acceleration [m/s^2] of the tip at one state, shape (3,) each."""
        import pinocchio as pin

        model, data, tip, frame = self._model, self._data, self._tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        pin.forwardKinematics(model, data, q, dq, ddq)
        velocity = np.array(pin.getFrameVelocity(model, data, tip, frame).linear)
        return velocity, np.array(pin.getFrameClassicalAcceleration(model, data, tip, frame).linear)

    def segment_distances(self, sufficient: float = np.inf) -> list[Array]:
        """Measure the signed distance of every segment of the robot from every obstacle, segment by segment [m].

        If the path is not exact, sufficient lower bounds are returned without measuring.

        Returns:
            Arrays of shape (K,), of which the smallest value is exact (``cnpgen.world.pair_distances``).
        """
        return self._smallest(self.segment_pairs(), sufficient)

    def segment_pairs(self) -> PairDistances:
        """Return the signed distances of every segment of the robot from every obstacle, segment by segment."""
        return self._once("segments", self._from_segments)

    def _from_segments(self) -> PairDistances:
        segments, solids = self.segments(), self._solids
        pairs = [(segment, solid) for segment in segments for solid in solids]
        low, high = (select(segments[:, 0], segments[:, 1]) for select in (np.minimum, np.maximum))
        bounds = gaps(low, high, solids).reshape(-1, self.q.shape[1])

        def measure(pair: int, k: int) -> tuple[float, Array]:
            a, b = pairs[pair][0][..., k].tolist()
            return self._collisions.segment_distance(a, b, pair % len(solids))

        def separation_along(pair: int, direction: Array, states: States = slice(None), /) -> Array:
            return separation(pairs[pair][0][..., states], pairs[pair][1], direction)

        return PairDistances(bounds, measure, separation_along)

    def shape_distances(self, sufficient: float = np.inf) -> list[Array]:
        """Measure the signed distance of every moving part of the robot's links from every obstacle, part by part [m].

        See ``segment_distances``.

        Raises:
            RecipeError: The robot has no link geometry.
        """
        return self._smallest(self.shape_pairs(), sufficient)

    def shape_pairs(self) -> PairDistances:
        """Return the signed distances of every moving part of the robot's links from every obstacle, part by part."""
        bodies = self._placed_bodies()
        return self._once("shape", lambda: bodies.pair_distances(bodies.obstacle_pairs))

    def self_distances(self, sufficient: float = np.inf) -> list[Array]:
        """Measure the signed distance of every two parts of links that must not touch [m]; see ``shape_distances``."""
        return self._smallest(self.self_pairs(), sufficient)

    def self_pairs(self) -> PairDistances:
        """Return the signed distances of every two parts of links that must not touch."""
        bodies = self._placed_bodies()
        return self._once("self", lambda: bodies.pair_distances(bodies.link_pairs))

    def pairs(self, bodies: str) -> PairDistances:
        """Return the signed distances of all pairs of some bodies.

        Args:
            bodies: "robot": links, or segments without link geometry, and obstacles; "self": links of the robot;
                "object": the held object and obstacles; "held object": the held object and links.
        """
        if bodies == "robot":
            return self.segment_pairs() if self.robot.shape is None else self.shape_pairs()
        pairs = {"self": self.self_pairs, "object": self.object_pairs, "held object": self.held_object_pairs}
        return pairs[bodies]()

    def _smallest(self, pairs: PairDistances, sufficient: float, *, of_each: bool = False) -> list[Array]:
        """Measure distances, or return their bounds if the path is not exact and all bounds are sufficient."""
        if not self._is_finite():
            return [np.full(self.q.shape[1], np.nan) for _ in pairs.bounds]
        if not self._exact and (pairs.bounds >= sufficient).all():
            return list(pairs.bounds)
        return pairs.smallest_of_each() if of_each else pairs.smallest()

    def _once(self, name: str, make: Callable[[], PairDistances]) -> PairDistances:
        """Return the distances of a name; make them once per path."""
        if name not in self._pairs:
            self._pairs[name] = make()
        return self._pairs[name]

    def held_object_distances(self, sufficient: float = np.inf) -> list[Array]:
        """Measure the signed distance of the held object from parts of links [m]; see ``shape_distances``."""
        return self._smallest(self.held_object_pairs(), sufficient)

    def held_object_pairs(self) -> PairDistances:
        """Return the signed distances of the held object from every part of the links that may not touch it.

        Raises:
            RecipeError: The robot has no geometry for it.
        """
        bodies = self._held
        if bodies is None:
            raise RecipeError([NO_HELD_SHAPE])
        if "held" not in self._pairs:
            bodies.place(self._rotations, self._origins, [])
        return self._once("held", lambda: bodies.pair_distances(bodies.link_pairs))

    def motion_bounds(self, max_positions: Array) -> Array:
        """Bound the displacement of any point of the robot or the held object per unit of motion of each joint [m].

        Largest absolute joint positions, shape (n,), are needed for prismatic joints (Schwarzer et al. 2005).
        """
        return self._kinematics.motion_bounds(self._extents, max_positions)

    @cached_property
    def _extents(self) -> Array:
        """Largest distance of a point of each link from the origin of the base or of its joint [m], shape (n + 1,)."""
        groups = [bodies for bodies in (self._bodies, self._held) if bodies is not None]
        joints = range(self.robot.n + 1)
        extents = np.array([max((bodies.extent(joint) for bodies in groups), default=0.0) for joint in joints])
        held = 0.0 if self._object_size is None else np.linalg.norm(self._object_size) / 2
        extents[self._carrier] = max(extents[self._carrier], np.linalg.norm(self._offset) + held)
        return extents

    def _placed_bodies(self) -> RigidBodies:
        """Return the parts of the robot's links, placed at the states."""
        if self._bodies is None:
            raise RecipeError([NO_SHAPE])
        if not self._placed:
            self._bodies.place(self._rotations, self._origins, self._solids)
            self._placed = True
        return self._bodies

    def object_distances(self, sufficient: float = np.inf) -> list[Array]:
        """Measure the signed distance of the held object from every obstacle [m]; see ``segment_distances``.

        The smallest value of each array is exact.

        Raises:
            RecipeError: The problem has no held object.
        """
        return self._smallest(self.object_pairs(), sufficient, of_each=True)

    def object_pairs(self) -> PairDistances:
        """Return the signed distances of the held object from every obstacle."""
        return self._once("object", self._from_object)

    def _from_object(self) -> PairDistances:
        position, rotation = self.tip_position, self.tip_rotation
        size, solids = self._require_object(), self._solids

        def measure(pair: int, k: int) -> tuple[float, Array]:
            return self._collisions.object_distance(position[:, k].copy(), rotation[..., k].copy(), pair)

        def separation_along(pair: int, direction: Array, states: States = slice(None), /) -> Array:
            return cuboid_separation(position[:, states], rotation[..., states], size, solids[pair], direction)

        return PairDistances(cuboid_gaps(position, rotation, size, solids), measure, separation_along)

    def _require_object(self) -> Array:
        """Return the edge lengths of the held object [m], shape (3,)."""
        if self._object_size is None:
            raise RecipeError(["a constraint needs the held object, but the problem has no [object]"])
        return self._object_size

    def object_corners(self, states: "slice | NDArray[np.bool_]" = slice(None)) -> Array:
        """Compute the corners of the held object at a slice or a mask of the states [m], shape (8, 3, K).

        Raises:
            RecipeError: The problem has no held object.
        """
        offsets = CUBE * self._require_object()
        rotation, position = self.tip_rotation[..., states], self.tip_position[:, states]
        return np.asarray(np.tensordot(offsets, rotation, axes=(1, 1)) + position)

    def segments(self) -> Array:
        """Compute both ends of every segment of the robot [m], shape (segments, 2, 3, K)."""
        if self._segments is None:
            points = np.concatenate([self._origins[1:], self.tip_position[None]])
            self._segments = points[self._segment_ends]
        return self._segments

    def _is_finite(self) -> bool:
        """Return whether the poses of the joints and the tip are finite."""
        return bool(np.isfinite(self._origins).all() and np.isfinite(self.tip_position).all())
