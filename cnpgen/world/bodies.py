"""Distances of the pieces of a robot's shape from obstacles and from each other."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.shape.hull import ball_round
from cnpgen.robots.shape.shape import Shape
from cnpgen.robots.solid import Solid, same_shape
from cnpgen.world.certified import CertifiedDistance, body
from cnpgen.world.pairs import PairDistances

Array = NDArray[np.float64]
Pairs = NDArray[np.intp]

NO_SHAPE = 'a constraint is about the shape of the robot, which has none: it needs geometry = "urdf" in [robot]'


@dataclass(frozen=True)
class Contacts:
    """Where bodies are near each other, C times.

    Attributes:
        pair: Indices of the pairs, shape (C,).
        k: Indices of the states, shape (C,).
        distance: Signed distances [m], shape (C,).
        away: Unit vectors in which the second body is away from the first, shape (C, 3).
        points: On the first and on the second, without what they are wrapped in, where they are nearest [m], shape
            (C, 2, 3).
        joints: Numbers of the joints that move them, shape (C, 2); 0 for what stands still.
    """

    pair: NDArray[np.intp]
    k: NDArray[np.intp]
    distance: Array
    away: Array
    points: Array
    joints: NDArray[np.intp]


class Bodies:
    """The pieces of a robot's shape and the obstacles, at K states.

    One process, one thread: Coal's memory is reused.

    Args:
        shape: The robot's shape.
        n_obstacles: Number of obstacles.
        n_joints: Number of the robot's planned joints.

    Attributes:
        from_obstacles: Pairs (obstacle, moving piece), piece by piece, shape (M, 2).
        among_links: Pairs of pieces of links that must not touch, the one nearer to the base first, shape (M, 2).
    """

    def __init__(self, shape: Shape, n_obstacles: int, n_joints: int) -> None:
        pieces, n_pieces = shape.pieces, len(shape.pieces)
        self._bodies, self._solids = [body(each.vertices, each.radius) for each in pieces], list[Solid]()
        self._frames = [shape.joints[each.link] for each in pieces] + [n_joints + 1 + i for i in range(n_obstacles)]
        self._balls = [(*ball_round(each.vertices, each.radius), np.zeros(3)) for each in pieces]
        moving = [index for index, frame in enumerate(self._frames[:n_pieces]) if frame]
        obstacles = range(n_pieces, n_pieces + n_obstacles)
        self.from_obstacles = _pairs((obstacle, piece) for piece in moving for obstacle in obstacles)
        self.among_links = _pairs(sorted(pair, key=self._frames.__getitem__) for pair in shape.apart)
        self._coal = CertifiedDistance()
        self._stand([])

    def place(self, rotations: Array, positions: Array, solids: Sequence[Solid]) -> None:
        """Move to K states.

        Args:
            rotations: Rotation matrices of the joints' frames, that of the base first, shape (n + 1, 3, 3, K).
            positions: Their origins [m], shape (n + 1, 3, K).
            solids: The obstacles.
        """
        count = rotations.shape[-1]
        if len(solids) != len(self._solids) or not all(map(same_shape, solids, self._solids)):
            self._stand(solids)
        self._solids = list(solids)
        still = np.broadcast_to(np.eye(3)[..., None], (len(solids), 3, 3, count))
        self._rotations = np.concatenate([rotations, still])
        middle = np.array([each.position for each in solids]).reshape(-1, 3, 1)
        self._positions = np.concatenate([positions, np.broadcast_to(middle, (len(solids), 3, count))])

    def _stand(self, solids: Sequence[Solid]) -> None:
        """Make bodies of the obstacles. They are bounded by boxes, pieces by balls."""
        n_pieces = len(self._balls)
        self._bodies = self._bodies[:n_pieces] + [body(each.corners, each.radius) for each in solids]
        ends = [(each.corners.min(axis=0), each.corners.max(axis=0), each.radius) for each in solids]
        boxes = [((low + high) / 2, 0.0, (high - low) / 2 + radius) for low, high, radius in ends]
        self._centres, self._reach, self._half = map(np.array, zip(*self._balls, *boxes, strict=True))

    def between(self, pairs: Pairs) -> PairDistances:
        """Tell the signed distances of pairs of bodies; minus the depth where they overlap.

        Args:
            pairs: ``from_obstacles`` or ``among_links``.
        """
        ends = [(int(a), int(b)) for a, b in pairs]

        def measure(pair: int, k: int) -> tuple[float, Array]:
            return self._measure(*ends[pair], k)

        def separate(pair: int, direction: Array, which: "slice | Pairs" = slice(None), /) -> Array:
            return self._apart(*ends[pair], direction, which)

        return PairDistances(self._bounds(pairs), measure, separate)

    def contacts(self, pairs: Pairs, within: float) -> Contacts:
        """Measure all that is near: pairs of bodies at states where their signed distance is below ``within`` [m].

        What is further apart somewhere is so in a direction that settles most other states, too.

        Args:
            pairs: ``from_obstacles`` or ``among_links``.
            within: The distance.
        """
        near, found = ~(self._bounds(pairs) >= within), list[Any]()
        for pair in np.flatnonzero(near.any(axis=1)).tolist():
            (a, b), doubtful = pairs[pair].tolist(), np.flatnonzero(near[pair])
            while len(doubtful):
                k, doubtful = int(doubtful[0]), doubtful[1:]
                distance, direction = self._measure(a, b, k)
                if distance < within:
                    found.append((pair, k, distance, direction, self._coal.witnesses()))
                elif len(doubtful) and np.isfinite(direction).all():
                    doubtful = doubtful[~(self._apart(a, b, direction, doubtful) >= within)]
        return self._gathered(pairs, [each for each in found if np.isfinite(each[3]).all()])

    def _gathered(self, pairs: Pairs, found: list[Any]) -> Contacts:
        """Gather pairs, states, distances, directions in the frames of the first bodies, and points."""
        columns = zip(*found, strict=True) if found else [()] * 5
        pair, k, distance, direction, points = (np.array(each) for each in columns)
        pair, k = pair.astype(np.intp), k.astype(np.intp)
        frames = np.array(self._frames, np.intp)[pairs[pair]]
        away = np.einsum("cij,cj->ci", self._rotations[frames[:, 0], ..., k], direction.reshape(-1, 3))
        joints = np.where(frames < len(self._rotations) - len(self._solids), frames, 0)
        return Contacts(pair, k, distance, away, points.reshape(-1, 2, 3), joints)

    def spread(self, joint: int) -> float:
        """How far from a joint's origin what it moves reaches at most [m]."""
        mine = [ball for frame, ball in zip(self._frames, self._balls, strict=False) if frame == joint]
        return max((float(np.linalg.norm(centre) + radius) for centre, radius, _ in mine), default=0.0)

    def _bounds(self, pairs: Pairs) -> Array:
        """Bound distances from below by balls round the bodies, and by an obstacle's faces, shape (M, K)."""
        first, second = pairs.T
        turned = np.einsum("bijk,bj->bik", self._rotations[self._frames], self._centres)
        where = turned + self._positions[self._frames]
        beyond = np.abs(where[second] - where[first]) - self._half[first, :, None]
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        centre = np.where(outside > 0, outside, beyond.max(axis=1))
        return np.asarray(centre - (self._reach[first] + self._reach[second])[:, None])

    def _measure(self, a: int, b: int, k: int) -> tuple[float, Array]:
        """Measure a pair at a state; the direction is that in which b is away from a, in the frame of a."""
        pose_a, pose_b = (
            (self._rotations[frame, ..., k].copy(), self._positions[frame, :, k].copy())
            for frame in (self._frames[a], self._frames[b])
        )
        distance, away = self._coal.between(self._bodies[a], pose_a, self._bodies[b], pose_b)
        return distance, away @ pose_a[0]

    def _apart(self, a: int, b: int, direction: Array, which: "slice | Pairs" = slice(None)) -> Array:
        """Compute how far b is from a along a direction in the frame of a at every state, or some [m], shape (K,)."""
        (first, second), (frame, other) = (self._bodies[a], self._bodies[b]), (self._frames[a], self._frames[b])
        along = np.einsum("ijk,j->ik", self._rotations[frame][..., which], direction)
        in_b = np.einsum("ijk,ik->jk", self._rotations[other][..., which], along)
        between = self._positions[other][:, which] - self._positions[frame][:, which]
        reach = float((first.corners @ direction).max()) + first.radius + second.radius
        return np.asarray((second.corners @ in_b).min(axis=0) + np.einsum("ik,ik->k", along, between) - reach)


def _pairs(found: Any) -> Pairs:
    return np.array(list(found), np.intp).reshape(-1, 2)
