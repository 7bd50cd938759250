"""Signed distances of pairs of convex bodies along a path: at its states, and over the intervals between them.

The signed distance of two convex bodies (minus the penetration depth if they overlap)
is the maximum over unit vectors u of their separation ``min over a of u . a - max over
b of u . b``. Every direction therefore bounds the distances at all states from below.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.world.certified import CertifiedDistance, PlacedBody

Indices = NDArray[np.intp]

RESOLUTION = 1e-9  # m: tolerance of the smallest distance
# m: above it an interval is subdivided first, which costs less than a search for a direction.
MAX_DEVIATION = 10.0


@dataclass(frozen=True)
class ClosestPoints:
    """Smallest signed distance between bodies at K states.

    Attributes:
        distance: Smallest distance of all pairs [m], minus the penetration depth if
            they overlap, shape (K,).
        pair: Index of the pair with this distance, shape (K,).
        points: Points of the two bodies at this distance, in the world frame [m], shape
            (K, 2, 3).
    """

    distance: Array
    pair: NDArray[np.intp]
    points: Array


@dataclass(frozen=True)
class PairDistances:
    """Signed distances of M pairs of convex bodies at K states.

    Attributes:
        bounds: Lower bounds of the distances [m], shape (M, K).
        measure: Returns the signed distance of a pair at a state [m] and the unit
            vector, shape (3,), along which the bodies have this distance, or a vector
            of nan. Distances are never below their bounds.
        separation: Returns lower bounds of the distances of a pair [m] along a unit
            vector at J states, shape (J,).
        bodies: Returns both bodies of a pair at a state with their poses, that of the
            robot before an obstacle.
        directions: Separating directions of every pair, collected from its
            measurements.
    """

    bounds: Array
    measure: Callable[[int, int], tuple[float, Array]]
    separation: Callable[[int, Array, Indices], Array]
    bodies: Callable[[int, int], tuple[PlacedBody, PlacedBody]]
    directions: dict[int, list[Array]] = field(default_factory=dict)

    def smallest(self, sufficient: float = math.inf) -> list[Array]:
        """Measure distances [m]: arrays of shape (K,), of which the smallest value is exact if it is below a distance."""
        return self._searched(list(range(len(self.bounds))), sufficient)

    def smallest_of_each(self) -> list[Array]:
        """Measure distances [m]: arrays of shape (K,), of each of which the smallest value is exact."""
        return [self._searched([pair])[0] for pair in range(len(self.bounds))]

    def _searched(self, pairs: list[int], sufficient: float = math.inf) -> list[Array]:
        """Find the smallest distance of some pairs by best-first search.

        The state with the smallest bound is measured, and its separating direction
        raises the bounds of the same pair at the states that could be closer. The
        search ends when no bound is below the smallest measured distance, so no state
        is missed.

        Returns:
            Distances [m], one array of shape (K,) per pair. The smallest one is exact
            up to ``RESOLUTION`` and stands where it was measured; values that were not
            measured are lower bounds above it. A state that cannot be measured is nan
            and ends the search. It also ends when all values reach a sufficient
            distance, which are then lower bounds.
        """
        # Start from the lower bounds: only states that may be the closest are measured.
        distances = self.bounds[pairs]
        best = np.inf
        measured: dict[tuple[int, int], float] = {}
        while distances.size:
            index, k = divmod(int(distances.argmin()), distances.shape[1])
            if distances[index, k] >= min(best - RESOLUTION, sufficient):
                break
            distance, direction = self._measured(pairs[index], k)
            measured[index, k] = distance
            if math.isnan(distance):
                break
            distances[index, k] = distance
            best = min(best, distance)
            closer = np.flatnonzero(distances[index] < best)
            if len(closer) and np.isfinite(direction).all():
                raised = self.separation(pairs[index], direction, closer)
                distances[index, closer] = np.maximum(distances[index, closer], raised)
        # Unmeasured values stay strictly above the smallest one, which is then the only
        # minimum.
        if best - RESOLUTION <= sufficient:
            np.maximum(distances, math.nextafter(best, math.inf), out=distances)
        for place, distance in measured.items():
            distances[place] = distance
        return list(distances)

    def _measured(self, pair: int, k: int) -> tuple[float, Array]:
        """Measure a pair at a state and store the direction."""
        distance, direction = self.measure(pair, k)
        self.directions.setdefault(pair, []).append(direction)
        return distance, direction

    def clear_states(self, min_distance: float) -> NDArray[np.bool_]:
        """Return a mask of the states at which all pairs reach a minimum distance [m], shape (K,).

        A state whose bound is too small is measured. Its separating direction also
        bounds the distances at the other unresolved states and usually resolves most of
        them. States whose distance cannot be measured are not clear.
        """
        # Pairs one after the other, so that a direction serves all states of its pair.
        clear = np.ones(self.bounds.shape[1], bool)
        proven = self.bounds >= min_distance
        for pair in np.flatnonzero(~proven.all(axis=1)).tolist():
            unresolved = np.flatnonzero(clear & ~proven[pair])
            while len(unresolved):
                k = int(unresolved[0])
                unresolved = unresolved[1:]
                distance, direction = self.measure(pair, k)
                clear[k] = distance >= min_distance
                if len(unresolved) and np.isfinite(direction).all():
                    unresolved = unresolved[
                        ~(self.separation(pair, direction, unresolved) >= min_distance)
                    ]
        return clear

    def smallest_per_state(self) -> tuple[Array, Indices]:
        """Find the smallest distance at each state, with pairs in the order of their bounds.

        Returns:
            Distances [m] and indices of their pairs, shape (K,) each.
        """
        count = self.bounds.shape[1]
        distances = np.full(count, np.inf)
        closest = np.zeros(count, np.intp)
        # In the order of the bounds, the search ends at the first bound above the best
        # distance.
        order = np.argsort(self.bounds, axis=0)
        for k in range(count):
            for pair in order[:, k].tolist():
                if self.bounds[pair, k] >= distances[k]:
                    break
                distance, _ = self.measure(pair, k)
                if distance < distances[k]:
                    distances[k] = distance
                    closest[k] = pair
        return distances, closest

    def closest_points(self, radius: float = 0.0) -> ClosestPoints:
        """Measure the smallest distance at every state, unlike ``smallest``.

        A radius [m] extends the first bodies.
        """
        certified = CertifiedDistance()
        points = list[tuple[Array, Array]]()
        distance, closest = self.smallest_per_state()
        for k, pair in enumerate(closest.tolist()):
            (a, pose_a), (b, pose_b) = self.bodies(pair, k)
            # Nan if Coal finds no direction.
            _, normal = certified.between(a, pose_a, b, pose_b)
            point_a, point_b = certified.witnesses()
            points.append(
                (point_a + (a.radius + radius) * normal, point_b - b.radius * normal)
            )
        return ClosestPoints(distance - radius, closest, np.array(points))

    def interval_bounds(
        self, min_distances: Array, displacements: Array, deviations: Array
    ) -> Array:
        """Bound by how much all distances exceed a minimum between neighboring states [m], shape (K - 1,).

        Every point of a body stays within a bounded deviation from the chord between
        its two positions. Bodies that are separated along a direction at both states
        are therefore separated between them, up to that deviation. Bounds are only
        tightened until they reach 0.

        Args:
            min_distances: Required distance of every pair [m], shape (M,).
            displacements: Maximum displacement of a point of one body in the frame of
                the other [m], shape (K - 1,).
            deviations: Maximum deviation of its path from the chord [m], shape (K -
                1,).
        """
        # Over an interval the margin is at least m_0 - x and m_1 - (displacement - x),
        # where x is the displacement so far. At the worst x both are
        #   (m_0 + m_1 - displacement) / 2,
        # less the deviation from the chord.
        margins = self.bounds - min_distances[:, None]
        intervals = (margins[:, 1:] + margins[:, :-1] - displacements) / 2 - deviations
        # Only intervals that this does not prove need directions: first the known ones,
        # then new measurements at both ends. Intervals in which a point could be anywhere
        # are left to the caller, who subdivides them.
        waiting = ~(intervals >= 0) & (deviations < MAX_DEVIATION)
        for pair in np.flatnonzero(waiting.any(axis=1)).tolist():
            for direction in list(self.directions.get(pair, [])):
                self._raise(
                    intervals[pair], pair, direction, min_distances[pair] + deviations
                )
            for k in np.flatnonzero(waiting[pair]).tolist():
                for end in (k, k + 1):
                    if not intervals[pair, k] >= 0:
                        direction = self._measured(pair, end)[1]
                        self._raise(
                            intervals[pair],
                            pair,
                            direction,
                            min_distances[pair] + deviations,
                        )
        lowest: Array = np.where(np.isnan(intervals), -np.inf, intervals).min(
            axis=0, initial=np.inf
        )
        return lowest

    def _raise(
        self, bounds: Array, pair: int, direction: Array, required: Array
    ) -> None:
        """Raise the negative interval bounds of a pair, shape (K - 1,), by its separation along a direction."""
        unresolved = np.flatnonzero(~(bounds >= 0))
        # Separated along one direction at both ends: also at every state between them,
        # since separation is concave along chords.
        if len(unresolved):
            states = np.concatenate([unresolved, unresolved + 1])
            separations = self.separation(pair, direction, states).reshape(2, -1)
            bounds[unresolved] = np.fmax(
                bounds[unresolved], separations.min(axis=0) - required[unresolved]
            )
