"""Many verdicts in one: counts, the figures of the paper's tables, and a table for the terminal."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from cnpgen.verdict.verdict import Margin, Verdict

_COLUMNS = {  # of the table: metric -> heading and format
    "duration_s": ("T [s]", "{:.4f}"),
    "z_error_mm_s": ("z [mm s]", "{:.3f}"),
    "vertical_error_rad_s": ("tilt [rad s]", "{:.4f}"),
    "effort_s": ("effort [s]", "{:.3f}"),
    "jerk": ("jerk", "{:.2f}"),
    "hit_speed_m_s": ("tip [m/s]", "{:.2f}"),
}


def summarise(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Count verdicts and average their metrics.

    Returns:
        For JSON: ``plans``; ``valid``, ``paper_valid`` and ``finished`` with their ratios; ``reasons``, reason ->
        number of plans; ``metrics_of_valid`` and ``metrics_of_all`` (those that could be evaluated), metric -> mean,
        median, 95 % quantile and largest; ``conditions``, condition -> number of plans that break it and the worst
        margin, with its plan's index.
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


def format_table(verdicts: Sequence[Verdict], limit: int = 20) -> str:
    """Write verdicts as a table for the terminal, those that are not valid first, and a summary below it.

    Args:
        verdicts: The verdicts.
        limit: Largest number of plans that are listed.
    """
    order = sorted(range(len(verdicts)), key=lambda index: verdicts[index].valid)
    shown = sorted(order[:limit], key=lambda index: (verdicts[index].valid, index))
    metrics = {index: verdicts[index].metrics.to_dict() for index in shown}
    columns = [name for name in _COLUMNS if any(name in values for values in metrics.values())]
    heading = ["plan", "verdict", *(_COLUMNS[name][0] for name in columns), "nearest to a bound, or furthest beyond"]
    rows = [heading]
    for index in shown:
        cells = [_COLUMNS[name][1].format(metrics[index][name]) if name in metrics[index] else "-" for name in columns]
        rows.append([str(index), str(verdicts[index].reason), *cells, str(verdicts[index].worst or "-")])
    lines = _aligned(rows) if shown else []
    if len(verdicts) > len(shown):
        lines.append(f"... and {len(verdicts) - len(shown)} more")
    return "\n".join([*lines, *_summary_lines(summarise(verdicts))])


def _aligned(rows: list[list[str]]) -> list[str]:
    """Pad cells: numbers to the right, the verdict and the last column to the left."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    texts = {1, len(widths) - 1}
    padded = [
        [
            cell.ljust(width) if i in texts else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        for row in rows
    ]
    return ["  ".join(row).rstrip() for row in padded]


def _summary_lines(summary: dict[str, Any]) -> list[str]:
    count = summary["plans"]
    if not count:
        return ["no plans"]
    shares = {
        "valid": "valid",
        "paper_valid": "valid by the paper's rules",
        "finished": "at the goal",
    }
    told = ", ".join(f"{summary[name]} {text} ({summary[f'{name}_ratio']:.1%})" for name, text in shares.items())
    lines = ["", f"{count} plans: {told}"]
    lines += [f"  {number} {reason}" for reason, number in summary["reasons"].items() if reason != "ok"]
    metrics = summary["metrics_of_valid"]
    lines += [
        f"  {heading}: mean {form.format(metrics[name]['mean'])}, median {form.format(metrics[name]['median'])}"
        for name, (heading, form) in _COLUMNS.items()
        if name in metrics
    ]
    return lines
