"""Progress along action chunks: the chunk time that an arm has reached, and the columns that are no joints."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from cnpgen.addons.online.chunk_checks import SAMPLE_ROUNDING
from cnpgen.addons.online.chunk_motions import ChunkMotion
from cnpgen.addons.online.plan_runtime import PlanRuntime
from cnpgen.arrays import Array
from cnpgen.plans.plans import Plans

MAX_CHUNKS = 32  # that are kept


@dataclass(frozen=True, eq=False)
class ExecutedChunk:
    """A chunk that is executed, or was.

    Attributes:
        plan: Its motion.
        start: Time of the join [s].
        progress: Progress at the join [s].
        times: Times since the join, shape (P,), at which ``chunk_times`` are reached [s].
        chunk_times: Chunk times since the join [s], increasing, shape (P,).
        others: Other columns of the samples from the join on, shape (K, D - n).
        step: Time between samples [s].
    """

    plan: Plans
    start: float
    progress: float
    times: Array
    chunk_times: Array
    others: Array
    step: float

    def chunk_time(self, time: float) -> float:
        """Return the chunk time at a time since the join [s]."""
        return float(np.interp(time, self.times, self.chunk_times))

    def others_at(self, time: float) -> Array:
        """Return the other columns of the last sample that is reached at a time since the join [s], shape (D - n,)."""
        # Rounded down: other columns never lead the joints.
        sample = int(self.chunk_time(time) / self.step + SAMPLE_ROUNDING)
        return np.asarray(self.others[min(sample, len(self.others) - 1)])


class ChunkProgress:
    """Progress of a runtime along the chunks that it executes.

    Progress is the time that has passed on the chunks' own clocks, over all chunks. A
    motion at twice the speed of its chunk makes 2 s of progress in a second.
    """

    def __init__(self, runtime: PlanRuntime) -> None:
        self._runtime = runtime
        self._chunks: deque[ExecutedChunk] = deque(maxlen=MAX_CHUNKS)

    def executed(self, motion: ChunkMotion, plan: Plans, at: float) -> ExecutedChunk:
        """Return the chunk of a motion that joins at a time [s] with a plan of one of its speeds."""
        fit = motion.fit
        s = np.linspace(0, 1, len(motion.fit.times))
        # Equal phases connect the time of the motion with the chunk time.
        times = plan.motion.time_at(s)[0]
        before = self.at(at)
        return ExecutedChunk(
            plan, at, before, times, fit.times, motion.others, fit.step
        )

    def add(self, chunk: ExecutedChunk) -> None:
        """Add a chunk that is executed from its join on."""
        self._chunks.append(chunk)

    def remove(self, chunk: ExecutedChunk) -> None:
        """Remove a chunk that is not executed."""
        self._chunks.remove(chunk)

    def at(self, time: float) -> float:
        """Return the progress at a time [s]."""
        chunk, since = self._chunk_at(time)
        return 0.0 if chunk is None else chunk.progress + chunk.chunk_time(since)

    def others_at(self, time: float) -> Array:
        """Return the other columns at a time [s], shape (D - n,); empty before the first chunk."""
        chunk, since = self._chunk_at(time)
        return np.zeros(0) if chunk is None else chunk.others_at(since)

    def next_sample(
        self, observed: float, earliest: float, rate: float
    ) -> tuple[float, int]:
        """Return the first time [s] from ``earliest`` on at which a new chunk's sample is due, and its index.

        Sample 0 is due at ``observed``. If the arm rests before it reaches the next
        sample, the result is the earliest time and the nearest sample.
        """
        before = self.at(observed)
        # Samples that the arm has passed at the join, since the observation.
        due = (self.at(earliest) - before) * rate
        sample = int(np.ceil(due - SAMPLE_ROUNDING))
        chunk, since = self._chunk_at(earliest)
        if chunk is None:
            return earliest, 0
        # Chunk time of the sample within the running chunk.
        target = before + sample / rate - chunk.progress
        if target >= chunk.chunk_times[-1]:
            return earliest, round(due)
        reached = float(np.interp(target, chunk.chunk_times, chunk.times))
        # A sample that is due already is followed at once.
        return earliest + max(reached - since, 0.0), sample

    def _chunk_at(self, time: float) -> tuple[ExecutedChunk | None, float]:
        """Return the chunk whose path is followed at a time [s], and the time since its join at which it is there [s].

        At rest it is the end of the last chunk before.
        """
        plan, since = self._runtime.plan_at(time)
        # The latest chunk of a plan counts.
        for chunk in reversed(self._chunks):
            if chunk.plan is plan:
                return chunk, since
        earlier = [chunk for chunk in self._chunks if chunk.start <= time]
        return (earlier[-1], np.inf) if earlier else (None, 0.0)
