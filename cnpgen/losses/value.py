"""What a loss returns."""

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class LossValue:
    """What N plans cost. A plan that is none costs nan, and no other is touched.

    A plan is none if a control point is not finite, or a control point of the rate not positive: r(s) lies between the
    least and the largest of them, so that positive ones are enough, though not needed, for a motion that runs forward.

    Attributes:
        total: Task loss plus the weighted constraint terms, shape (N,).
        terms: The integrals without weights, the task loss first, shape (N, 1 + m).
        path_gradient: Gradient of every plan's total with respect to its path control points, shape (N, C, n).
        rate_gradient: Likewise with respect to its rate control points, shape (N, R).
    """

    total: Array
    terms: Array
    path_gradient: Array
    rate_gradient: Array
