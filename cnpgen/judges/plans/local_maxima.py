"""Search for local maxima of smooth conditions between samples, until no further one could change the verdict.

Conditions on torques, tilt or the tip's position are not polynomials, so their bounds
cannot be proven. Between two samples at a distance of h, a function whose second
derivative is at least -D exceeds the chord by at most D h^2 / 8. D is estimated from
the neighboring second differences, increased by their spread, so that a third
derivative, an end of the motion or a second maximum next to the first is not missed.
Intervals in which the function could exceed its tolerance are divided again, which also
improves the estimates of D.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Indices
from cnpgen.judges.plans.continuous_collision import is_contact
from cnpgen.judges.plans.measure import EvaluationContext, MeasuredCondition
from cnpgen.judges.plans.sampling import MIN_PHASE_STEP
from cnpgen.judges.plans.verdict import Margin

# Relative to the tolerance: error of a maximum that decides about the verdict.

PEAK_DECISION_TOLERANCE = 1e-8
PEAK_VALUE_TOLERANCE = 1e-2  # relative to the tolerance: error of any other maximum
PEAK_PARTS = 6  # of an interval
# Of division; a smooth maximum needs two or three, a kink one per factor of PEAK_PARTS.
MAX_PEAK_ROUNDS = 10
MAX_PEAK_INTERVALS = 256  # of all conditions that are divided at a time
MIN_CURVATURE = 1e-30  # relative to the tolerance


@dataclass(frozen=True)
class _SampledValues:
    """R rows of K samples of values of conditions."""

    of: Indices  # index of the row's condition among the measured ones, shape (R,)
    part: Indices  # index of the row's value in the condition, shape (R,)
    # Phases, ascending, shape (R, K); (1, K) if they are the same in every row.
    s: Array
    violation: Array  # violations in multiples of the tolerance, shape (R, K)

    def promising(self, largest: Array) -> tuple[Indices, Indices, Array]:
        """Find intervals that may contain a larger maximum than the known ones, the highest estimate first.

        Returns:
            ``(of, part, ends)`` of I intervals; ends have shape (I, 2).
        """
        # A maximum matters if it would change the verdict (cross 1), or the printed value
        # by more than its tolerance.
        # Below 0 a condition is far from its bound in every unit; small changes there
        # do not matter.
        threshold = np.maximum(largest + PEAK_VALUE_TOLERANCE, 0.0)
        threshold = np.where(
            largest <= 1, np.minimum(threshold, 1 + PEAK_DECISION_TOLERANCE), threshold
        )
        maxima = _estimated_maxima(self.s, self.violation)
        row, k = (maxima > threshold[self.of, None]).nonzero()
        if not len(row):
            return row, row, np.empty((0, 2))
        chosen = np.argsort(-maxima[row, k], kind="stable")[:MAX_PEAK_INTERVALS]
        row = row[chosen]
        k = k[chosen]
        # Rows share their phases at first; they have their own after a division.
        phases = np.broadcast_to(self.s, self.violation.shape)
        return (
            self.of[row],
            self.part[row],
            np.stack([phases[row, k], phases[row, k + 1]], axis=1),
        )


def check_local_maxima(
    context: EvaluationContext,
) -> Iterator[tuple[MeasuredCondition, Margin]]:
    """Yield smooth conditions and their margins in intervals that could change the verdict; the world is moved."""
    smooth = [
        condition
        for condition in context.measured
        if not is_contact(condition.constraint)
    ]
    largest = np.array([condition.relative_violation.max() for condition in smooth])
    values = _initial_values(context.samples.s, smooth)
    for _ in range(MAX_PEAK_ROUNDS):
        of, part, ends = values.promising(largest)
        if not len(of):
            break
        s = np.linspace(ends[:, 0], ends[:, 1], PEAK_PARTS + 1, axis=1)
        # All intervals of all conditions at once: one batch of kinematics.
        context.move(s.ravel())
        values = _SampledValues(of, part, s, np.empty_like(s))
        for k in np.unique(of).tolist():
            measured = _measured_again(context, smooth[k], s.ravel())
            rows = of == k
            yield smooth[k], context.margin(measured, s.ravel())
            values.violation[rows] = measured.relative_violation.reshape(-1, *s.shape)[
                part[rows], rows
            ]
            largest[k] = max(largest[k], measured.relative_violation.max())


def _measured_again(
    context: EvaluationContext, condition: MeasuredCondition, s: Array
) -> MeasuredCondition:
    """Measure a condition at other phases."""
    measured = context.measure(condition.constraint, s)
    return next(
        other for other in measured if other.condition.name == condition.condition.name
    )


def _initial_values(s: Array, measured: Sequence[MeasuredCondition]) -> _SampledValues:
    """Return the samples of every value of every condition."""
    parts = [
        (k, part)
        for k, condition in enumerate(measured)
        for part in range(len(condition.relative_violation))
    ]
    of, part = np.array(parts, np.intp).reshape(-1, 2).T
    violation = np.concatenate(
        [
            np.empty((0, len(s))),
            *(condition.relative_violation for condition in measured),
        ]
    )
    if (s[1:] - s[:-1] <= MIN_PHASE_STEP).any():
        # The first of each cell.
        distinct = np.flatnonzero(
            np.diff(np.floor(s / MIN_PHASE_STEP), prepend=-1.0) > 0
        )
        distinct = distinct[np.diff(s[distinct], prepend=-1.0) > MIN_PHASE_STEP / 2]
        s = s[distinct]
        violation = violation[:, distinct]
    return _SampledValues(of, part, s[None], violation)


def _estimated_maxima(s: Array, values: Array) -> Array:
    """Estimate upper bounds of functions between neighboring samples, shape (rows, K - 1)."""
    # Divided differences estimate the second derivative C at every inner sample. Between
    # two samples the function is at most the parabola with the largest plausible |C|
    # through them: its apex lies (c - |rise|)^2 / (4 c) above the higher sample, with
    # c = C step^2 / 2, if it lies between them at all (c > |rise|).
    step = s[:, 1:] - s[:, :-1]
    rise = values[:, 1:] - values[:, :-1]
    rate = rise / step
    second = (rate[:, 1:] - rate[:, :-1]) / ((step[:, 1:] + step[:, :-1]) / 2)
    around = np.concatenate(
        [second[:, :1], second[:, :1], second, second[:, -1:], second[:, -1:]], axis=1
    )
    # At both ends of an interval and next to it.
    low = _of_four(np.minimum, around)
    high = _of_four(np.maximum, around)
    # Curvature estimates are wrong by the spread of the four around an interval: with
    # low the most negative one, -low + (high - low) bounds the curvature downwards.
    curvature = np.maximum((high - 2 * low) * (step**2 / 2), MIN_CURVATURE)
    excess = np.maximum(curvature - np.abs(rise), 0.0)
    return np.asarray(
        np.maximum(values[:, 1:], values[:, :-1]) + excess**2 / (4 * curvature)
    )


def _of_four(select: np.ufunc, values: Array) -> Array:
    """Return the minimum or maximum of every four neighbors in a row."""
    pairs = select(values[:, 1:], values[:, :-1])
    return np.asarray(select(pairs[:, 2:], pairs[:, :-2]))
