"""What a loss returns."""

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class LossValue:
    """What N plans cost. A plan that is none (not finite, or r not positive) costs nan, and no other is touched.

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
