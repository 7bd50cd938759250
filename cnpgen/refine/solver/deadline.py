"""How much time is left for the steps of several iterations."""

import time
from dataclasses import dataclass

UNEVEN = 1.3  # times the longest step that there was is left for the next


@dataclass
class Deadline:
    """When the steps of some iterations should be over.

    Attributes:
        until: As ``time.perf_counter`` counts [s].
        longest: What the longest step so far took, and some more [s].
    """

    until: float
    longest: float = 0.0

    def allows(self, steps: int) -> bool:
        """Whether there is time for as many steps."""
        return time.perf_counter() + steps * self.longest <= self.until

    def note(self, begun: float) -> None:
        """Take note of a step that is over and begun at ``begun``."""
        self.longest = max(self.longest, UNEVEN * (time.perf_counter() - begun))
