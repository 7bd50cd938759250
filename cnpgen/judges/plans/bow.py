"""How far the way of any point of a robot leaves the straight line between two moments of a motion: a proven bound.

A function whose second derivative is at most C is within C h^2 / 8 of the straight line between two of its values h
apart. The path p(s) is a polynomial between knots: its derivatives are between the least and the largest of their
Bernstein coefficients. The point's second derivative in s is the sum over joints of its partial derivatives times p'',
and over pairs of joints of its second ones times p' p'. Of a joint that turns, and of a pair of which it is the one
further from the base, these are at most as long as the way from the joint to the point.
"""

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.between import in_bernstein_form
from cnpgen.trajectory.motion import Motion

Array = NDArray[np.float64]

PARTS = 4  # of every span, over which derivatives are bounded


def bows(motion: Motion, s: Array, reach: Array) -> Array:
    """Bound how far points leave the straight lines between neighbouring phases.

    Args:
        motion: One motion.
        s: Phases, ascending, no further apart than a part of a span, shape (K,).
        reach: As ``PathWorld.reach`` says [m], shape (n,).

    Returns:
        Shape (K - 1,) [m]; 0 where a phase is below the one before it.
    """
    path, degree = motion.path[0], motion.degree
    edges = np.linspace(0, 1, PARTS * (len(path) - degree) + 1)
    first, second = (np.abs(each).max(axis=0) for each in in_bernstein_form(path, degree, (1, 2), edges))
    before = np.cumsum(first, axis=1) - first
    bent = (second + first * (first + 2 * before)) @ reach
    low, high = np.searchsorted(edges[1:-1], s[:-1], "right"), np.searchsorted(edges[1:-1], s[1:], "left")
    step = np.maximum(s[1:] - s[:-1], 0.0)
    return np.asarray(step**2 / 8 * np.maximum(bent[low], bent[high]))
