"""Times of a run: preparation (including the compilation of kernels that are not cached), computation, waiting."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field


@dataclass(frozen=True)
class Times:
    """Elapsed time of a run, in parts [s].

    Attributes:
        preparing: Time of the preparation, mainly of kernels that are not cached.
        computing: CPU time after the preparation, per process.
        waiting: Remaining time: waiting for the processor, the disk or the last
            process.
    """

    preparing: float = 0.0
    computing: float = 0.0
    waiting: float = 0.0

    @property
    def passed(self) -> float:
        """Total elapsed time [s]."""
        return self.preparing + self.computing + self.waiting

    def __add__(self, other: Times) -> Times:
        return Times(
            self.preparing + other.preparing,
            self.computing + other.computing,
            self.waiting + other.waiting,
        )

    def __str__(self) -> str:
        return (
            f"{self.passed:.1f} s ({self.preparing:.1f} s preparing and compiling, {self.computing:.1f} s computing,"
            f" {self.waiting:.1f} s waiting)"
        )

    def rounded(self) -> dict[str, float]:
        """Return the parts for JSON, to milliseconds."""
        return {name: round(seconds, 3) for name, seconds in asdict(self).items()}


NO_TIME = Times()


@dataclass
class Stopwatch:
    """Stopwatch of a run, started at construction.

    Attributes:
        begun: Start time [s].
        preparing: Duration of the preparation [s].
        computing: CPU time per process after the preparation [s]; callers add the time
            of other processes.
    """

    begun: float = field(default_factory=time.perf_counter)
    preparing: float = 0.0
    computing: float = 0.0
    _cpu: float = 0.0

    def prepared(self) -> None:
        """Record the end of the preparation."""
        self.preparing = time.perf_counter() - self.begun
        self._cpu = time.process_time()

    def computed_here(self) -> None:
        """Record the CPU time of this process as the computing time."""
        self.computing = time.process_time() - self._cpu

    def times(self) -> Times:
        """Return the times until now."""
        left = time.perf_counter() - self.begun - self.preparing
        # Elapsed time after the preparation that was not computing; the clocks of CPU
        # and wall may differ slightly.
        return Times(self.preparing, self.computing, max(left - self.computing, 0.0))
