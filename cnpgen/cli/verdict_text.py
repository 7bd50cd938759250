"""Output of ``cnpgen evaluate``: counts, reasons, statistics, margins, checksums.

And the plans one by one.
"""

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli.terminal import table
from cnpgen.documents import JsonMapping, JsonObject, TextRows
from cnpgen.errors import counted

if TYPE_CHECKING:
    from cnpgen.judges.plans import Verdict
    from cnpgen.plans import Plans
    from cnpgen.plans.evaluate import Evaluation

METRICS = {  # metric -> what it is called, in a summary and in a list, and its format
    "duration_s": ("motion time [s]", "T [s]", "{:.4f}"),
    "z_error_mm_s": ("z error [mm s]", "z [mm s]", "{:.3f}"),
    "vertical_error_rad_s": ("vertical error [rad s]", "tilt [rad s]", "{:.4f}"),
    "hit_speed_m_s": ("speed at the goal [m/s]", "v [m/s]", "{:.2f}"),
    "effort_s": ("effort [s]", "effort [s]", "{:.3f}"),
    "jerk": ("largest jerk [x limit]", "jerk", "{:.2f}"),
}
# Of any unit: control points that are garbage make metrics of hundreds of digits.
LONG = 1e6
_TALLIES = {
    "valid": "valid",
    "paper_valid": "valid by the paper's rules",
    "finished": "at the goal by the paper's rules",
}


def summary_text(file: Path, found: "Evaluation") -> str:
    """Format the summary of all plans."""
    from cnpgen.judges.plans.sampling import MAX_TIME_SAMPLES

    summary = found.summary()
    count = len(found.verdicts)
    step = f"{1e3 * found.step:g} ms"
    if (found.plans.duration > MAX_TIME_SAMPLES * found.step).any():
        step += f" or of {MAX_TIME_SAMPLES:,} in all"
    head = f"{file}: {counted(count, 'plan')} of {found.plans.problem.name}, judged at steps of {step} and between them"
    counts = {
        text: (summary[name], summary[f"{name}_ratio"])
        for name, text in _TALLIES.items()
        if name in summary
    }
    tallies = [
        (text, f"{number:,} of {count:,}", f"{share:.2%}", "")
        for text, (number, share) in counts.items()
    ]
    rows = table(tallies, indent="  ", right=(1, 2))
    limits = found.judged_limits.lines
    sections = [[head, checksum_text(found.plans), *limits, "", *rows]]
    tables = (
        (_reasons(found, summary), (1,)),
        (_figures(summary, _shown(found)), range(1, 7)),
        (_margins(summary), (1, 2, 3, 4, 6, 7)),
    )
    sections += [
        table(rows, indent="  ", right=tuple(right))
        for rows, right in tables
        if len(rows) > 1
    ]
    return "\n\n".join("\n".join(lines) for lines in sections)


def checksum_text(plans: "Plans") -> str:
    """Return whether the source of the plans has a checksum, as text."""
    return (
        "the file's checksum is right"
        if plans.has_checksum
        else "the file has no checksum"
    )


def _reasons(found: "Evaluation", summary: JsonObject) -> TextRows:
    """Say why plans are not valid, the most frequent reason first."""
    rows: TextRows = [("not valid because", "plans", "the worst of them")]
    for reason, number in summary["reasons"].items():
        plans = [
            (index, verdict)
            for index, verdict in enumerate(found.verdicts)
            if str(verdict.reason) == reason
        ]
        index, worst = max(
            plans,
            key=lambda plan: plan[1].worst.severity if plan[1].worst else -math.inf,
        )
        if not worst.valid:
            why = _why(worst)
            rows.append((reason, f"{number:,}", f"plan {index}{why and f': {why}'}"))
    return rows


def _figure(form: str, value: float) -> str:
    """Write a number in its column's form, and one that would not fit into any column in three digits."""
    return form.format(value) if abs(value) < LONG else f"{value:.3g}"


def _why(verdict: "Verdict") -> str:
    """Say what decided, as far as there is more to say than the reason."""
    from cnpgen.judges.plans.sampling import MAX_DURATION_S
    from cnpgen.judges.plans.verdict import Reason

    if verdict.reason == Reason.TOO_LONG:
        return f"{verdict.metrics.duration:.3g} s are more than {MAX_DURATION_S:,.0f} s"
    return str(verdict.worst or "")


def _shown(found: "Evaluation") -> list[str]:
    """Return the metrics that some plan has; that of the jerk only if the problem limits jerks."""
    constraints = found.plans.problem.content["constraint"]
    limits_jerk = any(item["use"] == "joint-jerk" for item in constraints)
    known = {name for item in found.verdicts for name in item.metrics.to_dict()}
    return [
        name for name in METRICS if name in known and (name != "jerk" or limits_jerk)
    ]


def _figures(summary: JsonObject, names: Sequence[str]) -> TextRows:
    """Lay out the metrics: of valid plans, of those valid by the paper's rules, and of all."""
    columns = [("metrics_of_valid", name) for name in ("mean", "median", "p95", "max")]
    columns += [("metrics_of_paper_valid", "mean"), ("metrics_of_all", "mean")]
    rows: TextRows = [
        (
            "",
            "valid: mean",
            "median",
            "95 %",
            "largest",
            "paper's: mean",
            "all: mean",
            "",
        )
    ]
    for name in names:
        text, _, form = METRICS[name]
        values = [summary[group].get(name, {}).get(what) for group, what in columns]
        cells = ["-" if value is None else _figure(form, value) for value in values]
        if any(value is not None for value in values):
            rows.append((text, *cells, ""))
    return rows


def _margins(summary: JsonObject) -> TextRows:
    """Format per condition the number of violating plans and the plan with the smallest margin."""
    rows = [margin_head("condition", "violated by", item="plan")]
    for name, worst in summary["conditions"].items():
        rows.append(
            (
                name,
                f"{worst['violating_plans']:,}",
                *margin_cells(worst, worst["worst_plan"]),
            )
        )
    return rows


def margin_head(*first: str, item: str) -> tuple[str, ...]:
    """Return the head of a table with ``margin_cells``."""
    return *first, "margin", "violation", "tolerance", "unit", item, "t [s]", "where"


def margin_cells(margin: JsonMapping, index: int) -> tuple[str, ...]:
    """Format a margin, or the violation in its place, with tolerance, unit, index, time and place as cells of a table."""
    violation = margin["violation"]
    # A violation of 0 or less is a margin.
    holds = violation is not None and violation <= 0
    at = "-" if margin["time"] is None else f"{margin['time']:.4f}"
    return (
        f"{abs(violation):.2e}" if holds else "-",
        "-" if violation is None or holds else f"{violation:.2e}",
        f"{margin['tolerance']:.1e}",
        margin["unit"],
        str(index),
        at,
        margin["part"],
    )


def listing_text(found: "Evaluation") -> str:
    """List the plans, those that are not valid first."""
    order = sorted(
        range(len(found.verdicts)), key=lambda index: found.verdicts[index].valid
    )
    metrics = {index: found.verdicts[index].metrics.to_dict() for index in order}
    shown = _shown(found)
    names = [METRICS[name][1] for name in shown]
    rows = [
        ("plan", "sample", "verdict", *names, "smallest margin, or largest violation")
    ]
    for index in order:
        values = [(METRICS[name][2], metrics[index].get(name)) for name in shown]
        figures = [
            "-" if value is None else _figure(form, value) for form, value in values
        ]
        verdict = found.verdicts[index]
        sample = int(found.plans.sample_id[index])
        why = _why(verdict) or "-"
        rows.append((str(index), str(sample), str(verdict.reason), *figures, why))
    right = [column for column in range(len(rows[0])) if column != 2]
    # One plan is one line, for grep and sort.
    return "\n".join(table(rows, right=right, width=sys.maxsize))
