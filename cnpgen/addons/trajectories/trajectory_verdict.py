"""The verdict on a sampled trajectory: valid, invalid or undecided, for every condition with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from cnpgen.judges.plans.verdict import Margin


class Decision(StrEnum):
    """Result for every curve that samples allow: all are valid, all are invalid, or neither is proven."""

    VALID = "valid"
    INVALID = "invalid"
    UNDECIDED = "undecided"

    __repr__ = str.__repr__


@dataclass(frozen=True)
class ConditionDecision:
    """Decision on one condition of a problem.

    Attributes:
        decision: The decision.
        reason: Reason of a decision that is not valid; empty for a valid one.
        margin: Smallest margin, or largest violation, of any curve that the samples
            allow.
        uncertainty: Largest difference of the value from that of the nominal curve,
            there [unit of the margin].
        violated_share: Share of the time in which every curve violates the condition,
            at the checked times.
        undecided_share: Share of the time in which some curves may violate it and
            others not.
    """

    decision: Decision
    reason: str
    margin: Margin
    uncertainty: float
    violated_share: float
    undecided_share: float

    def to_dict(self) -> dict[str, Any]:
        """Return the decision for JSON."""
        return {
            "decision": str(self.decision),
            "reason": self.reason,
            "margin": self.margin.to_dict(),
            "uncertainty": self.uncertainty,
            "violated_share": self.violated_share,
            "undecided_share": self.undecided_share,
        }


@dataclass(frozen=True)
class TrajectoryVerdict:
    """Verdict on one sampled trajectory.

    Attributes:
        decision: Invalid if a condition is, valid if all are, else undecided.
        reason: Reason of a decision that is not valid: of the deciding condition; empty
            for a valid one.
        conditions: Condition -> decision; empty if the trajectory could not be
            evaluated.
        duration: Duration [s].
        samples: Number of times that were checked.
    """

    decision: Decision
    reason: str
    conditions: Mapping[str, ConditionDecision] = field(default_factory=dict)
    duration: float = 0.0
    samples: int = 0

    def __str__(self) -> str:
        return f"{self.decision}: {self.reason}" if self.reason else str(self.decision)

    def __repr__(self) -> str:
        return f"<TrajectoryVerdict: {self}>"

    @property
    def valid(self) -> bool:
        """Whether every curve that the samples allow is valid."""
        return self.decision == Decision.VALID

    @property
    def decisive(self) -> str:
        """Name of the condition that decides: the worst one of the verdict's decision; empty without conditions."""
        deciding = {
            name: entry
            for name, entry in self.conditions.items()
            if entry.decision == self.decision
        }
        return max(
            deciding, key=lambda name: deciding[name].margin.severity, default=""
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        return {
            "decision": str(self.decision),
            "reason": self.reason,
            "conditions": {
                name: entry.to_dict() for name, entry in self.conditions.items()
            },
            "duration_s": self.duration,
            "samples": self.samples,
        }
