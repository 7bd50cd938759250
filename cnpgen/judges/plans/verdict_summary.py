"""Summary of many verdicts: counts, and the statistics of the paper's tables."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from cnpgen.judges.plans.verdict import Margin, Verdict


def summarize_verdicts(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Count verdicts and average their metrics.

    Returns:
        For JSON: ``plans``; ``valid``, ``paper_valid`` and ``finished`` with their ratios; ``reasons``, reason ->
        number of plans; ``metrics_of_valid``, ``metrics_of_paper_valid`` and ``metrics_of_all`` (those that could be
        evaluated), metric -> mean, median, 95 % quantile and maximum; ``conditions``, condition -> number of plans that
        violate it and the worst margin, with its plan's index.
    """
    n_plans = len(verdicts)
    counts = {
        "valid": sum(verdict.valid for verdict in verdicts),
        "paper_valid": sum(verdict.paper.valid for verdict in verdicts),
        "finished": sum(verdict.paper.finished for verdict in verdicts),
    }
    reasons = Counter(str(verdict.reason) for verdict in verdicts)
    return {
        "plans": n_plans,
        **counts,
        **{f"{name}_ratio": number / n_plans if n_plans else None for name, number in counts.items()},
        "reasons": dict(reasons.most_common()),
        "metrics_of_valid": _statistics([verdict for verdict in verdicts if verdict.valid]),
        "metrics_of_paper_valid": _statistics([verdict for verdict in verdicts if verdict.paper.valid]),
        "metrics_of_all": _statistics([verdict for verdict in verdicts if verdict.margins]),
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


def _conditions(verdicts: Sequence[Verdict]) -> dict[str, dict[str, Any]]:
    margins_of: dict[str, list[tuple[int, Margin]]] = {}
    for index, verdict in enumerate(verdicts):
        for name, margin in verdict.margins.items():
            margins_of.setdefault(name, []).append((index, margin))
    conditions = {}
    for name, margins in margins_of.items():
        worst, margin = max(margins, key=lambda entry: entry[1].severity)
        violating = sum(not margin.ok for _, margin in margins)
        conditions[name] = {"violating_plans": violating, "worst_plan": worst, **margin.to_dict()}
    return conditions
