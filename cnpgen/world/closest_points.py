"""Smallest distances at every state of a path, with the closest points of the two bodies."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.world.certified import CertifiedDistance
from cnpgen.world.pair_distances import PairDistances
from cnpgen.world.path import PathWorld

Array = NDArray[np.float64]


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


def closest_points(world: PathWorld, bodies: str, *, radius: float = 0.0) -> ClosestPoints:
    """Measure the smallest distance at every state, unlike the judge, which needs the smallest one of all states.

    Args:
        world: The robot along a path.
        bodies: The bodies, see ``PathWorld.pairs``.
        radius: Radius around the first body of every pair, for the segments of a robot without link geometry [m].

    Raises:
        RecipeError: The robot has no link geometry, or no held object, as required.
    """
    pairs, certified, points = world.pairs(bodies), CertifiedDistance(), list[tuple[Array, Array]]()
    distance, pair = smallest_per_state(pairs)
    for k, index in enumerate(pair.tolist()):
        (a, pose_a), (b, pose_b) = pairs.bodies(index, k)
        _, normal = certified.between(a, pose_a, b, pose_b)  # nan if Coal finds no direction
        point_a, point_b = certified.witnesses()
        points.append((point_a + (a.radius + radius) * normal, point_b - b.radius * normal))
    return ClosestPoints(distance - radius, pair, np.array(points))


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
