"""Many verdicts in one: counts, and the figures of the paper's tables."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from cnpgen.judges.plans.verdict import Margin, Verdict


def summarise(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Count verdicts and average their metrics.

    Returns:
        For JSON: ``plans``; ``valid``, ``paper_valid`` and ``finished`` with their ratios; ``reasons``, reason ->
        number of plans; ``metrics_of_valid``, ``metrics_of_paper_valid`` and ``metrics_of_all`` (those that could be
        evaluated), metric -> mean, median, 95 % quantile and largest; ``conditions``, condition -> number of plans that
        break it and the worst margin, with its plan's index.
    """
    count = len(verdicts)
    tallies = {
        "valid": sum(verdict.valid for verdict in verdicts),
        "paper_valid": sum(verdict.paper.valid for verdict in verdicts),
        "finished": sum(verdict.paper.finished for verdict in verdicts),
    }
    reasons = Counter(str(verdict.reason) for verdict in verdicts)
    return {
        "plans": count,
        **tallies,
        **{f"{name}_ratio": number / count if count else None for name, number in tallies.items()},
        "reasons": dict(reasons.most_common()),
        "metrics_of_valid": _statistics([verdict for verdict in verdicts if verdict.valid]),
        "metrics_of_paper_valid": _statistics([verdict for verdict in verdicts if verdict.paper.valid]),
        "metrics_of_all": _statistics([verdict for verdict in verdicts if verdict.margins]),
        "conditions": _conditions(verdicts),
    }


def _statistics(verdicts: Sequence[Verdict]) -> dict[str, dict[str, float]]:
    found: dict[str, list[float]] = {}
    for verdict in verdicts:
        for name, value in verdict.metrics.to_dict().items():
            found.setdefault(name, []).append(value)
    return {
        name: {
            "mean": float(np.mean(values)),
            "median": float(np.median(values)),
            "p95": float(np.quantile(values, 0.95)),
            "max": float(np.max(values)),
        }
        for name, values in found.items()
    }


def _conditions(verdicts: Sequence[Verdict]) -> dict[str, dict[str, Any]]:
    found: dict[str, list[tuple[int, Margin]]] = {}
    for index, verdict in enumerate(verdicts):
        for name, margin in verdict.margins.items():
            found.setdefault(name, []).append((index, margin))
    conditions = {}
    for name, margins in found.items():
        worst, margin = max(margins, key=lambda entry: entry[1].severity)
        out = sum(not margin.ok for _, margin in margins)
        conditions[name] = {"plans_out": out, "worst_plan": worst, **margin.to_dict()}
    return conditions
