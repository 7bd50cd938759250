"""The verdict on one plan: validity and reason, the margin of every condition, and metrics; summaries of many."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum

import numpy as np

from cnpgen.documents import JsonObject
from cnpgen.schema.html_table import html_table

# Replaces a tolerance of 0 in relative violations, so that they can be compared.
ZERO_TOLERANCE = 1e-200


class Reason(StrEnum):
    """Reason for which a plan is not valid.

    A plan that violates a constraint has the constraint's own ``reason`` instead, which
    is a plain text.
    """

    OK = "ok"
    NOT_FINITE = "not finite"
    RATE = "rate not positive"
    TOO_LONG = "too long"
    BOUNDARY = "boundary conditions"

    __repr__ = str.__repr__


@dataclass(frozen=True, slots=True)
class Margin:
    """Margin of a condition where a plan comes closest to violating it, or its largest violation.

    Attributes:
        name: Name of the condition.
        reason: Reason under which a violation is counted.
        unit: SI unit of value, bound, violation and tolerance.
        part: Name of the condition's value: a joint, an axis, an obstacle, or empty if
            it has only one.
        value: Value of the condition.
        bound: Bound that is closest or violated.
        violation: Signed distance outside the bound, negative inside; inf if it could
            not be evaluated.
        tolerance: Largest violation that is accepted as valid.
        time: Time [s].
        phase: Phase s.
    """

    name: str
    reason: str
    unit: str
    part: str
    value: float
    bound: float
    violation: float
    tolerance: float
    time: float
    phase: float

    @property
    def ok(self) -> bool:
        """Whether the violation is within the tolerance."""
        return self.violation <= self.tolerance

    @property
    def severity(self) -> float:
        """Violation in multiples of the tolerance: values above 1 are not valid."""
        return self.violation / max(self.tolerance, ZERO_TOLERANCE)

    def __str__(self) -> str:
        name = f"{self.name} {self.part}".strip()
        side = "outside" if self.violation > 0 else "within"
        distance = f"{abs(self.violation):.3g} {self.unit} {side} {self.bound:.6g}"
        return f"{name}: {distance} (tolerance {self.tolerance:.3g}) at t = {self.time:.4f} s, s = {self.phase:.4f}"

    def to_dict(self) -> JsonObject:
        """Return the margin for JSON; values that are not finite are None."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        infinite = {
            name: None
            for name, value in values.items()
            if isinstance(value, float) and not math.isfinite(value)
        }
        return {**values, **infinite, "ok": self.ok}


@dataclass(frozen=True)
class Metrics:
    """Metrics of a plan, as defined in the paper's tables; nan if they could not be evaluated.

    Attributes:
        duration: Motion time [s].
        effort: Integral of the sum over joints of (torque / limit)^2 over time [s],
            with drives that of the motors without dry friction.
        jerk: Largest jerk of a joint, in multiples of its limit, by default 5/s x that
            of its acceleration.
        hit_speed: Speed of the tip at the goal [m/s].
        z_error: Integral of |z - height of the table| over time [m s]; nan without a
            table.
        vertical_error: Integral of |roll| + |pitch| of the tip frame over time [rad s];
            nan without a vertical.
    """

    duration: float = math.nan
    effort: float = math.nan
    jerk: float = math.nan
    hit_speed: float = math.nan
    z_error: float = math.nan
    vertical_error: float = math.nan

    def to_dict(self) -> JsonObject:
        """Return the metrics for JSON in the units of the paper's tables, without those that do not apply."""
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
    """Result of the paper's looser rules, which the add-on ``paper`` evaluates.

    Attributes:
        finished: Whether the tip ends at the goal.
        valid: Whether, in addition, no constraint is violated by the paper's
            tolerances.
        broken: Reasons of the violated constraints.
    """

    finished: bool = False
    valid: bool = False
    broken: tuple[str, ...] = ()

    def to_dict(self) -> JsonObject:
        """Return the result for JSON."""
        return {
            "finished": self.finished,
            "valid": self.valid,
            "broken": list(self.broken),
        }


@dataclass(frozen=True)
class Verdict:
    """Result of the independent check of one plan.

    Attributes:
        reason: ``Reason.OK``, another ``Reason``, or the ``reason`` of the constraint
            with the largest violation.
        margins: Condition -> margin; empty if the plan could not be evaluated.
        metrics: Motion time, errors, effort.
        paper: Result of the paper's rules; None if they were not evaluated, since the
            add-on is missing.
        samples: Number of samples.
    """

    reason: str
    margins: Mapping[str, Margin] = field(default_factory=dict)
    metrics: Metrics = Metrics()
    paper: PaperRule | None = PaperRule()
    samples: int = 0

    def __str__(self) -> str:
        if self.valid:
            return "valid"
        return f"{self.reason} ({self.worst})" if self.worst else str(self.reason)

    def __repr__(self) -> str:
        return f"<Verdict: {self}>"

    def _repr_html_(self) -> str:
        return html_table(repr(self), ("condition", "margin"), self.margins.items())

    @property
    def valid(self) -> bool:
        """Whether the plan meets its boundary conditions and every constraint, within the problem's tolerances."""
        return self.reason == Reason.OK

    @property
    def worst(self) -> Margin | None:
        """The margin of the largest severity, among those with the verdict's reason if the plan is not valid."""
        deciding = [
            margin for margin in self.margins.values() if margin.reason == self.reason
        ]
        return max(
            deciding or self.margins.values(),
            key=lambda margin: margin.severity,
            default=None,
        )

    def to_dict(self) -> JsonObject:
        """Return the verdict for JSON."""
        worst = self.worst
        return {
            "valid": self.valid,
            "reason": str(self.reason),
            "worst": worst and worst.to_dict(),
            "margins": {
                name: margin.to_dict() for name, margin in self.margins.items()
            },
            "metrics": self.metrics.to_dict(),
            "paper": self.paper and self.paper.to_dict(),
            "samples": self.samples,
        }


def summarize_verdicts(verdicts: Sequence[Verdict]) -> JsonObject:
    """Count verdicts and average their metrics.

    Returns:
        For JSON: ``plans``; ``valid``, and, if the paper's rules were evaluated,
        ``paper_valid`` and ``finished``, with their ratios; ``reasons``, reason ->
        number of plans; ``metrics_of_valid``, ``metrics_of_paper_valid`` and
        ``metrics_of_all`` (those that could be evaluated), metric -> mean, median, 95 %
        quantile and maximum; ``conditions``, condition -> number of plans that violate
        it and the worst margin, with its plan's index.
    """
    n_plans = len(verdicts)
    by_paper = [
        verdict for verdict in verdicts if verdict.paper and verdict.paper.valid
    ]
    counts = {"valid": sum(verdict.valid for verdict in verdicts)}
    rules = [verdict.paper for verdict in verdicts if verdict.paper is not None]
    # Counts and ratios by the paper's rules only if every plan was judged by them.
    if len(rules) == len(verdicts):
        counts["paper_valid"] = sum(rule.valid for rule in rules)
        counts["finished"] = sum(rule.finished for rule in rules)
    reasons = Counter(str(verdict.reason) for verdict in verdicts)
    return {
        "plans": n_plans,
        **counts,
        **{
            f"{name}_ratio": number / n_plans if n_plans else None
            for name, number in counts.items()
        },
        "reasons": dict(reasons.most_common()),
        "metrics_of_valid": _statistics(
            [verdict for verdict in verdicts if verdict.valid]
        ),
        "metrics_of_paper_valid": _statistics(by_paper),
        "metrics_of_all": _statistics(
            [verdict for verdict in verdicts if verdict.margins]
        ),
        "conditions": _conditions(verdicts),
    }


def _statistics(verdicts: Sequence[Verdict]) -> dict[str, dict[str, float]]:
    values_of: dict[str, list[float]] = {}
    for verdict in verdicts:
        for name, value in verdict.metrics.to_dict().items():
            values_of.setdefault(name, []).append(value)
    return {
        name: {
            "mean": float(np.mean(values)),
            "median": float(np.median(values)),
            "p95": float(np.quantile(values, 0.95)),
            "max": float(np.max(values)),
        }
        for name, values in values_of.items()
    }


def _conditions(verdicts: Sequence[Verdict]) -> dict[str, JsonObject]:
    margins_of: dict[str, list[tuple[int, Margin]]] = {}
    for index, verdict in enumerate(verdicts):
        for name, margin in verdict.margins.items():
            margins_of.setdefault(name, []).append((index, margin))
    conditions = {}
    for name, margins in margins_of.items():
        worst, margin = max(margins, key=lambda entry: entry[1].severity)
        violating = sum(not margin.ok for _, margin in margins)
        conditions[name] = {
            "violating_plans": violating,
            "worst_plan": worst,
            **margin.to_dict(),
        }
    return conditions
