"""Where a motion is looked at: a time step apart, in every span of its splines, and densely near both ends."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.course import Phases
from cnpgen.trajectory.spline import basis

Array = NDArray[np.float64]

FEWEST = 200  # samples of a motion
LONGEST = 2000.0  # s that a motion may take, whatever the step: half an hour
MOST = 200_000  # samples in time, which take a second to look at: of longer motions they are further apart
SPARE = 1.05  # so many times more samples than the step asks for: r varies inside a cell of the table of times
CELLS, FEW_CELLS = 4096, 128  # of equal size in the table of times, and in that of a first look
PER_SPAN = 8  # samples between two knots, evenly in phase
AT_ENDS = 64  # additional samples at each end
END = 0.05  # how far from each end they reach, in phase
APART = 1e-7  # in phase: of nearer samples one counts, since differences of their values are rounding
FEW_PER_SPAN, FEW_AT_ENDS = 8, 16  # the same of a first look, which has no others


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
        return float(np.diff(self.t) @ (values[1:] + values[:-1])) / 2


def time_table(rate: Array, degree: int, *, cells: int = CELLS) -> Array:
    """Tabulate phases and the times at them [s], by a two-point Gauss rule between each two of them.

    Args:
        rate: Control points of r [1/s], shape (R,), of a positive r.
        degree: Its degree.
        cells: Number of cells of equal size.

    Returns:
        Shape (2, C), both rows ascending: phases from 0 to 1, times from 0 to the duration.
    """
    phases, halves = _table_phases(cells)
    inverse = 1.0 / (_nodes(len(rate), degree, cells) @ rate)
    table = np.zeros((2, len(phases)))
    table[0] = phases
    np.cumsum((inverse[::2] + inverse[1::2]) * halves, out=table[1, 1:])
    return table


@cache
def _table_phases(cells: int) -> tuple[Array, Array]:
    """Phases between which 1 / r is smooth: even ones, and geometric ones near the ends, where r may be almost 0.

    Returns:
        The phases, shape (C,), and half the distance of each two of them, shape (C - 1,).
    """
    near = np.geomspace(1e-9, 12 / cells, 160)
    phases = np.unique(np.concatenate([np.linspace(0, 1, cells + 1), near, 1 - near]))
    return phases, np.diff(phases) / 2


def sample(table: Array, step: float, spans: int, also: Collection[float] = ()) -> Samples | None:
    """Choose samples that are at most ``step`` apart and see everything that a B-spline can do.

    * Times, at least ``FEWEST``, no more than ``step`` apart, but not above ``MOST``.
    * Phases, ``PER_SPAN`` in every span: a large r could leap over a part of the path between two time steps.
    * ``AT_ENDS`` phases near each end, spaced quadratically from 1e-5 on: the basis functions that are clamped there
      are about 0.01 wide, and what they hide between the time steps of a fast motion is found here.

    Args:
        table: What ``time_table`` returned.
        step: Time step [s].
        spans: Number of intervals between the knots of the finer spline.
        also: Further phases.

    Returns:
        The samples, or None if the motion takes ``LONGEST`` or more.
    """
    duration = table[1, -1]
    if not duration < LONGEST:
        return None
    count = max(FEWEST, min(MOST, int(np.ceil(SPARE * duration / step)) + 1))
    by_time = np.interp(np.linspace(0, duration, count), table[1], table[0])
    s = np.unique(np.concatenate([by_time, _phases(PER_SPAN * spans, AT_ENDS, also)]))
    return Samples(s, times(s, table))


@lru_cache(maxsize=8)
def few_phases(spans: int, also: frozenset[float] = frozenset()) -> Phases:
    """Return the phases of a first look: ``FEW_PER_SPAN`` in every span and ``FEW_AT_ENDS`` near each end.

    They are the same for all motions, however long these take.

    Args:
        spans: Number of intervals between the knots of the finer spline.
        also: Further phases.
    """
    s = np.unique(_phases(FEW_PER_SPAN * spans, FEW_AT_ENDS, also))
    return Phases(s[np.diff(s, prepend=-1.0) > APART])


def _phases(evenly: int, at_ends: int, also: Collection[float]) -> Array:
    """Return phases at even distances and, quadratically spaced, near both ends; in no order."""
    near = END * np.linspace(0, 1, at_ends + 1) ** 2
    return np.concatenate([np.linspace(0, 1, evenly + 1), near, 1 - near, list(also)])


def times(s: Array, table: Array) -> Array:
    """Return when a motion is at phases s [s], shape (K,); ``table`` is what ``time_table`` returned."""
    return np.interp(s, *table)


@cache
def _nodes(points: int, degree: int, cells: int) -> Array:
    """Basis of r at the Gauss nodes of the table's cells, shape (2 cells, R)."""
    phases, halves = _table_phases(cells)
    middle, offset = (phases[1:] + phases[:-1]) / 2, halves / np.sqrt(3)
    return basis(np.stack([middle - offset, middle + offset], axis=1).ravel(), points, degree)
