"""What the results of a benchmark amount to: ratios, medians, quartiles, and whether differences are chance."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

FLAGS = {  # of a row; those of the plant are as executed
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
    "acceleration_use": "largest acceleration / limit",
    "torque_use": "largest torque / rated, executed",
}
REFERENCE = "cnp-b+refine"  # what others are compared with, if it is there


def values_of(row: Mapping[str, Any], plant: str = "") -> dict[str, bool | float]:
    """Return what is counted and measured of one problem: names of ``FLAGS`` and ``FIGURES``, without what is unknown.

    Args:
        row: A row of results.
        plant: The plant whose execution counts; none by default.
    """
    found: dict[str, bool | float] = {"planned": row["answer"] is not None}
    found |= {"planning_ms": 1e3 * row["planning_s"], "planning_cpu_ms": 1e3 * row["planning_cpu_s"]}
    if plant:
        executed = row.get("executed", {}).get(plant, {"success": False})
        found |= {name: value for name, value in executed.items() if name in FLAGS or name in FIGURES}
    verdict = row.get("verdict")
    if verdict is None:
        return {**found, "valid": False, "paper_valid": False, "paper_finished": False}
    metrics = verdict["metrics"]
    found |= {"valid": verdict["valid"], "paper_valid": verdict["paper"]["valid"]}
    found |= {"paper_finished": verdict["paper"]["finished"]}
    named = {"duration_s": "duration_s", "planned_z_error_mm_s": "z_error_mm_s"}
    named["planned_vertical_error_rad_s"] = "vertical_error_rad_s"
    found |= {name: metrics[key] for name, key in named.items() if key in metrics}
    if "joint acceleration" in verdict["value_over_bound"]:
        found["acceleration_use"] = verdict["value_over_bound"]["joint acceleration"]
    return found


def summarise_results(
    results: Mapping[str, Sequence[Mapping[str, Any]]], plant: str = ""
) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """Summarise the results of all planners.

    Args:
        results: Planner -> rows, of the same problems in the same order.
        plant: The plant whose executions count; none by default.

    Returns:
        Planner -> ``{"ratios": ..., "figures": ...}``. A ratio has ``count``, ``of`` and ``share``; a figure has
        ``median``, ``q1``, ``q3`` and ``of``, of how many problems it is known. Both have ``p``, the probability of
        as large a difference from the planner ``compared_with`` by chance: by McNemar's exact test, and by Wilcoxon's
        signed ranks over the problems that both have a figure of.
    """
    values = {name: [values_of(row, plant) for row in rows] for name, rows in results.items()}
    reference = compared_with(values)
    known = {key for rows in values.values() for row in rows for key in row}
    return {
        name: {
            "ratios": {key: _ratio(key, rows, values[reference]) for key in FLAGS if key in known},
            "figures": {
                key: _figure(key, rows, values[reference])
                for key in FIGURES
                if any(key in row for row in rows)
            },
        }
        for name, rows in values.items()
    }  # fmt: skip


def compared_with(planners: Iterable[str]) -> str:
    """Return the planner that others are compared with: the first one, unless the reference is among them."""
    names = list(planners)
    return REFERENCE if REFERENCE in names else next(iter(names), "")


def _ratio(key: str, rows: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    mine, theirs = (np.array([bool(row.get(key, False)) for row in each]) for each in (rows, others))
    count, of = int(mine.sum()), len(mine)
    return {"count": count, "of": of, "share": count / max(of, 1), "p": mcnemar(mine, theirs)}


def _figure(key: str, rows: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    found = np.array([row[key] for row in rows if key in row], float)
    q1, median, q3 = np.quantile(found, [0.25, 0.5, 0.75]).tolist()
    pairs = [(row[key], other[key]) for row, other in zip(rows, others, strict=True) if key in row and key in other]
    return {
        "median": median,
        "q1": q1,
        "q3": q3,
        "of": len(found),
        "p": wilcoxon(np.array(pairs, float).reshape(-1, 2)),
    }


def mcnemar(mine: Any, theirs: Any) -> float:
    """McNemar's exact test: how likely so uneven a split of the problems that only one of two did is by chance.

    Args:
        mine: Whether one planner did each problem, shape (N,).
        theirs: Whether the other one did.
    """
    from scipy.stats import binomtest

    only_mine, only_theirs = int(np.sum(mine & ~theirs)), int(np.sum(theirs & ~mine))
    both = only_mine + only_theirs
    return float(binomtest(only_mine, both).pvalue) if both else 1.0


def wilcoxon(pairs: Any) -> float:
    """Wilcoxon's signed-rank test of pairs of figures, shape (N, 2): how likely such differences are by chance."""
    from scipy.stats import wilcoxon as signed_ranks

    if len(pairs) == 0 or not np.any(pairs[:, 0] != pairs[:, 1]):
        return 1.0
    return float(signed_ranks(pairs[:, 0], pairs[:, 1], zero_method="wilcox", correction=False).pvalue)
