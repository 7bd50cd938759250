"""Deadline of a sequence of steps: iterations of a solver, or verdicts."""

import time
from dataclasses import dataclass

STEP_TIME_FACTOR = 1.3  # times the largest duration of a step so far is reserved for the next


@dataclass
class Deadline:
    """Time at which steps must have ended.

    Attributes:
        until: Time in the clock of ``time.perf_counter`` [s].
        max_duration: Time reserved for one step: the largest so far, times ``STEP_TIME_FACTOR`` [s].
    """

    until: float
    max_duration: float = 0.0

    def allows(self, steps: int) -> bool:
        """Return whether there is time for so many steps."""
        return time.perf_counter() + steps * self.max_duration <= self.until

    def note(self, begun: float) -> None:
        """Record a step that started at ``begun`` and has just ended."""
        self.max_duration = max(self.max_duration, STEP_TIME_FACTOR * (time.perf_counter() - begun))
