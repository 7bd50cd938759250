"""Which of many states have all pairs of bodies far enough apart: one direction settles many states at once."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cnpgen.world.sweep import Measure

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Separate = Callable[[int, Array, Indices], Array]  # of a pair along a direction at some states -> lower bounds there


def clear_states(bounds: Array, least: float, measure: Measure, separate: Separate) -> NDArray[np.bool_]:
    """Find the states at which the signed distances of all of M pairs of convex bodies are at least ``least``.

    A state in doubt is measured; the direction in which the bodies are apart there bounds the distances at all others
    in doubt, too, most of which it settles (``cnpgen.world.sweep`` says why).

    Args:
        bounds: Lower bounds of the distances to begin with [m], shape (M, K).
        least: What distances must be at least [m].
        measure: Returns the signed distance of a pair [m] at a state and the unit vector, shape (3,), along which they
            are that far apart; a vector of nan if there is none to tell.
        separate: Returns lower bounds of a pair's distances [m] along a unit vector at J states, shape (J,).

    Returns:
        Shape (K,); False where a distance cannot be measured.
    """
    clear = np.ones(bounds.shape[1], bool)
    far = bounds >= least
    for pair in np.flatnonzero(~far.all(axis=1)).tolist():
        doubtful = np.flatnonzero(clear & ~far[pair])
        while len(doubtful):
            k, doubtful = int(doubtful[0]), doubtful[1:]
            distance, direction = measure(pair, k)
            clear[k] = distance >= least
            if len(doubtful) and np.isfinite(direction).all():
                doubtful = doubtful[~(separate(pair, direction, doubtful) >= least)]
    return clear
