"""Distances along a path, measured only where they can matter: best-first search for the smallest one."""

import heapq
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Measure = Callable[[int], Sequence[float]]

APART = 1e-12  # m: lower bounds stay this far above the smallest distance, so that it is found where it was measured


def sweep(measures: Sequence[Measure], travel: Array, *, floor: float = -np.inf) -> list[Array]:
    """Find the smallest distance between M moving bodies and the obstacles without measuring every state.

    A signed distance of convex bodies is the maximum over unit vectors of a difference of their support functions, and
    these change by no more than the body's points move. So with ``travel`` (how far they have moved at most), between
    two measured states a < b no distance is below ``(d_a + d_b - (travel_b - travel_a)) / 2``. The interval with the
    smallest such bound is halved until no bound is below the smallest distance measured: no state is missed.

    Args:
        measures: Per body: returns its signed distances from the obstacles [m] at a state, given its index.
        travel: Shape (M, K), ascending: no point of body m moves further than ``travel[m, b] - travel[m, a]`` between
            states a and b [m].
        floor: No distance is below this [m]; 0 for distances that do not go below contact.

    Returns:
        Distances [m] per body, shape (obstacles, K). The smallest of all is exact, and so is every one at a state that
        was measured; the others are lower bounds (up to ``APART``), all above the smallest.
    """
    moved, last = travel.tolist(), travel.shape[1] - 1
    known = [{k: list(measure(k)) for k in {0, last}} for measure in measures]
    best = min((d for states in known for distances in states.values() for d in distances), default=np.inf)
    heap: list[tuple[float, int, int, int]] = []

    def push(body: int, a: int, b: int) -> None:
        if b - a > 1 and known[body][a]:
            nearest = min(map(float.__add__, known[body][a], known[body][b]))
            bound = (nearest - (moved[body][b] - moved[body][a])) / 2
            heapq.heappush(heap, (max(bound, floor), body, a, b))

    for body in range(len(measures)):
        push(body, 0, last)
    while heap and heap[0][0] < best:
        _, body, a, b = heapq.heappop(heap)
        middle = (a + b) // 2
        known[body][middle] = list(measures[body](middle))
        best = min(best, *known[body][middle])
        push(body, a, middle)
        push(body, middle, b)
    return [_filled(states, moved, best) for states, moved in zip(known, travel, strict=True)]


def _filled(known: dict[int, list[float]], travel: Array, best: float) -> Array:
    """Bound one body's distances at the states between those that were measured, shape (obstacles, K)."""
    states = np.array(sorted(known))
    measured = np.array([known[k] for k in states.tolist()], np.float64).T
    every = np.arange(len(travel))
    right = np.searchsorted(states, every)
    left = np.where(states[right] == every, right, right - 1)
    from_left = measured[:, left] - (travel - travel[states[left]])
    from_right = measured[:, right] - (travel[states[right]] - travel)
    bounds: Array = np.maximum(np.maximum(from_left, from_right), best + APART)
    bounds[:, states] = measured
    return bounds


def travel_of(points: Array) -> Array:
    """How far the points of a convex body with these vertices have moved at most, state by state.

    Points are convex combinations of the vertices, so none moves further than the vertex that moves most.

    Args:
        points: Vertices [m], shape (V, 3, K).

    Returns:
        Shape (K,), ascending from 0 [m].
    """
    steps = np.sqrt(np.sum(np.diff(points, axis=2) ** 2, axis=1)).max(axis=0, initial=0.0)
    return np.concatenate([[0.0], np.cumsum(steps)])
