"""Samples of a motion: uniform in time, in every span of its splines, and densely near both ends."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from cnpgen.arrays import Array
from cnpgen.judges.plans.evaluated_trajectory import Phases
from cnpgen.judges.plans.scipy_splines import basis_matrix

MIN_SAMPLES = 200  # per motion
MAX_DURATION_S = 2000.0  # of a motion that is judged, for any time step
# Take about one second; longer motions get a longer time step.
MAX_TIME_SAMPLES = 200_000
# Additional samples in time, because r varies within a cell of the table of times.
TIME_SAMPLE_FACTOR = 1.05
TABLE_CELLS, EARLY_EXIT_CELLS = 4096, 128  # of equal size in the table of times
SAMPLES_PER_SPAN = 8  # between two knots, uniform in phase
SAMPLES_PER_END = 64  # additional, at each end
END_REGION = 0.05  # phases at each end with additional samples
MIN_PHASE_STEP = 1e-7  # differences between closer samples are rounding errors
# Samples of early_exit, which has none in time.
EARLY_EXIT_PER_SPAN = 8
EARLY_EXIT_PER_END = 16


@dataclass(frozen=True)
class Samples:
    """K samples of one motion with both ends: phases from 0 to 1 and times [s], ascending, shape (K,) each."""

    s: Array
    t: Array

    def integral(self, values: Array) -> float:
        """Integrate samples of shape (K,) over time by the trapezoidal rule."""
        return float(np.diff(self.t) @ (values[1:] + values[:-1])) / 2


def time_table(rate: Array, degree: int, *, cells: int = TABLE_CELLS) -> Array:
    """Tabulate phases and their times [s], by a two-point Gauss rule in every cell.

    The rate, of positive r, has control points [1/s] of shape (R,). The table has shape
    (2, C), both rows ascending: phases from 0 to 1, times from 0 to the duration.
    """
    # The integrand 1 / r has a pole where r is 0 at an end; Gauss nodes avoid the ends.
    #   t(s) = integral of ds / r(s)
    phases, halves = _table_phases(cells)
    inverse = 1.0 / (_nodes(len(rate), degree, cells) @ rate)
    table = np.zeros((2, len(phases)))
    table[0] = phases
    np.cumsum((inverse[::2] + inverse[1::2]) * halves, out=table[1, 1:])
    return table


@cache
def _table_phases(cells: int) -> tuple[Array, Array]:
    """Return phases between which 1 / r is smooth, shape (C,), and half the widths of the cells, shape (C - 1,).

    They are uniform, and geometric near the ends, where r may be 0.
    """
    # Cells that shrink geometrically resolve 1 / r next to a zero at an end.
    near = np.geomspace(1e-9, 12 / cells, 160)
    phases = np.unique(np.concatenate([np.linspace(0, 1, cells + 1), near, 1 - near]))
    return phases, np.diff(phases) / 2


def sample(
    table: Array, step: float, spans: int, additional: Collection[float] = ()
) -> Samples | None:
    """Choose samples with a maximum time step [s] that resolve every feature of a B-spline.

    * Samples in time, at least ``MIN_SAMPLES`` and at most ``MAX_TIME_SAMPLES``, with steps of at most ``step``.
    * Samples in phase, ``SAMPLES_PER_SPAN`` in every span: if r is large, a time step may skip a part of the path.
    * ``SAMPLES_PER_END`` phases near each end, spaced quadratically from 1e-5 on: the clamped basis functions there are
      about 0.01 wide, less than a time step of a fast motion.

    Spans are those between the knots of the finer spline. The result is None for a
    duration of ``MAX_DURATION_S`` or more.
    """
    duration = table[1, -1]
    if not duration < MAX_DURATION_S:
        return None
    count = max(
        MIN_SAMPLES,
        min(MAX_TIME_SAMPLES, int(np.ceil(TIME_SAMPLE_FACTOR * duration / step)) + 1),
    )
    # Times are uniform; interpolation in the table inverts t(s).
    by_time = np.interp(np.linspace(0, duration, count), table[1], table[0])
    s = np.unique(
        np.concatenate(
            [by_time, _phases(SAMPLES_PER_SPAN * spans, SAMPLES_PER_END, additional)]
        )
    )
    return Samples(s, times(s, table))


@lru_cache(maxsize=8)
def early_exit_phases(spans: int, additional: frozenset[float] = frozenset()) -> Phases:
    """Return the phases for verdicts with early exit: some in every span, some near each end, and additional ones.

    They do not depend on the duration, so all motions of a problem share them.
    """
    s = np.unique(_phases(EARLY_EXIT_PER_SPAN * spans, EARLY_EXIT_PER_END, additional))
    return Phases(s[np.diff(s, prepend=-1.0) > MIN_PHASE_STEP])


def _phases(uniform: int, per_end: int, additional: Collection[float]) -> Array:
    """Return phases, not sorted: uniform ones, and quadratically spaced ones near both ends."""
    near = END_REGION * np.linspace(0, 1, per_end + 1) ** 2
    return np.concatenate(
        [np.linspace(0, 1, uniform + 1), near, 1 - near, list(additional)]
    )


def times(s: Array, table: Array) -> Array:
    """Interpolate the times at phases s [s], shape (K,), in the result of ``time_table``."""
    return np.interp(s, *table)


@cache
def _nodes(points: int, degree: int, cells: int) -> Array:
    """Return the basis of r at the Gauss nodes of the table's cells, shape (2 cells, R)."""
    phases, halves = _table_phases(cells)
    # Two-point Gauss rule: nodes at center +- h / sqrt(3) with weights h, h half the
    # width.
    centers = (phases[1:] + phases[:-1]) / 2
    offset = halves / np.sqrt(3)
    return basis_matrix(
        np.stack([centers - offset, centers + offset], axis=1).ravel(), points, degree
    )
