"""A robot among its obstacles at K states at once, evaluated with Pinocchio and Coal.

Faces of the boxes, and of the held object, bound distances at all states at once.
Better directions come from measurements (``cnpgen.world.pair_distances``). Cuboids have
centers [m], shape (3, K), rotation matrices, shape (3, 3, K), and edge lengths [m],
shape (3,).
"""

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.convex_solid import Solid
from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.solid import place_obstacles
from cnpgen.world.certified import PlacedBody, convex_body, placed_solid
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.pair_distances import Indices, PairDistances
from cnpgen.world.world import RobotWorld

_CACHED = ("tip_rotation", "torque", "_tip_motion")  # of one path
_AT_ORIGIN = np.eye(3), np.zeros(3)


class PathWorld(RobotWorld[Array]):
    """A robot along a path, among the obstacles.

    It has the interface of ``cnpgen.world.world.World`` with a trailing axis of K
    states, so that a constraint's ``measured`` form, written for one state, returns
    arrays of shape (K,). ``set_path`` runs the forward kinematics; every other quantity
    is computed when it is first read. For arguments and further attributes see
    ``RobotWorld``.

    Attributes:
        q: Joint positions [rad], shape (n, K).
        dq: Joint velocities [rad/s], shape (n, K).
        ddq: Joint accelerations [rad/s^2], shape (n, K).
        jerk: Joint jerks [rad/s^3], shape (n, K); None if no constraint needs them.
        tip_position: Positions of the tip [m], shape (3, K).
    """

    def _start(self) -> None:
        import pinocchio as pin

        self._kinematics = ForwardKinematics(self._model)
        self._pool = pin.ModelPool(self._model, 1)
        frame = self._model.frames[self._tip]
        self._carrier = frame.parentJoint
        tip = frame.placement.homogeneous
        # T_joint_tip is constant, so the tip follows from the joint that carries it.
        self._turn = tip[:3, :3]
        self._offset = tip[:3, 3].copy()
        self._segment_ends = np.array(self.robot.capsule_axes, np.int64).reshape(-1, 2)
        rest = np.zeros((self.robot.n, 1))
        self.set_path(
            self.robot.home[:, None], rest, rest, place_obstacles(self.obstacles), rest
        )

    def set_path(
        self,
        q: Array,
        dq: Array,
        ddq: Array,
        obstacle_poses: Array,
        jerk: Array | None = None,
        *,
        exact: bool = True,
    ) -> None:
        """Move to K states.

        Args:
            q: Joint positions [rad], shape (n, K), K > 0; the other arrays of joints
                have the same shape.
            dq: Joint velocities [rad/s].
            ddq: Joint accelerations [rad/s^2].
            obstacle_poses: Poses and sizes of the obstacles (``cnpgen.robots.solid``),
                then values for a constraint, then the parameters of the problem, shape
                (width,).
            jerk: Joint jerks [rad/s^3], or None if no constraint needs them.
            exact: Whether the smallest distance must be exact even if bounds prove that
                all distances are sufficient.
        """
        import pinocchio as pin

        self.q = q
        self.dq = dq
        self.ddq = ddq
        self.jerk = jerk
        self._exact = exact
        for name in _CACHED:
            self.__dict__.pop(name, None)
        self._place(obstacle_poses)
        if self.parameters.changes_payload:
            # A pool has its own copy of the model.
            self._pool = pin.ModelPool(self._model, 1)
        self._rotations, self._origins = self._kinematics.poses(self.q)
        # R offset for all states at once: axes are flattened to 3 x (3 K).
        along = self._offset @ self._axes_of_tip()
        self.tip_position = along.reshape(3, -1) + self._origins[self._carrier]

    def _axes_of_tip(self) -> Array:
        """Return the axes of the joint that carries the tip, components and states flattened, shape (3, 3 K)."""
        axes: Array = self._rotations[self._carrier].swapaxes(0, 1)
        return axes.reshape(3, -1)

    @cached_property
    def tip_rotation(self) -> Array:
        """Rotation matrices of the tip frame, shape (3, 3, K)."""
        axes: Array = self._turn.T @ self._axes_of_tip()
        return axes.reshape(3, 3, -1).swapaxes(0, 1)

    @cached_property
    def torque(self) -> Array:
        """Inverse dynamics of the rigid body [N m], shape (n, K)."""
        import pinocchio as pin

        q, dq, ddq = (
            np.asfortranarray(values) for values in (self.q, self.dq, self.ddq)
        )
        torque = pin.rneaInParallel(1, self._pool, q, dq, ddq)
        # For one joint Pinocchio returns a list of numbers.
        return np.array(torque).reshape(self.q.shape)

    @property
    def tip_velocity(self) -> Array:
        """Linear velocities of the tip [m/s], shape (3, K)."""
        return np.asarray(self._tip_motion[0])

    @property
    def tip_acceleration(self) -> Array:
        """Linear accelerations of the tip [m/s^2], shape (3, K)."""
        return np.asarray(self._tip_motion[1])

    @cached_property
    def _tip_motion(self) -> Array:
        """Velocity [m/s] and acceleration [m/s^2] of the tip, shape (2, 3, K)."""
        states = (
            np.ascontiguousarray(values.T) for values in (self.q, self.dq, self.ddq)
        )
        motions = np.array(
            [self._tip_motion_at(*state) for state in zip(*states, strict=True)]
        )
        return np.ascontiguousarray(motions.transpose(1, 2, 0))

    def tip_velocity_at(self, k: int) -> Array:
        """Linear velocity of the tip at one of the states [m/s], shape (3,)."""
        return self._tip_motion_at(
            *(
                np.ascontiguousarray(values[:, k])
                for values in (self.q, self.dq, self.ddq)
            )
        )[0]

    def _tip_motion_at(self, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array]:
        """Compute the velocity [m/s] and acceleration [m/s^2] of the tip at one state, shape (3,) each."""
        import pinocchio as pin

        model = self._model
        data = self._data
        tip = self._tip
        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        pin.forwardKinematics(model, data, q, dq, ddq)
        velocity = np.array(pin.getFrameVelocity(model, data, tip, frame).linear)
        return velocity, np.array(
            pin.getFrameClassicalAcceleration(model, data, tip, frame).linear
        )

    def pairs(self, bodies: str) -> PairDistances:
        """Return the signed distances of all pairs of some bodies.

        Args:
            bodies: "robot": links, or segments without link geometry, and obstacles,
                body by body; "self": links of the robot; "object": the held object and
                obstacles; "held object": the held object and links.

        Raises:
            RecipeError: The robot has no link geometry, or the problem has no held
                object, as required.
        """
        if bodies == "robot":
            bodies = "segments" if self.robot.shape is None else "links"
        return self._pairs_of(bodies)

    def _make_pairs(self, bodies: str) -> PairDistances:
        if bodies == "segments":
            return self._from_segments()
        return (
            self._from_object() if bodies == "object" else super()._make_pairs(bodies)
        )

    def _joint_poses(self) -> tuple[Array, Array]:
        return self._rotations, self._origins

    def _smallest(self, bodies: str, sufficient: float) -> list[Array]:
        pairs = self._pairs_of(bodies)
        # A state that is not finite has no distances, which is no error of Coal.
        if not (
            np.isfinite(self._origins).all() and np.isfinite(self.tip_position).all()
        ):
            return [np.full(self.q.shape[1], np.nan) for _ in pairs.bounds]
        sufficient = math.inf if self._exact else sufficient
        if (pairs.bounds >= sufficient).all():
            return list(pairs.bounds)
        return (
            pairs.smallest_of_each()
            if bodies == "object"
            else pairs.smallest(sufficient)
        )

    def _from_segments(self) -> PairDistances:
        segments = self.segments()
        solids = self._solids
        # Boxes around segments: their bounds need no call of Coal.
        pairs = [(segment, solid) for segment in segments for solid in solids]
        low, high = (
            select(segments[:, 0], segments[:, 1])
            for select in (np.minimum, np.maximum)
        )
        bounds = gaps(low, high, solids).reshape(-1, self.q.shape[1])

        def measure(pair: int, k: int) -> tuple[float, Array]:
            a, b = pairs[pair][0][..., k].tolist()
            return self._collisions.segment_distance(a, b, pair % len(solids))

        def separation_along(pair: int, direction: Array, states: Indices) -> Array:
            return separation(pairs[pair][0][..., states], pairs[pair][1], direction)

        def bodies_at(pair: int, k: int) -> tuple[PlacedBody, PlacedBody]:
            segment, solid = pairs[pair]
            return (convex_body(segment[..., k].copy()), _AT_ORIGIN), placed_solid(
                solid
            )

        return PairDistances(bounds, measure, separation_along, bodies_at)

    def _from_object(self) -> PairDistances:
        position = self.tip_position
        rotation = self.tip_rotation
        size = self._require_object()
        solids = self._solids

        def measure(pair: int, k: int) -> tuple[float, Array]:
            return self._collisions.object_distance(
                position[:, k].copy(), rotation[..., k].copy(), pair
            )

        def separation_along(pair: int, direction: Array, states: Indices) -> Array:
            return cuboid_separation(
                position[:, states],
                rotation[..., states],
                size,
                solids[pair],
                direction,
            )

        def bodies_at(pair: int, k: int) -> tuple[PlacedBody, PlacedBody]:
            pose = rotation[..., k].copy(), position[:, k].copy()
            return (convex_body(CUBE * size), pose), placed_solid(solids[pair])

        return PairDistances(
            cuboid_gaps(position, rotation, size, solids),
            measure,
            separation_along,
            bodies_at,
        )

    def motion_bounds(self, max_positions: Array) -> Array:
        """Bound the displacement of any point of the robot or the held object per unit of motion of each joint [m].

        Largest absolute joint positions, shape (n,), are needed for prismatic joints
        (Schwarzer et al. 2005).
        """
        return self._kinematics.motion_bounds(self._extents, max_positions)

    @cached_property
    def _extents(self) -> Array:
        """Largest distance of a point of each link from the origin of the base or of its joint [m], shape (n + 1,)."""
        groups = [bodies for bodies in (self._bodies, self._held) if bodies is not None]
        joints = range(self.robot.n + 1)
        extents = np.array(
            [
                max((bodies.extent(joint) for bodies in groups), default=0.0)
                for joint in joints
            ]
        )
        held = (
            0.0 if self._object_size is None else np.linalg.norm(self._object_size) / 2
        )
        extents[self._carrier] = max(
            extents[self._carrier], np.linalg.norm(self._offset) + held
        )
        return extents

    def object_corners(
        self, states: "slice | NDArray[np.bool_]" = slice(None)
    ) -> Array:
        """Compute the corners of the held object at a slice or a mask of the states [m], shape (8, 3, K).

        Raises:
            RecipeError: The problem has no held object.
        """
        offsets = CUBE * self._require_object()
        rotation = self.tip_rotation[..., states]
        position = self.tip_position[:, states]
        return np.asarray(np.tensordot(offsets, rotation, axes=(1, 1)) + position)

    def segments(self) -> Array:
        """Compute both ends of every segment of the robot [m], shape (segments, 2, 3, K)."""
        points = np.concatenate([self._origins[1:], self.tip_position[None]])
        return np.asarray(points[self._segment_ends])


def separation(vertices: Array, solid: Solid, direction: Array) -> Array:
    """Compute the separation of a convex body from a solid along a direction, at every state [m], shape (K,).

    Vertices of the body [m] have shape (V, 3, K); the direction is a unit vector from
    the solid to the body.
    """
    # Smallest projection of the body minus the largest one of the solid.
    return np.asarray((direction @ vertices).min(axis=0) - solid.furthest(direction))


def cuboid_separation(
    position: Array, rotation: Array, size: Array, solid: Solid, direction: Array
) -> Array:
    """Compute the separation of a cuboid from a solid along a unit vector to it, at every state [m], shape (K,)."""
    reach = (size / 2) @ np.abs(np.einsum("i,ijk->jk", direction, rotation))
    return np.asarray(direction @ position - reach - solid.furthest(direction))


def gaps(low: Array, high: Array, solids: Sequence[Solid]) -> Array:
    """Bound the distances of axis-aligned boxes from S solids [m], shape (..., S, K).

    If there are gaps along several axes, the distance is at least the length of the
    vector that they form. Lowest and highest coordinates of the boxes [m] have shape
    (..., 3, K).
    """
    # Signed gaps along x, y and z; their positive parts form a vector.
    floor, top = _boxes(solids)
    gap = np.maximum(
        low[..., None, :, :] - top[..., None], floor[..., None] - high[..., None, :, :]
    )
    outside = np.maximum(gap, 0.0)
    distance = np.sqrt((outside * outside).sum(axis=-2))
    # Overlap on all axes: the largest, least negative gap is the bound.
    return np.asarray(np.where(distance > 0, distance, gap.max(axis=-2)))


def cuboid_gaps(
    position: Array, rotation: Array, size: Array, solids: Sequence[Solid]
) -> Array:
    """Bound the signed distances of a cuboid from S solids by its faces and their bounding boxes [m], shape (S, K)."""
    turned, (floor, top) = np.abs(rotation), _boxes(solids)
    # Of the cuboid along the world axes.
    reach = np.einsum("ijk,j->ik", turned, size / 2)
    # The same test along the axes of the cuboid.
    offset = position - (floor + top)[..., None] / 2
    # In the frame of the cuboid.
    center = np.einsum("ijk,sik->sjk", rotation, offset)
    own = (
        np.abs(center)
        - (size / 2)[:, None]
        - np.einsum("ijk,si->sjk", turned, (top - floor) / 2)
    )
    return np.asarray(
        np.maximum(gaps(position - reach, position + reach, solids), own.max(axis=1))
    )


def _boxes(solids: Sequence[Solid]) -> tuple[Array, Array]:
    """Return the lowest and the highest coordinates of S solids [m], shape (S, 3) each."""
    low, high = ([getattr(solid, end) for solid in solids] for end in ("low", "high"))
    return np.array(low).reshape(-1, 3), np.array(high).reshape(-1, 3)
