"""Distance between two segments, the axes of two capsules, as SX."""

from collections.abc import Callable
from typing import Any

from cnpgen.kernels.symbolic.linalg import Scalar, Vec, add, dot, scale, subtract

SMOOTHING_M2 = 1e-12  # keeps square roots of squared distances differentiable; squared length of a degenerate segment


def segment_distance(first: tuple[Vec, Vec], second: tuple[Vec, Vec], *, freeze: Callable[[Any], Any]) -> Scalar:
    """Return the distance of two segments [m]; it has a gradient everywhere and is 1e-6 m for crossing segments.

    The closest points of the two lines are clamped to their segments (Ericson 2005, section 5.1.9). They are constant
    for differentiation (envelope theorem), which ``freeze`` makes them. Segments are given by their ends [m].
    """
    import casadi as ca

    a, b = subtract(first[1], first[0]), subtract(second[1], second[0])
    r = subtract(first[0], second[0])
    aa, bb, ab = dot(a, a), dot(b, b), dot(a, b)
    ar, br = dot(a, r), dot(b, r)
    s = _clamped((ab * br - ar * bb) / ca.fmax(aa * bb - ab * ab, SMOOTHING_M2 * SMOOTHING_M2))
    t = _clamped((ab * s + br) / ca.fmax(bb, SMOOTHING_M2))
    s, t = freeze(_clamped((ab * t - ar) / ca.fmax(aa, SMOOTHING_M2))), freeze(t)
    difference = subtract(add(r, scale(a, s)), scale(b, t))
    return ca.sqrt(dot(difference, difference) + SMOOTHING_M2)


def _clamped(value: Any) -> Any:
    """Return a value limited to [0, 1]."""
    import casadi as ca

    return ca.fmax(ca.fmin(value, 1), 0)
