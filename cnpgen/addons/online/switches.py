"""Results of requests to the runtime: switches to other plans, and stops."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class SwitchOutcome(Enum):
    """Result of a request to switch to another plan; the value is a description."""

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
