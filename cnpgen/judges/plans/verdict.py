"""The verdict on one plan: valid or not and why, how much room every condition has, and what the plan is worth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any

NOTHING = 1e-200  # stands for an allowed excess of 0, so that the largest excess can still be found


class Reason(StrEnum):
    """Why a plan is not valid; one that breaks a constraint has the constraint's own ``reason``, which is a plain text.

    These are texts, too, and print in the same way wherever they are.
    """

    OK = "ok"
    NOT_FINITE = "not finite"
    RATE = "rate not positive"
    TOO_LONG = "too long"
    BOUNDARY = "boundary conditions"

    __repr__ = str.__repr__


@dataclass(frozen=True, slots=True)
class Margin:
    """Where a plan comes closest to breaking a condition, or breaks it most.

    Attributes:
        name: The condition.
        reason: Under which reason a plan that breaks it is counted.
        unit: SI unit of value, bound, excess and allowed.
        part: Which of the condition's values: a joint, an axis, an obstacle, or empty if it has only one.
        value: The value there.
        bound: The bound that it is nearest to, or beyond.
        excess: How far beyond; negative: how far from it. inf if it could not be evaluated.
        allowed: An excess up to this is called valid.
        time: When [s].
        phase: At which phase s.
    """

    name: str
    reason: str
    unit: str
    part: str
    value: float
    bound: float
    excess: float
    allowed: float
    time: float
    phase: float

    @property
    def ok(self) -> bool:
        """Whether no more is exceeded than allowed."""
        return self.excess <= self.allowed

    @property
    def severity(self) -> float:
        """Excess in multiples of what is allowed: above 1 is not valid."""
        return self.excess / max(self.allowed, NOTHING)

    def __str__(self) -> str:
        name = f"{self.name} {self.part}".strip()
        beyond = f"{abs(self.excess):.3g} {self.unit} {'beyond' if self.excess > 0 else 'within'} {self.bound:.6g}"
        return f"{name}: {beyond} ({self.allowed:.3g} allowed) at t = {self.time:.4f} s, s = {self.phase:.4f}"

    def to_dict(self) -> dict[str, Any]:
        """Return the margin for JSON, which knows no infinity: what is not finite is None."""
        return {**_for_json({entry.name: getattr(self, entry.name) for entry in fields(self)}), "ok": self.ok}


@dataclass(frozen=True)
class Metrics:
    """What a plan is worth, by the definitions of the paper's tables; nan where it could not be evaluated.

    Attributes:
        duration: Motion time [s].
        effort: Integral of the sum over joints of (torque / limit)^2 over time [s].
        jerk: Largest jerk of a joint, in multiples of its limit, by default 5/s x that of its acceleration.
        hit_speed: Speed of the tip at the goal [m/s].
        z_error: Integral of |z - height of the table| over time [m s]; nan without a table.
        vertical_error: Integral of |roll| + |pitch| of the tip frame over time [rad s]; nan without a vertical.
    """

    duration: float = math.nan
    effort: float = math.nan
    jerk: float = math.nan
    hit_speed: float = math.nan
    z_error: float = math.nan
    vertical_error: float = math.nan

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics for JSON in the units of the paper's tables, without what does not apply."""
        values = {
            "duration_s": self.duration,
            "effort_s": self.effort,
            "jerk": self.jerk,
            "hit_speed_m_s": self.hit_speed,
            "z_error_mm_s": 1e3 * self.z_error,
            "vertical_error_rad_s": self.vertical_error,
        }
        return {name: value for name, value in values.items() if math.isfinite(value)}


@dataclass(frozen=True)
class PaperRule:
    """The looser rules by which the paper counts (``cnpgen.judges.plans.paper``).

    Attributes:
        finished: Whether the tip ends at the goal.
        valid: Whether, besides, no constraint is broken by the paper's tolerances.
        broken: What is, in words.
    """

    finished: bool = False
    valid: bool = False
    broken: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """What the independent check says about one plan.

    Attributes:
        reason: ``Reason.OK``, another ``Reason``, or the ``reason`` of the constraint that is broken worst.
        margins: Condition -> margin; without any if the plan could not be evaluated.
        metrics: Motion time, errors, effort.
        paper: The same plan by the paper's rules.
        samples: Number of moments that were looked at.
    """

    reason: str
    margins: Mapping[str, Margin] = field(default_factory=dict)
    metrics: Metrics = Metrics()
    paper: PaperRule = PaperRule()
    samples: int = 0

    def __str__(self) -> str:
        if self.valid:
            return "valid"
        return f"{self.reason} ({self.worst})" if self.worst else str(self.reason)

    def __repr__(self) -> str:
        return f"<Verdict: {self}>"

    @property
    def valid(self) -> bool:
        """Whether the plan meets its boundary conditions and every constraint, within the problem's tolerances."""
        return self.reason == Reason.OK

    @property
    def worst(self) -> Margin | None:
        """The margin of the largest severity: of those that decide about ``reason``, if the plan is not valid."""
        deciding = [margin for margin in self.margins.values() if margin.reason == self.reason]
        return max(deciding or self.margins.values(), key=lambda margin: margin.severity, default=None)

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        worst = self.worst
        return {
            "valid": self.valid,
            "reason": str(self.reason),
            "worst": worst and worst.to_dict(),
            "margins": {name: margin.to_dict() for name, margin in self.margins.items()},
            "metrics": self.metrics.to_dict(),
            "paper": {"finished": self.paper.finished, "valid": self.paper.valid, "broken": list(self.paper.broken)},
            "samples": self.samples,
        }


def _for_json(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()
    }
