"""The verdict on a sampled trajectory: valid, invalid or undecided, for every condition with its reason.

Three statements are proven. *Invalid*: no curve through the samples, within their
errors, meets a condition. *A valid motion exists*: one curve within the errors of all
samples is valid. *Valid for all curves*: every curve that meets a stated assumption is
valid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from cnpgen.documents import JsonObject
from cnpgen.judges.plans.verdict import Margin

# An error this large, in SI units, is that of a missing derivative.
DECIDING_ERROR = 1e3


class Decision(StrEnum):
    """Result for every curve that samples allow: all are valid, all are invalid, or neither is proven."""

    VALID = "valid"
    INVALID = "invalid"
    UNDECIDED = "undecided"

    __repr__ = str.__repr__


class Statement(StrEnum):
    """Statement of a verdict about the curves that samples allow."""

    INVALID = "invalid"
    EXISTS = "a valid motion exists"
    ALL = "valid for all curves"
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
            at the checked times; None if it was not measured.
        undecided_share: Share of the time in which some curves may violate it and
            others not, or None.
        detail: The proof of a decision, such as a lower bound with joint and time; empty
            without one.
    """

    decision: Decision
    reason: str
    margin: Margin
    uncertainty: float
    violated_share: float | None
    undecided_share: float | None
    detail: str = ""

    @property
    def is_measured(self) -> bool:
        """Whether the margin has a value: not if the curve lacks the derivative that it needs."""
        return self.decision != Decision.UNDECIDED or self.uncertainty < DECIDING_ERROR

    def to_dict(self) -> JsonObject:
        """Return the decision for JSON; values that were not measured are None."""
        margin = self.margin.to_dict()
        known = self.is_measured
        if not known:
            margin |= {"value": None, "violation": None}
        return {
            "decision": str(self.decision),
            "reason": self.reason,
            "detail": self.detail,
            "margin": margin,
            "uncertainty": self.uncertainty if known else None,
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
            evaluated. Lower bounds that decide leave the others out: they were not
            evaluated.
        duration: Duration [s].
        samples: Number of times that were checked.
        detail: The proof of the decision with joint and time; may be empty.
        assumption: What all curves that were judged meet; empty if none was needed.
    """

    decision: Decision
    reason: str
    conditions: Mapping[str, ConditionDecision] = field(default_factory=dict)
    duration: float = 0.0
    samples: int = 0
    detail: str = ""
    assumption: str = ""

    def __str__(self) -> str:
        text = ": ".join(part for part in (str(self.statement), self.reason) if part)
        separator = ": " if self.decision == Decision.INVALID else "; "
        return f"{text}{separator}{self.detail}" if self.detail else text

    def __repr__(self) -> str:
        return f"<TrajectoryVerdict: {self}>"

    @property
    def valid(self) -> bool:
        """Whether every curve that the samples allow is valid."""
        return self.decision == Decision.VALID

    @property
    def statement(self) -> Statement:
        """Statement about the curves: a valid motion exists if a valid verdict needs no assumption."""
        if self.decision != Decision.VALID:
            return Statement(str(self.decision))
        return Statement.ALL if self.assumption else Statement.EXISTS

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

    def to_dict(self) -> JsonObject:
        """Return the verdict for JSON."""
        return {
            "decision": str(self.decision),
            "statement": str(self.statement),
            "assumption": self.assumption,
            "reason": self.reason,
            "detail": self.detail,
            "conditions": {
                name: entry.to_dict() for name, entry in self.conditions.items()
            },
            "duration_s": self.duration,
            "samples": self.samples,
        }
