"""A closer look at smooth conditions: between any two samples, until nothing is left to gain that could decide.

A condition of torques, tilt or the tip's place has no polynomial to prove it by. Between two samples h apart a function
whose second derivative is at least -D is no more than D h^2 / 8 above the line between them. D is taken from the second
differences around, and as much more as they differ among each other, so that a third derivative, an end of the motion
or a second maximum beside the first hides nothing. Where the function could so be beyond what is allowed, the interval
is divided, and its parts again, whose differences tell more.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.closer import is_contact
from cnpgen.judges.plans.measure import Measured
from cnpgen.judges.plans.sampling import APART
from cnpgen.judges.plans.survey import Survey
from cnpgen.judges.plans.verdict import Margin

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

CLOSE = 1e-8  # of what is allowed: less is not looked for where it decides whether more is exceeded than that
ROUGH = 1e-2  # the same elsewhere
FINER = 6  # parts of an interval
ROUNDS = 10  # of divisions, at most; a smooth maximum takes two or three, a kink one per factor of FINER
MOST = 256  # intervals of all conditions that are divided at a time
TINY = 1e-30  # of what is allowed


@dataclass(frozen=True)
class _Rows:
    """R rows of K samples of values of conditions.

    Attributes:
        of: Index of the row's condition among the measured ones, shape (R,).
        part: Which of its values, shape (R,).
        s: Phases, ascending, shape (R, K); (1, K) if they are the same in every row.
        share: Excess there in multiples of what is allowed, shape (R, K).
    """

    of: Indices
    part: Indices
    s: Array
    share: Array

    def promising(self, largest: Array) -> tuple[Indices, Indices, Array]:
        """Find intervals that may hide what matters, the highest first.

        Args:
            largest: What is known of every condition.

        Returns:
            ``(of, part, ends)``: I of them, ends of shape (I, 2).
        """
        least = np.maximum(largest + ROUGH, 0.0)
        least = np.where(largest <= 1, np.minimum(least, 1 + CLOSE), least)
        tops = _tops(self.s, self.share)
        row, k = (tops > least[self.of, None]).nonzero()
        if not len(row):
            return row, row, np.empty((0, 2))
        chosen = np.argsort(-tops[row, k], kind="stable")[:MOST]
        row, k = row[chosen], k[chosen]
        phases = np.broadcast_to(self.s, self.share.shape)
        return self.of[row], self.part[row], np.stack([phases[row, k], phases[row, k + 1]], axis=1)


def look_at_peaks(survey: Survey) -> Iterator[tuple[Measured, Margin]]:
    """Yield conditions that are no contacts, and their margins in intervals that could decide.

    Args:
        survey: A motion; its world is moved.
    """
    smooth = [each for each in survey.measured if not is_contact(each.constraint)]
    largest = np.array([each.share.max() for each in smooth])
    rows = _first(survey.samples.s, smooth)
    for _ in range(ROUNDS):
        of, part, ends = rows.promising(largest)
        if not len(of):
            break
        s = np.linspace(ends[:, 0], ends[:, 1], FINER + 1, axis=1)
        survey.move(s.ravel())
        rows = _Rows(of, part, s, np.empty_like(s))
        for k in np.unique(of).tolist():
            found, its = _again(survey, smooth[k], s.ravel()), of == k
            yield smooth[k], survey.margin(found, s.ravel())
            rows.share[its] = found.share.reshape(-1, *s.shape)[part[its], its]
            largest[k] = max(largest[k], found.share.max())


def _again(survey: Survey, each: Measured, s: Array) -> Measured:
    """Measure a condition at other phases."""
    found = survey.measure(each.constraint, s)
    return next(other for other in found if other.condition.name == each.condition.name)


def _first(s: Array, measured: Sequence[Measured]) -> _Rows:
    """Return the samples of every value of every condition."""
    parts = [(k, part) for k, each in enumerate(measured) for part in range(len(each.share))]
    of, part = np.array(parts, np.intp).reshape(-1, 2).T
    share = np.concatenate([np.empty((0, len(s))), *(each.share for each in measured)])
    if (s[1:] - s[:-1] <= APART).any():
        apart = np.flatnonzero(np.diff(np.floor(s / APART), prepend=-1.0) > 0)  # the first one of each cell
        apart = apart[np.diff(s[apart], prepend=-1.0) > APART / 2]
        s, share = s[apart], share[:, apart]
    return _Rows(of, part, s[None], share)


def _tops(s: Array, values: Array) -> Array:
    """Estimate from above how large functions are between neighbouring samples, shape (rows, K - 1)."""
    step, rise = s[:, 1:] - s[:, :-1], values[:, 1:] - values[:, :-1]
    slope = rise / step
    bend = (slope[:, 1:] - slope[:, :-1]) / ((step[:, 1:] + step[:, :-1]) / 2)
    around = np.concatenate([bend[:, :1], bend[:, :1], bend, bend[:, -1:], bend[:, -1:]], axis=1)
    low, high = _of_four(np.minimum, around), _of_four(np.maximum, around)  # at both ends of an interval, and beyond
    sag = np.maximum((high - 2 * low) * (step**2 / 2), TINY)
    over = np.maximum(sag - np.abs(rise), 0.0)
    return np.asarray(np.maximum(values[:, 1:], values[:, :-1]) + over**2 / (4 * sag))


def _of_four(pick: np.ufunc, values: Array) -> Array:
    """Return the least or the largest one of every four neighbours in a row."""
    pairs = pick(values[:, 1:], values[:, :-1])
    return np.asarray(pick(pairs[:, 2:], pairs[:, :-2]))
