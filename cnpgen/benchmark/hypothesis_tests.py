"""Statistics of benchmark results: ratios, medians, quartiles, and significance of differences."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

FLAGS = {  # of a row; those from "at the goal, executed" on need an execution
    "planned": "a plan was found",
    "valid": "valid by the verdict",
    "paper_valid": "valid by the paper's rules",
    "paper_finished": "planned to the goal, by the paper's rule",
    "finished": "at the goal, executed",
    "hit": "hit the puck",
    "scored": "scored",
    "touched_early": "touched the puck early",
    "collided": "collided",
    "success": "success",
}
FIGURES = {
    "planning_ms": "planning time [ms]",
    "planning_cpu_ms": "planning time, CPU [ms]",
    "duration_s": "motion time [s]",
    "hit_time_s": "time to hit [s]",
    "puck_speed_m_s": "puck speed [m/s]",
    "planned_z_error_mm_s": "z error, planned [mm s]",
    "z_error_mm_s": "z error, executed [mm s]",
    "planned_vertical_error_rad_s": "vertical error, planned [rad s]",
    "vertical_error_rad_s": "vertical error, executed [rad s]",
    "tracking_error_rad_s": "tracking error [rad s]",
    "acceleration_use": "maximum acceleration / limit",
    "torque_use": "maximum torque / rated, executed",
}
REFERENCE_PLANNER = "cnp-b+refine"  # reference of the comparison, if present


def values_of(row: Mapping[str, Any], plant: str = "") -> dict[str, bool | float]:
    """Return the known flags and figures of one problem, by the names of ``FLAGS`` and ``FIGURES``.

    Args:
        row: A row of results.
        plant: Name of the plant; empty for plans only.
    """
    values: dict[str, bool | float] = {"planned": row["answer"] is not None}
    values |= {"planning_ms": 1e3 * row["planning_s"], "planning_cpu_ms": 1e3 * row["planning_cpu_s"]}
    if plant:
        executed = row.get("executed", {}).get(plant, {"success": False})
        values |= {name: value for name, value in executed.items() if name in FLAGS or name in FIGURES}
    verdict = row.get("verdict")
    if verdict is None:
        return {**values, "valid": False, "paper_valid": False, "paper_finished": False}
    metrics = verdict["metrics"]
    values |= {"valid": verdict["valid"], "paper_valid": verdict["paper"]["valid"]}
    values |= {"paper_finished": verdict["paper"]["finished"]}
    named = {"duration_s": "duration_s", "planned_z_error_mm_s": "z_error_mm_s"}
    named["planned_vertical_error_rad_s"] = "vertical_error_rad_s"
    values |= {name: metrics[key] for name, key in named.items() if key in metrics}
    if "joint acceleration" in verdict["value_over_bound"]:
        values["acceleration_use"] = verdict["value_over_bound"]["joint acceleration"]
    return values


def summarize_results(
    results: Mapping[str, Sequence[Mapping[str, Any]]], plant: str = ""
) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """Summarize the results of all planners.

    Args:
        results: Planner -> rows of the same problems in the same order.
        plant: Name of the plant; empty for plans only.

    Returns:
        Planner -> ``{"ratios": ..., "figures": ...}``. A ratio has ``count``, ``of`` and ``share``. A figure has
        ``median``, ``q1``, ``q3`` and ``of``, its number of values. Both have ``p``, the p-value of the difference from
        the reference planner: McNemar's exact test for ratios, Wilcoxon's signed-rank test for figures.
    """
    values = {name: [values_of(row, plant) for row in rows] for name, rows in results.items()}
    reference = reference_planner(values)
    keys = {key for rows in values.values() for row in rows for key in row}
    return {
        name: {
            "ratios": {key: _ratio(key, rows, values[reference]) for key in FLAGS if key in keys},
            "figures": {
                key: _figure(key, rows, values[reference])
                for key in FIGURES
                if any(key in row for row in rows)
            },
        }
        for name, rows in values.items()
    }  # fmt: skip


def reference_planner(planners: Iterable[str]) -> str:
    """Return the reference planner: ``REFERENCE_PLANNER`` if present, otherwise the first one."""
    names = list(planners)
    return REFERENCE_PLANNER if REFERENCE_PLANNER in names else next(iter(names), "")


def _ratio(key: str, rows: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    mine, theirs = (np.array([bool(row.get(key, False)) for row in outcomes]) for outcomes in (rows, others))
    count, of = int(mine.sum()), len(mine)
    return {"count": count, "of": of, "share": count / max(of, 1), "p": mcnemar(mine, theirs)}


def _figure(key: str, rows: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    values = np.array([row[key] for row in rows if key in row], float)
    q1, median, q3 = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
    pairs = [(row[key], other[key]) for row, other in zip(rows, others, strict=True) if key in row and key in other]
    return {
        "median": median,
        "q1": q1,
        "q3": q3,
        "of": len(values),
        "p": wilcoxon(np.array(pairs, float).reshape(-1, 2)),
    }


def mcnemar(mine: Any, theirs: Any) -> float:
    """Return the p-value of McNemar's exact test.

    Args:
        mine: Whether one planner solved each problem, shape (N,).
        theirs: Whether the other planner solved it, shape (N,).
    """
    from scipy.stats import binomtest

    only_mine, only_theirs = int(np.sum(mine & ~theirs)), int(np.sum(theirs & ~mine))
    both = only_mine + only_theirs
    return float(binomtest(only_mine, both).pvalue) if both else 1.0


def wilcoxon(pairs: Any) -> float:
    """Return the p-value of Wilcoxon's signed-rank test of pairs of figures, shape (N, 2)."""
    from scipy.stats import wilcoxon as signed_ranks

    if len(pairs) == 0 or not np.any(pairs[:, 0] != pairs[:, 1]):
        return 1.0
    return float(signed_ranks(pairs[:, 0], pairs[:, 1], zero_method="wilcox", correction=False).pvalue)
