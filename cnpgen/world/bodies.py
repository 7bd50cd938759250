"""Distances of the pieces of a robot's shape from obstacles and from each other: measured by Coal, and certified.

Whatever direction Coal says two bodies are apart in, how far they are apart along it can be computed, and is a lower
bound of their signed distance. So no failure of Coal's makes bodies look further apart than they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.shape.hull import CUBE, ball_round, coal_hull
from cnpgen.robots.shape.shape import Shape
from cnpgen.world.clear import clear_states
from cnpgen.world.scene import ENDLESS
from cnpgen.world.sweep import sweep

if TYPE_CHECKING:
    from cnpgen.robots.spec import Obstacle

Array = NDArray[np.float64]
Pairs = NDArray[np.intp]

# Tolerances of GJK and EPA. With both at 1e-9, EPA fails for 2 % of the overlaps of a hull and a round shape; with the
# first pair 50,000 distances of hulls and boxes are exact to 1e-9 m. The second is for what the first cannot solve.
TOLERANCES = ((1e-9, 1e-6), (1e-6, 1e-6), (1e-6, 1e-4))
CERTAIN = 1e-6  # m: what is measured and what is certified may differ by this much
NO_SHAPE = 'a constraint is about the shape of the robot, which has none: it needs geometry = "urdf" in [robot]'


@dataclass(frozen=True)
class _Body:
    """A convex body in one of the frames.

    Attributes:
        frame: Index of its frame.
        corners: Corners of its hull there [m], shape (V, 3).
        radius: How thick the hull is wrapped [m].
        centre: Centre of a ball that holds it [m], shape (3,).
        reach: Radius of the ball [m].
        shape: The hull as Coal's.
    """

    frame: int
    corners: Array
    radius: float
    centre: Array
    reach: float
    shape: Any


class Bodies:
    """The pieces of a robot's shape and the obstacles, at K states.

    One process, one thread: Coal's memory is reused.

    Args:
        shape: The robot's shape.
        obstacles: The boxes of the world.
        n_joints: Number of the robot's planned joints.

    Attributes:
        from_obstacles: Pairs (obstacle, moving piece), piece by piece, shape (M, 2).
        among_links: Pairs of pieces of links that must not touch, shape (M, 2).
    """

    def __init__(self, shape: Shape, obstacles: "Sequence[Obstacle]", n_joints: int) -> None:
        import coal

        self._obstacles = tuple(obstacles)
        self._bodies = [_body(shape.joints[each.link], each.vertices, each.radius) for each in shape.pieces]
        boxes = range(len(self._bodies), len(self._bodies) + len(self._obstacles))
        self._bodies += [_body(n_joints + 1 + i, CUBE * _size(box)) for i, box in enumerate(self._obstacles)]
        moving = [index for index, each in enumerate(shape.pieces) if shape.joints[each.link]]
        self.from_obstacles = _pairs((box, piece) for piece in moving for box in boxes)
        self.among_links = _pairs(shape.apart)
        self._holding = [_holding(shape, joint) for joint in sorted(set(shape.joints.values()) - {0})]
        self._frames = [body.frame for body in self._bodies]
        self._centres = np.array([body.centre for body in self._bodies])
        boxed = np.array([body.frame > n_joints for body in self._bodies])
        self._reach = np.where(boxed, 0.0, [body.reach for body in self._bodies])
        self._half = np.where(boxed[:, None], [np.ptp(body.corners, axis=0) / 2 for body in self._bodies], 0.0)
        self._requests = [coal.DistanceRequest() for _ in TOLERANCES]
        for request, (gjk, epa) in zip(self._requests, TOLERANCES, strict=True):
            request.gjk_tolerance, request.epa_tolerance = gjk, epa
        self._result, self._places = coal.DistanceResult(), (coal.Transform3s(), coal.Transform3s())

    def place(self, rotations: Array, positions: Array, tops: Array) -> None:
        """Move to K states.

        Args:
            rotations: Rotation matrices of the joints' frames, that of the base first, shape (n + 1, 3, 3, K).
            positions: Their origins [m], shape (n + 1, 3, K).
            tops: Heights of the obstacles' upper faces [m], shape (n_obstacles,).
        """
        count = rotations.shape[-1]
        middles = [_middle(box, top) for box, top in zip(self._obstacles, tops.tolist(), strict=True)]
        still = np.broadcast_to(np.eye(3)[..., None], (len(middles), 3, 3, count))
        self._rotations = np.concatenate([rotations, still])
        middle = np.array(middles).reshape(-1, 3, 1)
        self._positions = np.concatenate([positions, np.broadcast_to(middle, (len(middles), 3, count))])

    def distances(self, pairs: Pairs) -> list[Array]:
        """Measure the signed distances of pairs of bodies [m]; minus the depth where they overlap.

        Args:
            pairs: ``from_obstacles`` or ``among_links``.

        Returns:
            Arrays of shape (K,), of which the smallest value is exact; see ``cnpgen.world.sweep.sweep``.
        """
        count = self._positions.shape[-1]
        if not (np.isfinite(self._positions).all() and np.isfinite(self._rotations).all()):
            return [np.full(count, np.nan) for _ in pairs]
        ends = [(self._bodies[a], self._bodies[b]) for a, b in pairs.tolist()]
        bounds = self._bounds(pairs)

        def measure(pair: int, k: int) -> tuple[float, Array]:
            return self._measure(*ends[pair], k)

        def separate(pair: int, direction: Array) -> Array:
            return self._apart(*ends[pair], direction) if count > 1 else bounds[pair]  # one state is measured already

        return list(sweep(bounds, measure, separate))

    def clear(self, pairs: Pairs, least: float) -> NDArray[np.bool_]:
        """Say at which states all pairs of bodies are at least ``least`` [m] apart, shape (K,).

        Args:
            pairs: ``from_obstacles`` or ``among_links``.
            least: The distance.
        """
        ends = [(self._bodies[a], self._bodies[b]) for a, b in pairs.tolist()]

        def measure(pair: int, k: int) -> tuple[float, Array]:
            return self._measure(*ends[pair], k)

        def separate(pair: int, direction: Array, which: Pairs) -> Array:
            return self._apart(*ends[pair], direction, which)

        return clear_states(self._bounds(pairs), least, measure, separate)

    def corners(self) -> Array:
        """Compute corners of boxes that hold what every joint moves [m], shape (C, 3, K)."""
        found = [
            np.einsum("ijk,cj->cik", self._rotations[joint], corners) + self._positions[joint]
            for joint, corners in self._holding
        ]
        return np.concatenate(found)

    def _bounds(self, pairs: Pairs) -> Array:
        """Bound distances from below by balls round the bodies, and by an obstacle's faces, shape (M, K)."""
        first, second = pairs.T
        turned = np.einsum("bijk,bj->bik", self._rotations[self._frames], self._centres)
        where = turned + self._positions[self._frames]
        beyond = np.abs(where[second] - where[first]) - self._half[first, :, None]
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        centre = np.where(outside > 0, outside, beyond.max(axis=1))
        return np.asarray(centre - (self._reach[first] + self._reach[second])[:, None])

    def _measure(self, a: _Body, b: _Body, k: int) -> tuple[float, Array]:
        """Measure a pair at a state; the direction is that in which b is away from a, in the frame of a."""
        import coal

        poses = [
            (self._rotations[each.frame, ..., k].copy(), self._positions[each.frame, :, k].copy()) for each in (a, b)
        ]
        for pose, place in zip(poses, self._places, strict=True):
            place.setRotation(pose[0])
            place.setTranslation(pose[1])
        best, away = -np.inf, np.full(3, np.nan)
        for request in self._requests:
            self._result.clear()
            found = coal.distance(a.shape, self._places[0], b.shape, self._places[1], request, self._result)
            direction = np.array(self._result.normal)
            (turn_a, at_a), (turn_b, at_b) = poses
            nearest = (b.corners @ (direction @ turn_b)).min() - b.radius + direction @ at_b
            furthest = (a.corners @ (direction @ turn_a)).max() + a.radius + direction @ at_a
            certified = float(nearest - furthest)
            if certified > best:  # where there is no direction it is nan, which is not
                best, away = certified, direction @ turn_a
            if abs(found - a.radius - b.radius - certified) <= CERTAIN:
                break
        return best, away

    def _apart(self, a: _Body, b: _Body, direction: Array, which: "slice | Pairs" = slice(None)) -> Array:
        """Compute how far b is from a along a direction in the frame of a at every state, or some [m], shape (K,)."""
        along = np.einsum("ijk,j->ik", self._rotations[a.frame][..., which], direction)
        in_b = np.einsum("ijk,ik->jk", self._rotations[b.frame][..., which], along)
        between = self._positions[b.frame][:, which] - self._positions[a.frame][:, which]
        reach = float((a.corners @ direction).max()) + a.radius + b.radius
        return np.asarray((b.corners @ in_b).min(axis=0) + np.einsum("ik,ik->k", along, between) - reach)


def _body(frame: int, corners: Array, radius: float = 0.0) -> _Body:
    return _Body(frame, corners, radius, *ball_round(corners, radius), coal_hull(corners))


def _holding(shape: Shape, joint: int) -> tuple[int, Array]:
    """Return a joint and the corners of a box that holds what it moves, in its frame [m], shape (8, 3)."""
    moved = [piece for piece in shape.pieces if shape.joints[piece.link] == joint]
    low = np.min([piece.vertices.min(axis=0) - piece.radius for piece in moved], axis=0)
    high = np.max([piece.vertices.max(axis=0) + piece.radius for piece in moved], axis=0)
    return joint, (low + high) / 2 + CUBE * (high - low)


def _pairs(found: Any) -> Pairs:
    return np.array(list(found), np.intp).reshape(-1, 2)


def _size(box: "Obstacle") -> Array:
    return np.array([box.x.high - box.x.low, box.y.high - box.y.low, box.height or ENDLESS])


def _middle(box: "Obstacle", top: float) -> Array:
    middle = (box.x.low + box.x.high) / 2, (box.y.low + box.y.high) / 2, top - (box.height or ENDLESS) / 2
    return np.array(middle)
