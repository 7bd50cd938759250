"""Distances along a path, measured only where they can matter: by the smallest lower bound first."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Measure = Callable[[int, int], tuple[float, Array]]  # of a pair at a state -> signed distance, direction apart
Separate = Callable[[int, Array], Array]  # of a pair along a direction -> lower bounds at every state

RESOLUTION = 1e-9  # m: how exactly the smallest distance is found


def sweep(bounds: Array, measure: Measure, separate: Separate) -> Array:
    """Find the smallest signed distance of M pairs of convex bodies along K states without measuring every one.

    A signed distance of convex bodies is the maximum over unit vectors of their separation along it
    (``cnpgen.world.separation``), so that every direction bounds the distances at all states from below. The state of
    the smallest bound is measured, the direction in which the bodies are apart there raises its neighbours' bounds,
    and so on until no bound is below the smallest distance measured: no state is missed.

    Args:
        bounds: Lower bounds of the distances to begin with [m], shape (M, K).
        measure: Returns the signed distance of a pair [m] at a state and the unit vector, shape (3,), along which they
            are that far apart; a vector of nan if there is none to tell. Distances are never below their bounds.
        separate: Returns lower bounds of a pair's distances [m], shape (K,), along a unit vector.

    Returns:
        Distances [m], shape (M, K). The smallest of all is right up to ``RESOLUTION`` and stands where it was measured;
        what was not measured is a lower bound above it. A state that cannot be measured is nan, which ends the search.
    """
    found, best = bounds.copy(), np.inf
    measured: dict[tuple[int, int], float] = {}
    while found.size:
        pair, k = divmod(int(found.argmin()), found.shape[1])
        if found[pair, k] >= best - RESOLUTION:
            break
        distance, direction = measure(pair, k)
        measured[pair, k] = distance
        if math.isnan(distance):
            break
        if np.isfinite(direction).all():
            np.maximum(found[pair], separate(pair, direction), out=found[pair])
        found[pair, k], best = distance, min(best, distance)
    np.maximum(found, math.nextafter(best, math.inf), out=found)
    for where, distance in measured.items():
        found[where] = distance
    return found
