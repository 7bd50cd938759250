"""Signed distances of pairs of convex bodies along a path: at its states, and all the way from one to the next."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cnpgen.world.clear import clear_states
from cnpgen.world.sweep import Measure, sweep

Array = NDArray[np.float64]


class Separate(Protocol):
    """Says how far a pair is apart along a direction at some states [m]: lower bounds of its distances."""

    def __call__(self, pair: int, direction: Array, which: slice | NDArray[np.intp] = slice(None), /) -> Array:
        """Return an array with one number per state."""


@dataclass(frozen=True)
class PairDistances:
    """The signed distances of M pairs of convex bodies at K states.

    Attributes:
        bounds: Lower bounds of them [m], shape (M, K).
        measure: Measures a pair at a state; as of ``cnpgen.world.sweep.sweep``.
        separate: Bounds the distances of a pair by a direction.
        known: Directions that were found to tell a pair apart somewhere.
    """

    bounds: Array
    measure: Measure
    separate: Separate
    known: dict[int, list[Array]] = field(default_factory=dict)

    def smallest(self) -> list[Array]:
        """Measure distances [m]: arrays of shape (K,), of which the smallest value is exact; see ``sweep``."""
        return self._swept(list(range(len(self.bounds))))

    def smallest_of_each(self) -> list[Array]:
        """Measure likewise, but so that the smallest value of every array is exact."""
        return [self._swept([pair])[0] for pair in range(len(self.bounds))]

    def _swept(self, pairs: list[int]) -> list[Array]:
        def measure(index: int, k: int) -> tuple[float, Array]:
            return self._measured(pairs[index], k)

        def separate(index: int, direction: Array) -> Array:
            pair = pairs[index]  # where there is one state, it is measured when its direction is known
            return self.bounds[pair] if self.bounds.shape[1] == 1 else self.separate(pair, direction)

        return list(sweep(self.bounds[pairs], measure, separate))

    def _measured(self, pair: int, k: int) -> tuple[float, Array]:
        """Measure, and remember the direction."""
        distance, direction = self.measure(pair, k)
        self.known.setdefault(pair, []).append(direction)
        return distance, direction

    def clear(self, least: float) -> NDArray[np.bool_]:
        """Say at which states all pairs are at least ``least`` [m] apart, shape (K,)."""
        return clear_states(self.bounds, least, self.measure, self.separate)

    def between(self, least: Array, ways: Array, bows: Array) -> Array:
        """Bound by how much the distances exceed ``least`` all the way from one state to the next.

        Between two states every point of a body is on the straight line from where it was to where it will be, but for
        the bow of its way: along a direction in which bodies are apart at both states they are apart between, too, but
        for that.

        Args:
            least: A distance for every pair [m], shape (M,).
            ways: How far a point of one body of a pair moves at most, as the other sees it [m], shape (K - 1,).
            bows: How far its way leaves the straight line at most [m], shape (K - 1,).

        Returns:
            Lower bounds for all pairs together [m], shape (K - 1,), made no better than is needed to be 0.
        """
        room = self.bounds - least[:, None]
        hulls = (room[:, 1:] + room[:, :-1] - ways) / 2 - bows
        for pair in np.flatnonzero(~(hulls >= 0).all(axis=1)).tolist():
            for direction in list(self.known.get(pair, [])):
                self._raise(hulls[pair], pair, direction, least[pair] + bows)
            for k in np.flatnonzero(~(hulls[pair] >= 0)).tolist():
                for end in (k, k + 1):
                    if not hulls[pair, k] >= 0:
                        self._raise(hulls[pair], pair, self._measured(pair, end)[1], least[pair] + bows)
        lowest: Array = np.where(np.isnan(hulls), -np.inf, hulls).min(axis=0, initial=np.inf)
        return lowest

    def _raise(self, hull: Array, pair: int, direction: Array, wanted: Array) -> None:
        """Raise bounds of a pair, shape (K - 1,), where they are below 0, by a direction."""
        doubtful = np.flatnonzero(~(hull >= 0))
        if len(doubtful):
            apart = self.separate(pair, direction, np.concatenate([doubtful, doubtful + 1])).reshape(2, -1)
            hull[doubtful] = np.fmax(hull[doubtful], apart.min(axis=0) - wanted[doubtful])
