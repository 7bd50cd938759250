"""Stops and ends of motions along their path: the earliest feasible time law of a family, measured before its use."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cnpgen.addons.online.motion_check import MotionChecker
from cnpgen.addons.online.path_timing import (
    PathLimits,
    TimeLaw,
    keeps_limits,
    path_limits,
    retimed,
    shape_table,
    shapes,
)
from cnpgen.addons.online.set_points import SampledMotion

MAX_BRAKING_TIME_S = 1.5  # that is searched; slower motions continue to their end
MIN_BRAKING_TIME_S = 4e-3
DELAYS_S = np.array([0.0, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15])  # before braking
BISECTIONS = 9  # of the braking time
MAX_MEASURED_LAWS = 4  # then the motion continues to its end
SLOWER_STEP = 1.25  # of braking times after a measurement that found a violation
SMOOTH_END_TIMES_S = np.array([0.03, 0.05, 0.08, 0.12, 0.18, 0.26, 0.38, 0.55, 0.8])


def earliest_stop(
    checker: MotionChecker, motion: SampledMotion, time: float, *, measured: bool
) -> SampledMotion:
    """Return the motion that follows another one and stops on its path as early as possible after a time [s].

    The result is the motion itself if no stop of the family ends before it. With
    ``measured``, all constraints are measured along the stop. The work is bounded:
    ``BISECTIONS`` evaluations of ``DELAYS_S`` times the shapes, and at most
    ``MAX_MEASURED_LAWS`` measurements.
    """
    time = max(time, motion.start)
    left = motion.end_time - time
    if motion.plan is None or left <= MIN_BRAKING_TIME_S:
        return motion
    # Stops longer than this are not searched; the motion ends by itself.
    horizon = min(left, MAX_BRAKING_TIME_S)
    limits = path_limits(checker, motion, time, time + horizon)
    best = _earliest_law(limits, time, horizon)
    for law in [] if best is None else _slower(best, time + left):
        # Between the phases that were compared, the motion may have a kink.
        if not keeps_limits(limits, motion, law):
            continue
        stop = retimed(motion, law)
        if not measured or not checker.violation(stop, time, law.end):
            return stop
    return motion


def _earliest_law(limits: PathLimits, time: float, horizon: float) -> TimeLaw | None:
    """Return the feasible time law that ends first, None if none ends before the horizon [s] after a time.

    Every combination of a delay and a shape is bisected for its minimum feasible
    duration. Longer ones are feasible, too, except where the path becomes harder.
    """
    count = len(shapes())
    # All combinations of delays and shapes are evaluated together.
    shape = np.tile(np.arange(count, dtype=np.int64), len(DELAYS_S))
    delay = np.repeat(DELAYS_S, count)
    high = horizon - delay
    possible = high > MIN_BRAKING_TIME_S
    shape = shape[possible]
    delay = delay[possible]
    high = high[possible]
    # The longest duration counts as found, if it is feasible.
    feasible = limits.feasible(time + delay, high, shape)
    low = np.full_like(high, MIN_BRAKING_TIME_S)
    for _ in range(BISECTIONS):
        midpoint = (low + high) / 2
        shorter = limits.feasible(time + delay, midpoint, shape)
        feasible |= shorter
        # High ends stay feasible, low ends are not.
        low = np.where(shorter, low, midpoint)
        high = np.where(shorter, midpoint, high)
    if not feasible.any():
        return None
    # The law that ends first wins, whatever its delay.
    best = int(np.argmin(np.where(feasible, delay + high, np.inf)))
    return TimeLaw(time + delay[best], float(high[best]), *shapes()[shape[best]])


def _slower(law: TimeLaw, end: float) -> Iterator[TimeLaw]:
    """Yield a time law and slower ones that end before a time [s]."""
    for attempt in range(MAX_MEASURED_LAWS):
        duration = law.duration * SLOWER_STEP**attempt
        if law.start + duration >= end:
            return
        yield TimeLaw(law.start, duration, law.rise, law.fall)


def with_smooth_end(
    checker: MotionChecker, motion: SampledMotion, *, measured: bool
) -> SampledMotion | None:
    """Return a motion whose end is slower, so that its acceleration falls to zero, None if none is feasible.

    The time law begins at the time from which the rest of the path takes the share of
    the duration that the law travels. The one that adds the least time is taken.
    """
    length = motion.end_time - motion.start
    limits = path_limits(checker, motion, motion.start, motion.end_time)
    travel = shape_table()[2][:, -1]
    duration = np.repeat(SMOOTH_END_TIMES_S, len(travel))
    shape = np.tile(np.arange(len(travel), dtype=np.int64), len(SMOOTH_END_TIMES_S))
    # Of the motion that is retimed [s].
    # Travel is the share of the duration that the path would take at full speed.
    path = duration * travel[shape]
    begin = motion.end_time - path
    feasible = (path < length) & limits.feasible(
        np.maximum(begin, motion.start), duration, shape
    )
    # A law of duration T replaces a part of length T travel.
    added = np.where(feasible, duration - path, np.inf)
    for best in np.argsort(added)[:MAX_MEASURED_LAWS].tolist():
        if not feasible[best]:
            break
        law = TimeLaw(begin[best], float(duration[best]), *shapes()[shape[best]])
        slower = retimed(motion, law)
        if not measured or not checker.violation(slower, law.start, law.end):
            return slower
    return None
