"""Where a motion is looked at: phases that are a time step apart, and many near both ends."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cnpgen.trajectory.spline import basis, clamped_knots

Array = NDArray[np.float64]

FEWEST, MOST = 200, 200_000  # samples of a motion
SPARE = 1.05  # so many times more samples than the step asks for: r varies inside a cell of the table of times
CELLS = 4096  # of the table of times
AT_ENDS = 64  # additional samples at each end
END = 0.05  # how far from each end they reach, in phase


@dataclass(frozen=True)
class Samples:
    """K moments of one motion, both of its ends among them.

    Attributes:
        s: Phases, ascending from 0 to 1, shape (K,).
        t: Times [s], shape (K,).
    """

    s: Array
    t: Array

    def integral(self, values: Array) -> float:
        """Integrate samples of shape (K,) over time by the trapezoidal rule."""
        return float(np.trapezoid(values, self.t))


def is_positive(rate: Array, degree: int) -> bool:
    """Whether r(s) > 0 for every s in [0, 1].

    A B-spline lies in the hull of its control points; where some are not positive its roots decide.

    Args:
        rate: Control points of r [1/s], shape (R,).
        degree: Its degree.
    """
    if np.all(rate > 0):
        return True
    if rate[0] <= 0 or rate[-1] <= 0:
        return False
    from scipy.interpolate import BSpline, PPoly

    curve = BSpline(clamped_knots(len(rate), degree), rate / np.abs(rate).max(), degree)
    roots = np.asarray(PPoly.from_spline(curve).roots(extrapolate=False))
    return roots.size == 0 and bool(np.all(_nodes(len(rate), degree) @ rate > 0))


def time_table(rate: Array, degree: int) -> Array:
    """Times at the phases ``linspace(0, 1, CELLS + 1)`` [s], by a two-point Gauss rule in each cell.

    Args:
        rate: Control points of r [1/s], shape (R,), of a positive r.
        degree: Its degree.

    Returns:
        Shape (CELLS + 1,): ascending from 0 to the duration.
    """
    inverse = 1.0 / (_nodes(len(rate), degree) @ rate)
    cells = inverse.reshape(CELLS, 2).sum(axis=1) / (2 * CELLS)
    return np.concatenate([[0.0], np.cumsum(cells)])


def sample(table: Array, step: float) -> Samples | None:
    """Choose samples that are at most ``step`` apart, at least ``FEWEST``, and ``AT_ENDS`` more near each end.

    The basis functions of r that are clamped at its ends are about 0.01 wide in phase: what they hide between the time
    steps of a fast motion, the additional samples find. They are spaced quadratically, from 1e-5 on.

    Args:
        table: What ``time_table`` returned.
        step: Time step [s].

    Returns:
        The samples, or None if the motion is too long for ``MOST`` of them.
    """
    duration = table[-1]
    if not duration < step * MOST / SPARE:
        return None
    count = max(FEWEST, int(np.ceil(SPARE * duration / step)) + 1)
    phases = np.linspace(0, 1, CELLS + 1)
    even = np.interp(np.linspace(0, duration, count), table, phases)
    near = END * (np.arange(AT_ENDS + 1) / AT_ENDS) ** 2
    s = np.unique(np.concatenate([[0.0, 1.0], np.clip(even, 0, 1), near, 1 - near]))
    return Samples(s, np.interp(s, phases, table))


@cache
def _nodes(points: int, degree: int) -> Array:
    """Basis of r at the Gauss nodes of the table's cells, shape (2 CELLS, R)."""
    middle = (np.arange(CELLS) + 0.5) / CELLS
    offset = np.sqrt(1 / 3) / (2 * CELLS)
    return basis(np.stack([middle - offset, middle + offset], axis=1).ravel(), points, degree)
