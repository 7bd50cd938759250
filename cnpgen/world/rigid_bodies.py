"""Distances of the convex parts of a robot's links from obstacles and from each other."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.robots.obstacle_shapes.convex_solid import Solid, same_shape
from cnpgen.robots.shape.hull import ball_round
from cnpgen.robots.shape.shape import Shape
from cnpgen.world.certified import CertifiedDistance, PlacedBody, convex_body
from cnpgen.world.pair_distances import PairDistances

Pairs = NDArray[np.intp]

NO_SHAPE = 'a constraint needs the link geometry of the robot, which has none: set geometry = "urdf" in [robot]'
NO_HELD_SHAPE = (
    "a constraint needs the geometry of the links and a held object: the problem needs [object], and <collision>"
    " elements in its URDF"
)


class RigidBodies:
    """The convex parts of a robot's links and the obstacles, placed in the world at K states.

    It reuses Coal's memory: use it in one process and one thread only.

    Args:
        shape: Link geometry of the robot.
        n_obstacles: Number of obstacles.
        n_joints: Number of the robot's planned joints.

    Attributes:
        obstacle_pairs: Pairs (obstacle, moving part), part by part, shape (M, 2).
        link_pairs: Pairs of parts of links that must not touch, the one nearer to the
            base first, shape (M, 2).
    """

    def __init__(self, shape: Shape, n_obstacles: int, n_joints: int) -> None:
        parts = shape.convex_parts
        n_parts = len(shape.convex_parts)
        self._bodies = [convex_body(part.vertices, part.radius) for part in parts]
        self._solids = list[Solid]()
        # Obstacles have frames after those of the joints, with the axes of the world.
        self._frames = [shape.joints[part.link] for part in parts] + [
            n_joints + 1 + i for i in range(n_obstacles)
        ]
        self._balls = [
            (*ball_round(part.vertices, part.radius), np.zeros(3)) for part in parts
        ]
        moving = [index for index, frame in enumerate(self._frames[:n_parts]) if frame]
        obstacles = range(n_parts, n_parts + n_obstacles)
        self.obstacle_pairs = _pairs(
            (obstacle, part) for part in moving for obstacle in obstacles
        )
        self.link_pairs = _pairs(
            sorted(pair, key=self._frames.__getitem__) for pair in shape.checked_pairs
        )
        self._certified = CertifiedDistance()
        self._set_obstacles([])

    def place(
        self, rotations: Array, positions: Array, solids: Sequence[Solid]
    ) -> None:
        """Move to K states and place the obstacles.

        Rotation matrices of the joints' frames, that of the base first, have shape (n +
        1, 3, 3, K), their origins [m] (n + 1, 3, K).
        """
        count = rotations.shape[-1]
        if len(solids) != len(self._solids) or not all(
            map(same_shape, solids, self._solids)
        ):
            self._set_obstacles(solids)
        self._solids = list(solids)
        fixed = np.broadcast_to(np.eye(3)[..., None], (len(solids), 3, 3, count))
        self._rotations = np.concatenate([rotations, fixed])
        centers = np.array([solid.position for solid in solids]).reshape(-1, 3, 1)
        self._positions = np.concatenate(
            [positions, np.broadcast_to(centers, (len(solids), 3, count))]
        )

    def _set_obstacles(self, solids: Sequence[Solid]) -> None:
        """Make bodies of the obstacles.

        Obstacles are bounded by boxes, parts of links by balls.
        """
        n_parts = len(self._balls)
        self._bodies = self._bodies[:n_parts] + [
            convex_body(solid.corners, solid.radius) for solid in solids
        ]
        extents = [
            (solid.corners.min(axis=0), solid.corners.max(axis=0), solid.radius)
            for solid in solids
        ]
        boxes = [
            ((low + high) / 2, 0.0, (high - low) / 2 + radius)
            for low, high, radius in extents
        ]
        self._centers, self._radii, self._half_sizes = map(
            np.array, zip(*self._balls, *boxes, strict=True)
        )

    def pair_distances(self, pairs: Pairs) -> PairDistances:
        """Return the signed distances of ``obstacle_pairs`` or ``link_pairs``.

        Overlaps are negative.
        """
        bodies = [(a, b) for a, b in pairs.tolist()]

        def measure(pair: int, k: int) -> tuple[float, Array]:
            return self._measure(*bodies[pair], k)

        def separation(pair: int, direction: Array, states: Pairs) -> Array:
            return self._separation(*bodies[pair], direction, states)

        def bodies_at(pair: int, k: int) -> tuple[PlacedBody, PlacedBody]:
            a, b = (
                bodies[pair]
                if bodies[pair][0] < len(self._balls)
                else bodies[pair][::-1]
            )
            return self._placed(a, k), self._placed(b, k)

        return PairDistances(self._bounds(pairs), measure, separation, bodies_at)

    def extent(self, joint: int) -> float:
        """Return the largest distance of a point that is fixed to a joint's frame from its origin [m]."""
        # A ball contains its part, so |center| + radius bounds the distance of every
        # point.
        balls = [
            ball
            for frame, ball in zip(self._frames, self._balls, strict=False)
            if frame == joint
        ]
        return max(
            (float(np.linalg.norm(center) + radius) for center, radius, _ in balls),
            default=0.0,
        )

    def _bounds(self, pairs: Pairs) -> Array:
        """Bound distances from below by bounding balls of the bodies and bounding boxes of obstacles, shape (M, K)."""
        first, second = pairs.T
        turned = np.einsum("bijk,bj->bik", self._rotations[self._frames], self._centers)
        centers = turned + self._positions[self._frames]
        # Gap between a ball's center and a box (half sizes 0 for balls), axis by axis.
        gaps = np.abs(centers[second] - centers[first])
        gaps -= self._half_sizes[first, :, None]
        largest = gaps.max(axis=1)
        np.maximum(gaps, 0, out=gaps)
        distance: Array = np.where(
            largest > 0, np.sqrt(np.einsum("mik,mik->mk", gaps, gaps)), largest
        )
        distance -= (self._radii[first] + self._radii[second])[:, None]
        return distance

    def _measure(self, a: int, b: int, k: int) -> tuple[float, Array]:
        """Measure a pair at a state.

        The direction points from a to b, in the frame of a.
        """
        first = self._placed(a, k)
        second = self._placed(b, k)
        distance, normal = self._certified.between(*first, *second)
        return distance, normal @ first[1][0]

    def _placed(self, body: int, k: int) -> PlacedBody:
        frame = self._frames[body]
        return self._bodies[body], (
            self._rotations[frame, ..., k].copy(),
            self._positions[frame, :, k].copy(),
        )

    def _separation(self, a: int, b: int, direction: Array, states: Pairs) -> Array:
        """Compute the separation of b from a along a direction in the frame of a, at some states [m], shape (K,)."""
        (first, second), (frame, other) = (
            (self._bodies[a], self._bodies[b]),
            (self._frames[a], self._frames[b]),
        )
        rotation = self._rotations[other]
        between = self._positions[other] - self._positions[frame]
        if a >= len(self._balls):
            # An obstacle, whose frame has the axes of the world.
            in_b = (direction @ rotation.reshape(3, -1)).reshape(3, -1)
            shift = direction @ between
        else:
            along = direction @ self._rotations[frame]
            in_b = np.einsum("ijk,ik->jk", rotation, along)
            shift = np.einsum("ik,ik->k", along, between)
        # Along u: min over b of u . x - max over a of u . x, both with their radii.
        reach = float((first.corners @ direction).max()) + first.radius + second.radius
        return np.asarray(
            second.lowest_products(in_b[:, states]) + shift[states] - reach
        )


def _pairs(pairs: Any) -> Pairs:
    return np.array(list(pairs), np.intp).reshape(-1, 2)
