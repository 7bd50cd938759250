"""K robot states at once as Pinocchio and Coal see them: what the constraints' ``measured`` forms ask along a path."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.world.bodies import NO_SHAPE, Bodies
from cnpgen.world.pairs import PairDistances
from cnpgen.world.scene import Scene
from cnpgen.world.separation import cuboid_gaps, cuboid_separation, gaps, separation
from cnpgen.world.trace import Trace

if TYPE_CHECKING:
    from cnpgen.robots.obstacle import Obstacle
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]
Which = slice | NDArray[np.intp]


class PathWorld:
    """A robot along a path, among the obstacles.

    It answers what ``cnpgen.world.state.World`` answers, with a trailing axis of K states, so that a constraint's
    ``measured`` form, written for one state, gives arrays of shape (K,). ``set_path`` runs the forward kinematics;
    everything else is computed when it is first read. Vectors are in the world frame. A world belongs to one process
    and one thread: Pinocchio's and Coal's memory is reused from path to path.

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
        jerk: Joint jerks [rad/s^3], shape (n, K); None where no constraint is about them.
        tip_position: Positions of the tip [m], shape (3, K).
    """

    def __init__(
        self,
        robot: "Robot",
        obstacles: "Sequence[Obstacle]" = (),
        object_size: tuple[float, float, float] | None = None,
    ) -> None:
        import pinocchio as pin

        self.robot = robot
        self.obstacles = tuple(obstacles)
        self._model = robot.model
        self._data, self._trace = self._model.createData(), Trace(self._model)
        self._pool = pin.ModelPool(self._model, 1)
        self._tip = robot.tip_frame
        frame = self._model.frames[self._tip]
        self._carrier, tip = frame.parentJoint, frame.placement.homogeneous
        self._turn, self._offset = tip[:3, :3], tip[:3, 3].copy()
        self._skeleton = np.array(robot.skeleton, np.int64).reshape(-1, 2)
        self._object_size = None if object_size is None else np.array(object_size)
        self._scene = Scene(object_size, 1)
        self._bodies = None if robot.shape is None else Bodies(robot.shape, len(obstacles), robot.n)
        rest = np.zeros((robot.n, 1))
        self.set_path(robot.base[:, None], rest, rest, place_obstacles(obstacles), rest)

    def set_path(
        self, q: Array, dq: Array, ddq: Array, tops: Array, jerk: Array | None = None, *, exact: bool = True
    ) -> None:
        """Move to K states.

        Args:
            q: Joint positions [rad], shape (n, K), K > 0.
            dq: Joint velocities [rad/s], shape (n, K).
            ddq: Joint accelerations [rad/s^2], shape (n, K).
            tops: The numbers of the obstacles (``cnpgen.robots.solid``).
            jerk: Joint jerks [rad/s^3], shape (n, K), if they are wanted.
            exact: Whether the smallest distance is to be exact even where bounds show that all of them are enough.
        """
        self.q, self.dq, self.ddq, self.jerk, self._exact = q, dq, ddq, jerk, exact
        self._placed = False
        self._torque: Array | None = None
        self._tip_motion: tuple[Array, Array] | None = None
        self._segments: Array | None = None
        self._pairs: dict[str, PairDistances] = {}
        self._solids = solids_of(self.obstacles, tops)
        self._scene.place(self._solids)
        self._move()

    def _move(self) -> None:
        """Run the forward kinematics of every state and keep where the joints and the tip are."""
        self._rotations, self._origins = self._trace.poses(self.q)
        self._tip_rotation: Array | None = None
        along = self._offset @ self._axes_of_tip()
        self.tip_position = along.reshape(3, -1) + self._origins[self._carrier]

    def _axes_of_tip(self) -> Array:
        """Return the axes of the joint that carries the tip, all their components and states in a row, (3, 3 K)."""
        axes: Array = self._rotations[self._carrier].swapaxes(0, 1)
        return axes.reshape(3, -1)

    @property
    def tip_rotation(self) -> Array:
        """Rotation matrices of the tip frame, shape (3, 3, K)."""
        if self._tip_rotation is None:
            self._tip_rotation = (self._turn.T @ self._axes_of_tip()).reshape(3, 3, -1).swapaxes(0, 1)
        return self._tip_rotation

    @property
    def torque(self) -> Array:
        """Inverse dynamics [N m], shape (n, K)."""
        import pinocchio as pin

        if self._torque is None:
            q, dq, ddq = (np.asfortranarray(values) for values in (self.q, self.dq, self.ddq))
            found = pin.rneaInParallel(1, self._pool, q, dq, ddq)
            self._torque = np.array(found).reshape(self.q.shape)  # of one joint Pinocchio returns a list of numbers
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

    def segment_distances(self, enough: float = np.inf) -> list[Array]:
        """Measure the signed distance of every segment of the robot's skeleton from every obstacle, one by one [m].

        Args:
            enough: If all are at least this, bounds of them that show it do where the path is not exact [m].

        Returns:
            Arrays of shape (K,), of which the smallest value is exact; see ``cnpgen.world.sweep.sweep``.
        """
        return self._smallest(self.segment_pairs(), enough)

    def segment_pairs(self) -> PairDistances:
        """Tell the signed distances of every segment of the robot's skeleton from every obstacle, one by one."""
        return self._once("segments", self._from_segments)

    def _from_segments(self) -> PairDistances:
        segments, solids = self.segments(), self._solids
        ends = [(segment, solid) for segment in segments for solid in solids]
        low, high = (pick(segments[:, 0], segments[:, 1]) for pick in (np.minimum, np.maximum))
        bounds = gaps(low, high, solids).reshape(-1, self.q.shape[1])

        def measure(pair: int, k: int) -> tuple[float, Array]:
            a, b = ends[pair][0][..., k].tolist()
            return self._scene.segment_apart(a, b, pair % len(solids))

        def separate(pair: int, direction: Array, which: Which = slice(None), /) -> Array:
            return separation(ends[pair][0][..., which], ends[pair][1], direction)

        return PairDistances(bounds, measure, separate)

    def shape_distances(self, enough: float = np.inf) -> list[Array]:
        """Measure the signed distance of every moving piece of the robot's shape from every obstacle, one by one [m].

        Args:
            enough: As of ``segment_distances``.

        Returns:
            Arrays of shape (K,), of which the smallest value is exact; see ``cnpgen.world.sweep.sweep``.

        Raises:
            RecipeError: The robot has no shape.
        """
        return self._smallest(self.shape_pairs(), enough)

    def shape_pairs(self) -> PairDistances:
        """Tell the signed distances of every moving piece of the robot's shape from every obstacle, one by one."""
        bodies = self._placed_bodies()
        return self._once("shape", lambda: bodies.between(bodies.from_obstacles))

    def self_distances(self, enough: float = np.inf) -> list[Array]:
        """Measure the signed distance of every two pieces of the robot's shape that must not touch [m]; likewise."""
        return self._smallest(self.self_pairs(), enough)

    def self_pairs(self) -> PairDistances:
        """Tell the signed distances of every two pieces of the robot's shape that must not touch."""
        bodies = self._placed_bodies()
        return self._once("self", lambda: bodies.between(bodies.among_links))

    def _smallest(self, pairs: PairDistances, enough: float, *, of_each: bool = False) -> list[Array]:
        """Measure distances of which the smallest, or that of each pair, is exact if it is to be, or not enough."""
        if not self._is_somewhere():
            return [np.full(self.q.shape[1], np.nan) for _ in pairs.bounds]
        if not self._exact and (pairs.bounds >= enough).all():
            return list(pairs.bounds)
        return pairs.smallest_of_each() if of_each else pairs.smallest()

    def _once(self, what: str, make: Callable[[], PairDistances]) -> PairDistances:
        """Return what was made since the robot moved, or make it."""
        if what not in self._pairs:
            self._pairs[what] = make()
        return self._pairs[what]

    def clear_of_obstacles(self, least: float) -> NDArray[np.bool_]:
        """Say at which states all moving pieces of the robot's shape are so far from all obstacles [m], shape (K,)."""
        return self.shape_pairs().clear(least)

    def clear_of_itself(self, least: float) -> NDArray[np.bool_]:
        """Say at which states all pieces of the robot's shape that must not touch are so far apart [m], shape (K,)."""
        return self.self_pairs().clear(least)

    def reach(self, furthest: Array) -> Array:
        """Bound how far a unit of each joint's speed moves any point of the robot, or of what it holds [m].

        Args:
            furthest: Largest absolute joint positions of a motion, shape (n,): they count where joints slide.

        Returns:
            Shape (n,).
        """
        return self._trace.reach(self._spread, furthest)

    @cached_property
    def _spread(self) -> Array:
        """How far from the origins of the base and of every joint what they move reaches [m], shape (n + 1,)."""
        bodies = self._bodies
        spread = np.array([bodies.spread(joint) if bodies else 0.0 for joint in range(self.robot.n + 1)])
        held = 0.0 if self._object_size is None else np.linalg.norm(self._object_size) / 2
        spread[self._carrier] = max(spread[self._carrier], np.linalg.norm(self._offset) + held)
        return spread

    def _placed_bodies(self) -> Bodies:
        """Return the robot's shape where the robot is."""
        if self._bodies is None:
            raise RecipeError([NO_SHAPE])
        if not self._placed:
            self._bodies.place(self._rotations, self._origins, self._solids)
            self._placed = True
        return self._bodies

    def object_distances(self, enough: float = np.inf) -> list[Array]:
        """Measure the signed distance of the held object from every obstacle [m]; negative is the depth of penetration.

        Args:
            enough: As of ``segment_distances``.

        Returns:
            Arrays of shape (K,), of each of which the smallest value is exact; see ``cnpgen.world.sweep.sweep``.

        Raises:
            RecipeError: The problem has no object.
        """
        return self._smallest(self.object_pairs(), enough, of_each=True)

    def object_pairs(self) -> PairDistances:
        """Tell the signed distances of the held object from every obstacle."""
        return self._once("object", self._from_object)

    def _from_object(self) -> PairDistances:
        position, rotation = self.tip_position, self.tip_rotation
        size, solids = self._require_object(), self._solids

        def measure(pair: int, k: int) -> tuple[float, Array]:
            return self._scene.object_apart(position[:, k].copy(), rotation[..., k].copy(), pair)

        def separate(pair: int, direction: Array, which: Which = slice(None), /) -> Array:
            return cuboid_separation(position[:, which], rotation[..., which], size, solids[pair], direction)

        return PairDistances(cuboid_gaps(position, rotation, size, solids), measure, separate)

    def _require_object(self) -> Array:
        """Return the object's edge lengths [m], shape (3,)."""
        if self._object_size is None:
            raise RecipeError(["a constraint is about the held object, but the problem has no [object]"])
        return self._object_size

    def object_corners(self, which: "slice | NDArray[np.bool_]" = slice(None)) -> Array:
        """Compute the corners of the held object [m], shape (8, 3, K).

        Args:
            which: The states that are wanted.

        Raises:
            RecipeError: The problem has no object.
        """
        offsets = CUBE * self._require_object()
        rotation, position = self.tip_rotation[..., which], self.tip_position[:, which]
        return np.asarray(np.tensordot(offsets, rotation, axes=(1, 1)) + position)

    def segments(self) -> Array:
        """Compute both ends of every segment of the robot's skeleton [m], shape (segments, 2, 3, K)."""
        if self._segments is None:
            points = np.concatenate([self._origins[1:], self.tip_position[None]])
            self._segments = points[self._skeleton]
        return self._segments

    def _is_somewhere(self) -> bool:
        return bool(np.isfinite(self._origins).all() and np.isfinite(self.tip_position).all())
