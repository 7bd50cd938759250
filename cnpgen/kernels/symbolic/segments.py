"""Distance between two segments, the axes of two capsules, as SX."""

from collections.abc import Callable
from typing import Any

from cnpgen.kernels.symbolic.linalg import Scalar, Vec, add, dot, scale, subtract

POINT = 1e-12  # m^2: the square of the length of a segment that is taken for a point, and what keeps roots smooth


def segment_distance(first: tuple[Vec, Vec], second: tuple[Vec, Vec], *, hold: Callable[[Any], Any]) -> Scalar:
    """Distance between two segments [m]; it has a gradient everywhere, and is 1e-6 m where they cross.

    The nearest points of the two lines, one after the other brought into its segment (Ericson 2005, section 5.1.9).
    They may be held while the distance is differentiated: they minimise it, so that to first order their own motion
    changes nothing.

    Args:
        first: Both ends of one segment [m].
        second: Both ends of the other one.
        hold: Returns a value as a constant for differentiation.
    """
    import casadi as ca

    one, other = subtract(first[1], first[0]), subtract(second[1], second[0])
    between = subtract(first[0], second[0])
    aa, bb, ab = dot(one, one), dot(other, other), dot(one, other)
    ar, br = dot(one, between), dot(other, between)
    s = _share((ab * br - ar * bb) / ca.fmax(aa * bb - ab * ab, POINT * POINT))
    t = _share((ab * s + br) / ca.fmax(bb, POINT))
    s, t = hold(_share((ab * t - ar) / ca.fmax(aa, POINT))), hold(t)
    apart = subtract(add(between, scale(one, s)), scale(other, t))
    return ca.sqrt(dot(apart, apart) + POINT)


def _share(value: Any) -> Any:
    import casadi as ca

    return ca.fmax(ca.fmin(value, 1), 0)
