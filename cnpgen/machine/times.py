"""Where the time of a run went: into preparing (compiling kernels, if they are not cached), computing and waiting."""

import time
from dataclasses import asdict, dataclass, field


@dataclass(frozen=True)
class Times:
    """The time that has passed in a run, in parts [s].

    Attributes:
        preparing: Until everything was prepared: above all kernels are compiled, unless they are in the cache.
        computing: CPU time after that, of each of the processes that share the work.
        waiting: The rest: for the processor where other jobs use it, for the disk, or for the last process.
    """

    preparing: float = 0.0
    computing: float = 0.0
    waiting: float = 0.0

    @property
    def passed(self) -> float:
        """All of it [s]."""
        return self.preparing + self.computing + self.waiting

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
    """Measures a run from when it is made.

    Attributes:
        begun: When that was [s].
        preparing: How long everything took to prepare [s].
        computing: CPU time of each process since then [s]; whoever computes in other processes adds to it.
    """

    begun: float = field(default_factory=time.perf_counter)
    preparing: float = 0.0
    computing: float = 0.0
    _cpu: float = 0.0

    def prepared(self) -> None:
        """Note that everything is prepared."""
        self.preparing, self._cpu = time.perf_counter() - self.begun, time.process_time()

    def computed_here(self) -> None:
        """Note that this process has computed since all was prepared, and no other one."""
        self.computing = time.process_time() - self._cpu

    def times(self) -> Times:
        """Say where the time went until now."""
        left = time.perf_counter() - self.begun - self.preparing
        return Times(self.preparing, self.computing, max(left - self.computing, 0.0))
