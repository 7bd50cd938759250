"""Results of requests to the runtime: switches to other plans, and stops."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from cnpgen.arrays import Array


class SwitchOutcome(Enum):
    """Result of a request to switch to another plan or chunk; the value is a description."""

    ACCEPTED = "accepted"
    NO_PLAN = "the planner returned no plan"
    FAILED = "the planner raised an error"
    LATE = "the plan arrived after the switch time"
    JUMP = "the plan does not start in the state at the switch"
    MOVING = "the plan does not end at rest"
    ACCELERATING = "the plan ends with an acceleration, and no slower end is valid"
    INVALID = "the plan is not valid"
    STOPPED = "the runtime was stopped: call resume() first, and plan again"
    CLOSED = "the runtime was closed"
    NOT_FINITE = "the chunk has values that are not finite"
    OUTLIER = "no motion through the chunk meets the limits"
    SHORT = "too few samples of the chunk are left at the join"
    FAR = "the motion is too far from the chunk"
    STALE = "the chunk is too old"
    REPLAYED = "the chunk is not newer than the last one"
    CLOCK = "the clock is not continuous"
    TRACKING = "the arm does not follow the set points"


@dataclass(frozen=True)
class Switch:
    """Result of a request to switch to another plan.

    Attributes:
        outcome: The result; only accepted plans are executed.
        time: Switch time [s].
        detail: Further text, such as the judge's reason; or empty.
    """

    outcome: SwitchOutcome
    time: float
    detail: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the plan is executed."""
        return self.outcome is SwitchOutcome.ACCEPTED


@dataclass(frozen=True, eq=False)
class Stop(Switch):
    """Result of ``PlanRuntime.stop``; every stop is accepted.

    Attributes:
        outcome: Always ``ACCEPTED``.
        time: Time at which the stop begins [s].
        detail: Further text, or empty.
        end_time: Time from which on the arm is at rest [s].
        distance: Distance that each joint travels from ``time`` on [rad], shape (n,).
    """

    end_time: float = np.nan
    distance: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class ChunkJoin(Switch):
    """Result of ``ChunkExecutor.step``.

    Attributes:
        outcome: The result; only accepted chunks are executed.
        time: Time of the join [s].
        detail: Further text, such as the judge's reason; or empty.
        end_time: Time from which on the arm is at rest without another chunk [s].
        distance: Largest distance of the motion from the samples of the raw chunk, over
            all joints [rad]; nan if no motion was computed.
        speed: Largest speed along the chunk, in units of its own timing.
        skipped: Number of samples that were due before the join.
    """

    end_time: float = np.nan
    distance: float = np.nan
    speed: float = np.nan
    skipped: int = 0
