"""The clock of a caller: times that must be continuous, converted to those of a runtime."""

from __future__ import annotations

import threading

import numpy as np

ROUNDING_S = 1e-9  # by which equal times of a clock may differ


class CallersClock:
    """Conversion of times; after a step of the clock, the time of the runtime continues.

    Args:
        max_step: Largest step of the clock from the last set point [s].

    Attributes:
        offset: Time of the caller minus that of the runtime [s]; None before the first.
    """

    def __init__(self, max_step: float) -> None:
        self.offset: float | None = None
        self._max_step = max_step
        self._last_step = -np.inf
        self._lock = threading.Lock()

    def read(self, time: float, now: float, *, is_step: bool) -> tuple[float, bool]:
        """Return the runtime's time at a time [s], and whether the clock is continuous.

        ``now`` is the time of the runtime's last set point. Set points must not be
        before it. Times of ``ChunkExecutor.step`` may be, since another thread may have
        served set points meanwhile, but not before those of earlier steps.
        """
        with self._lock:
            if self.offset is None:
                self.offset = time - now
            inner = time - self.offset
            earliest = now - ROUNDING_S - (self._max_step if is_step else 0.0)
            is_continuous = earliest <= inner <= now + self._max_step
            if is_step:
                is_continuous &= time >= self._last_step
                self._last_step = time
            if is_continuous:
                return inner if is_step else max(inner, now), True
            self.offset = time - now
            return now, False

    def last(self, now: float) -> float:
        """Return the last time of the caller [s]; -inf before the first."""
        return (
            -np.inf if self.offset is None else max(self._last_step, now + self.offset)
        )
