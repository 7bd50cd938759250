"""Signed distances of pairs of convex bodies along a path: at its states, and all the way from one to the next."""

from dataclasses import dataclass
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
    """

    bounds: Array
    measure: Measure
    separate: Separate

    def smallest(self) -> list[Array]:
        """Measure distances [m]: arrays of shape (K,), of which the smallest value is exact; see ``sweep``."""
        one = self.bounds.shape[1] == 1  # it is measured already when its direction is known
        return list(sweep(self.bounds, self.measure, lambda *at: self.bounds[at[0]] if one else self.separate(*at)))

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
            Lower bounds for all pairs [m], shape (K - 1,); not below 0 wherever one was found that is not, minus
            infinity where there is a pair that cannot be measured.
        """
        room = self.bounds - least[:, None]
        hulls = (room[:, 1:] + room[:, :-1] - ways) / 2 - bows
        for pair, hull in enumerate(hulls):
            doubtful = np.flatnonzero(~(hull >= 0))
            while len(doubtful):
                k, doubtful = int(doubtful[0]), doubtful[1:]
                for end in (k, k + 1):
                    _, direction = self.measure(pair, end)
                    apart = self.separate(pair, direction) - least[pair]
                    np.fmax(hull, np.minimum(apart[1:], apart[:-1]) - bows, out=hull)
                    if hull[k] >= 0:
                        break
                doubtful = doubtful[~(hull[doubtful] >= 0)]
        lowest: Array = np.nan_to_num(hulls, nan=-np.inf).min(axis=0, initial=np.inf)
        return lowest
