"""Smallest distances at every state of a path, with the closest points of the two bodies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.solid import Solid
from cnpgen.world.certified import CertifiedDistance, ConvexBody, Pose, convex_body
from cnpgen.world.forward_kinematics import ForwardKinematics
from cnpgen.world.pair_distances import PairDistances
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]
Place = Callable[[int], tuple[ConvexBody, Pose]]  # state -> body and its pose

_AT_ORIGIN = np.eye(3), np.zeros(3)


@dataclass(frozen=True)
class ClosestPoints:
    """Smallest signed distance between bodies at K states.

    Attributes:
        distance: Smallest distance of all pairs [m], minus the penetration depth if they overlap, shape (K,).
        pair: Index of the pair with this distance, shape (K,).
        points: Points of the two bodies at this distance, in the world frame [m], shape (K, 2, 3).
    """

    distance: Array
    pair: NDArray[np.intp]
    points: Array


def closest_points(world: PathWorld, bodies: str, solids: Sequence[Solid], *, radius: float = 0.0) -> ClosestPoints:
    """Measure the smallest distance at every state, unlike the judge, which needs the smallest one of all states.

    Args:
        world: The robot along a path.
        bodies: The bodies, see ``PathWorld.pairs``, other than the held object and links.
        solids: The obstacles of the world.
        radius: Radius of the segments of a robot without link geometry [m].

    Raises:
        RecipeError: The robot has no link geometry, or no held object, as required.
    """
    places = _pairs_of_bodies(world, bodies, solids, radius)
    inflation = radius if bodies == "robot" and world.robot.shape is None else 0.0
    distance, pair = smallest_per_state(world.pairs(bodies))
    certified = CertifiedDistance()
    points = [_witnesses(certified, places[index], k) for k, index in enumerate(pair.tolist())]
    return ClosestPoints(distance - inflation, pair, np.array(points))


def smallest_per_state(pairs: PairDistances) -> tuple[Array, NDArray[np.intp]]:
    """Find the smallest signed distance of M pairs of bodies at each of K states, pairs in the order of their bounds.

    Returns:
        Distances [m] and indices of their pairs, shape (K,) each.
    """
    count = pairs.bounds.shape[1]
    distances, closest = np.full(count, np.inf), np.zeros(count, np.intp)
    order = np.argsort(pairs.bounds, axis=0)
    for k in range(count):
        for pair in order[:, k].tolist():
            if pairs.bounds[pair, k] >= distances[k]:
                break
            distance, _ = pairs.measure(pair, k)
            if distance < distances[k]:
                distances[k], closest[k] = distance, pair
    return distances, closest


def _pairs_of_bodies(
    world: PathWorld, bodies: str, solids: Sequence[Solid], radius: float
) -> list[tuple[Place, Place]]:
    """Return both bodies of every pair of bodies, in the order of ``PathWorld.pairs``."""
    obstacles = [_fixed(solid) for solid in solids]
    if bodies == "object":
        return [(_held_object(world), obstacle) for obstacle in obstacles]
    if world.robot.shape is None:
        count = len(world.robot.capsule_axes)
        return [(_segment(world, index, radius), obstacle) for index in range(count) for obstacle in obstacles]
    shape, places = world.robot.shape, _links(world)
    if bodies == "self":
        return [(places[i], places[j]) for i, j in shape.checked_pairs]
    moving = [index for index, part in enumerate(shape.convex_parts) if shape.joints[part.link]]
    return [(places[index], obstacle) for index in moving for obstacle in obstacles]


def _fixed(solid: Solid) -> Place:
    body = convex_body(solid.corners, solid.radius)
    return lambda _: (body, (np.eye(3), solid.position))


def _held_object(world: PathWorld) -> Place:
    corners = world.object_corners()
    size = np.linalg.norm(corners[[0, 0, 0], :, 0] - corners[[4, 2, 1], :, 0], axis=1)
    body, rotation, position = convex_body(CUBE * size), world.tip_rotation, world.tip_position
    return lambda k: (body, (rotation[..., k].copy(), position[:, k].copy()))


def _segment(world: PathWorld, index: int, radius: float) -> Place:
    segment = world.segments()[index]
    return lambda k: (convex_body(segment[..., k].copy(), radius), _AT_ORIGIN)


def _links(world: PathWorld) -> list[Place]:
    """Return the convex parts of the links."""
    shape = world.robot.shape
    rotations, positions = ForwardKinematics(world.robot.model).poses(world.q)

    def place(body: ConvexBody, joint: int) -> Place:
        return lambda k: (body, (rotations[joint, ..., k].copy(), positions[joint, :, k].copy()))

    parts = shape.convex_parts if shape else ()
    joints = shape.joints if shape else {}
    return [place(convex_body(part.vertices, part.radius), joints[part.link]) for part in parts]


def _witnesses(certified: CertifiedDistance, places: tuple[Place, Place], k: int) -> Array:
    """Return the closest points of two bodies at a state, shape (2, 3); nan if Coal finds no direction."""
    (a, pose_a), (b, pose_b) = places[0](k), places[1](k)
    _, normal = certified.between(a, pose_a, b, pose_b)
    point_a, point_b = certified.witnesses()
    return np.stack([point_a + a.radius * normal, point_b - b.radius * normal])
