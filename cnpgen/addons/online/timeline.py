"""The motions that a runtime executes one after the other, and the set points that it has served."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cnpgen.addons.online.set_points import SampledMotion, SetPoint
from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.schema.arguments import distinct

CLOCK_ROUNDING_S = 1e-9  # by which equal times of a clock may differ


class Timeline:
    """Motions in the order of their starts; each is executed until the next one starts.

    Args:
        first: First motion.
        history: Time for which executed motions are kept [s].
        max_step: Largest step of each joint between two set points [rad], shape (n,).

    Attributes:
        now: Last time of a set point [s]; before the first one, the start of the first
            motion.
    """

    def __init__(
        self, first: SampledMotion, *, history: float, max_step: Array
    ) -> None:
        self._parts: tuple[SampledMotion, ...] = (first,)
        self._history = history
        self._max_step = max_step
        self._last_q: Array | None = None  # last set point
        self.now = first.start

    def __iter__(self) -> Iterator[SampledMotion]:
        """Iterate over the kept motions in the order of their starts."""
        return iter(self._parts)

    @property
    def end_time(self) -> float:
        """Time from which on the arm is at rest [s]."""
        return self._parts[-1].end_time

    def serve(self, times: Array) -> SetPoint:
        """Return the states at ascending times [s], shape () or (K,), and advance the clock to the last one.

        Raises:
            UsageError: A time is before the last one, or a step is too large. Nothing
                changes then.
        """
        flat = np.atleast_1d(times)
        if flat[0] < self.now - CLOCK_ROUNDING_S:
            got, last = distinct(flat[0], self.now)
            raise UsageError(
                f"must not be before the last set point, at {last} s, got {got} s",
                argument="time",
            )
        states = self._evaluate(flat)
        # The first set point after a restart has no predecessor.
        q = states.q if self._last_q is None else np.vstack([self._last_q, states.q])
        steps = np.abs(np.diff(q, axis=0))
        if (steps > self._max_step).any():
            row, joint = divmod(int((steps / self._max_step).argmax()), q.shape[1])
            step, limit = distinct(steps[row, joint], self._max_step[joint])
            raise UsageError(
                f"must have smaller steps: joint {joint + 1} would step by {step} rad,"
                f" expected at most {limit} rad (max_step)",
                argument="time",
            )
        # Nothing changes before all checks have passed.
        self.now = max(self.now, float(flat[-1]))
        self._last_q = states.q[-1]
        return _shaped(states, times)

    def state_at(self, times: Array) -> SetPoint:
        """Return the states at ascending times [s], shape () or (K,), from the kept history on.

        Raises:
            UsageError: A time is before the history that is kept.
        """
        first = max(self._parts[0].start, self.now - self._history)
        flat = np.atleast_1d(times)
        if flat[0] < first - CLOCK_ROUNDING_S:
            got, begin = distinct(flat[0], first)
            raise UsageError(
                f"must be from {begin} s on, where the kept motions begin, got {got} s",
                argument="time",
            )
        return _shaped(self._evaluate(flat), times)

    def part_at(self, time: float) -> SampledMotion:
        """Return the motion in execution at a time [s]."""
        return next(
            (part for part in reversed(self._parts) if part.start <= time),
            self._parts[0],
        )

    def append(self, motion: SampledMotion) -> list[float]:
        """Execute a motion from its start on; return the starts of later ones that it replaces [s]."""
        replaced = self.drop_after(motion.start)
        parts = (*self._parts, motion)
        # The motion in execution at the begin of the history is kept, too.
        oldest = self.now - self._history
        first = max(
            (index for index, part in enumerate(parts) if part.start <= oldest),
            default=0,
        )
        self._parts = parts[first:]
        return replaced

    def drop_after(self, time: float) -> list[float]:
        """Drop motions that start at a time [s] or later and have not begun; return their starts."""
        later = [
            # Motions that have begun are executed already.
            part
            for part in self._parts[1:]
            if part.start >= time and part.start > self.now
        ]
        self._parts = tuple(part for part in self._parts if part not in later)
        return [part.start for part in later]

    def replace_last(self, motion: SampledMotion) -> None:
        """Replace the last motion by one that equals it until now."""
        self._parts = (*self._parts[:-1], motion)

    def restart(self, motion: SampledMotion) -> None:
        """Execute a motion of an arm that was moved or measured; the next set point is no step."""
        self.append(motion)
        self._last_q = None

    def _evaluate(self, times: Array) -> SetPoint:
        """Return the states at ascending times, shape (K,)."""
        # Times in the last motion need no search.
        last = self._parts[-1]
        if times[0] >= last.start:
            return last.at(times)
        starts = np.array([part.start for part in self._parts])
        # Times before the first motion, by rounding, belong to it.
        index = np.maximum(np.searchsorted(starts, times, side="right") - 1, 0)
        rows = [self._parts[part].at(times[index == part]) for part in np.unique(index)]
        return SetPoint(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))


def _shaped(states: SetPoint, times: Array) -> SetPoint:
    """Return states at times of shape () without the axis of times."""
    return states if times.ndim else SetPoint(*(values[0] for values in states))
