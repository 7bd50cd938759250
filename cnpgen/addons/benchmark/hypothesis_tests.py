"""Statistics of benchmark results: ratios with intervals, medians, tails, and significance of differences.

A planner is compared with the reference planner over common problems. Repetitions of a
problem are not independent, so tests compare one mean per problem, and intervals count
problems.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.simulator.executed import PLANE_TOLERANCE_M, succeeded
from cnpgen.arrays import Array
from cnpgen.documents import JsonMapping, JsonObject

FLAGS = {  # of a row; those from "at the goal, executed" on need an execution
    "planned": "a plan was found",
    "valid": "valid by the verdict",
    "paper_valid": "planned motion valid by the paper's rules",
    "paper_finished": "planned to 1 cm from the goal",
    "finished": "at the goal, executed",
    "hit": "hit the puck",
    "scored": "scored",
    "touched_early": "touched the puck early",
    "collided": "collided",
    "violated": "violated a constraint of the environment",
    "success": "success",
}
FIGURES = {
    "planning_ms": "planning time [ms]",
    "planning_cpu_ms": "planning time, CPU [ms]",
    "duration_s": "motion time [s]",
    "hit_time_s": "time to hit [s]",
    "puck_speed_m_s": "puck speed [m/s]",
    "goal_distance_mm": "distance from the goal, executed [mm]",
    "planned_z_error_mm_s": "z error, planned [mm s]",
    "z_error_mm_s": "z error, executed [mm s]",
    "plane_error_mm": "largest height error, executed [mm]",
    "commanded_plane_error_mm": "largest height error, commanded [mm]",
    "table_force_n": "largest normal force on the table [N]",
    "table_friction_n": "largest friction on the table [N]",
    "planned_vertical_error_rad_s": "vertical error, planned [rad s]",
    "vertical_error_rad_s": "vertical error, executed [rad s]",
    "tracking_error_rad_s": "tracking error [rad s]",
    "acceleration_use": "maximum acceleration / limit",
    "torque_use": "maximum torque / rated, executed",
    "penalty_points": "penalty points of the environment",
}
METRICS_OF_FIGURES = {  # figure of the plan -> metric of its verdict
    "duration_s": "duration_s",
    "planned_z_error_mm_s": "z_error_mm_s",
    "planned_vertical_error_rad_s": "vertical_error_rad_s",
}
TAILS = {"p99": 0.99, "p999": 0.999, "max": 1.0}
REFERENCE_PLANNER = "cnpgen+refine"  # default reference of the comparison, if present
NORMAL_QUANTILE_95 = 1.959963984540054  # two-sided
NOT_APPLICABLE, CRASHED = "not applicable", "crashed"  # endings of rows

Values = dict[str, bool | float]
"""Flags and figures of one problem, by the names of ``FLAGS`` and ``FIGURES``."""


def values_of(
    row: JsonMapping, plant: str = "", plane_tolerance: float = PLANE_TOLERANCE_M
) -> Values:
    """Return the known flags and figures of a row; empty if the planner or the plant does not apply.

    The plant is empty for plans only; ``succeeded`` defines the tolerance.
    """
    has_answer = row["answer"] is not None
    executed = row.get("executed", {}).get(plant)
    if row.get("ending") == NOT_APPLICABLE or (
        plant and has_answer and executed is None
    ):
        return {}
    values: Values = {"planned": has_answer}
    if row.get("ending") != CRASHED:
        # The CPU time of a crashed process is unknown.
        values |= {
            "planning_ms": 1e3 * row["planning_s"],
            "planning_cpu_ms": 1e3 * row["planning_cpu_s"],
        }
    if plant:
        executed = executed or {}
        values |= {
            name: value
            for name, value in executed.items()
            if name in FLAGS or name in FIGURES
        }
        if "penalty_points" in executed:
            values["violated"] = executed["penalty_points"] > 0
        values["success"] = bool(executed) and succeeded(executed, plane_tolerance)
    return {**values, **_values_of_verdict(row.get("verdict"))}


def _values_of_verdict(verdict: JsonMapping | None) -> Values:
    """Return the flags and figures of a plan; without a plan, it is not valid."""
    if verdict is None:
        return {"valid": False, "paper_valid": False, "paper_finished": False}
    metrics = verdict["metrics"]
    paper = verdict["paper"]
    values: Values = {
        "valid": verdict["valid"],
        "paper_valid": paper["valid"],
        "paper_finished": paper["finished"],
    }
    values |= {
        name: metrics[key] for name, key in METRICS_OF_FIGURES.items() if key in metrics
    }
    if "joint acceleration" in verdict["value_over_bound"]:
        values["acceleration_use"] = verdict["value_over_bound"]["joint acceleration"]
    return values


def summarize_results(
    results: Mapping[str, Sequence[JsonMapping]],
    plant: str = "",
    *,
    reference: str | None = None,
    plane_tolerance: float = PLANE_TOLERANCE_M,
) -> dict[str, dict[str, dict[str, JsonObject]]]:
    """Summarize the rows of all planners on a plant, or of their plans only if it is empty.

    Returns:
        Planner -> ``{"ratios": ..., "figures": ...}``, both empty if the planner does
        not apply. A ratio has ``count``, ``of``, ``share`` and its 95 % interval by
        Wilson, ``low`` and ``high``. A figure has ``median``, ``q1``, ``q3``, the tails
        ``p99``, ``p999`` and ``max``, and ``of``, its number of values. A tail is the
        next larger value, so p99 of fewer than 100 values is the maximum. Both have
        ``p``, the p-value of the difference from the reference planner, and ``p_holm``,
        corrected by Holm for all comparisons of this table.
    """
    values = {
        name: {
            (row.get("problem", index), row.get("repetition", 0)): known
            for index, row in enumerate(rows)
            if (known := values_of(row, plant, plane_tolerance))
        }
        for name, rows in results.items()
    }
    other = values.get(reference_planner(values, reference), {})
    keys = {key for rows in values.values() for known in rows.values() for key in known}
    summary = {
        name: {
            "ratios": {
                key: _ratio(key, rows, other) for key in FLAGS if key in keys and rows
            },
            "figures": {
                key: _figure(key, rows, other)
                for key in FIGURES
                if any(key in known for known in rows.values())
            },
        }
        for name, rows in values.items()
    }
    _correct(summary)
    return summary


def reference_planner(planners: Iterable[str], reference: str | None = None) -> str:
    """Return the reference planner: the given one, else ``REFERENCE_PLANNER`` if present, else the first one."""
    names = list(planners)
    if reference is not None:
        return reference
    return REFERENCE_PLANNER if REFERENCE_PLANNER in names else next(iter(names), "")


Keyed = Mapping[tuple[int, int], Values]
"""(problem, repetition) -> values."""


def _ratio(key: str, rows: Keyed, others: Keyed) -> JsonObject:
    count = sum(bool(known.get(key, False)) for known in rows.values())
    of = len(rows)
    mine, theirs = (
        _means({at: {key: known.get(key, False)} for at, known in part.items()}, key)
        for part in (rows, others)
    )
    # Repetitions are not independent, so the interval counts problems.
    low, high = wilson(count / max(of, 1), len(mine))
    pairs = _pairs(mine, theirs)
    # Means of repetitions may be fractions, which McNemar's test does not take.
    is_binary = not np.any(pairs % 1)
    p = mcnemar(*(pairs.T > 0)) if is_binary else wilcoxon(pairs)
    return {
        "count": count,
        "of": of,
        "share": count / max(of, 1),
        "low": low,
        "high": high,
        "p": p,
    }


def _figure(key: str, rows: Keyed, others: Keyed) -> JsonObject:
    values = np.array([known[key] for known in rows.values() if key in known], float)
    q1, median, q3 = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
    tails = np.quantile(values, list(TAILS.values()), method="higher").tolist()
    pairs = _pairs(_means(rows, key), _means(others, key))
    p = wilcoxon(pairs)
    return {
        "median": median,
        "q1": q1,
        "q3": q3,
        **dict(zip(TAILS, tails, strict=True)),
        "of": len(values),
        "p": p,
    }


def _means(rows: Keyed, key: str) -> dict[int, float]:
    """Return the mean of a value over the repetitions of each problem that has it."""
    known = defaultdict(list)
    for (problem, _), values in rows.items():
        if key in values:
            known[problem].append(float(values[key]))
    return {problem: float(np.mean(numbers)) for problem, numbers in known.items()}


def _pairs(mine: Mapping[int, float], theirs: Mapping[int, float]) -> Array:
    """Return the values of common problems, shape (N, 2)."""
    return np.array(
        [(mine[at], theirs[at]) for at in mine if at in theirs], float
    ).reshape(-1, 2)


def _correct(summary: dict[str, dict[str, dict[str, JsonObject]]]) -> None:
    """Add the corrected p-values of a table."""
    statistics = [
        item
        for groups in summary.values()
        for group in groups.values()
        for item in group.values()
    ]
    for item, p in zip(
        statistics, holm([item["p"] for item in statistics]), strict=True
    ):
        item["p_holm"] = p


def wilson(share: float, n: int) -> tuple[float, float]:
    """Return the 95 % interval of an observed ratio of n independent problems by Wilson (1927)."""
    if n == 0:
        return 0.0, 1.0
    z2 = NORMAL_QUANTILE_95**2
    # With d = 1 + z^2 / n, the center is (p + z^2 / 2n) / d, and the half width
    # z sqrt(p (1 - p) / n + z^2 / 4n^2) / d.
    center = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = (
        NORMAL_QUANTILE_95
        * np.sqrt(share * (1 - share) / n + z2 / (4 * n**2))
        / (1 + z2 / n)
    )
    return float(center - half) if share > 0 else 0.0, float(
        center + half
    ) if share < 1 else 1.0


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number by Holm (1979), in their order."""
    order = np.argsort(p_values, kind="stable")
    factors = np.arange(len(order), 0, -1)
    corrected = np.empty(len(order))
    # The k-th smallest of m p-values times m - k + 1, and at least the one before.
    corrected[order] = np.minimum(
        np.maximum.accumulate(factors * np.asarray(p_values, float)[order]), 1.0
    )
    return [float(p) for p in corrected]


def mcnemar(mine: Any, theirs: Any) -> float:
    """Return the p-value of McNemar's exact test of two masks of solved problems, shape (N,) each."""
    from scipy.stats import binomtest

    only_mine = int(np.sum(mine & ~theirs))
    only_theirs = int(np.sum(theirs & ~mine))
    # Problems that both or none solve say nothing about a difference.
    both = only_mine + only_theirs
    return float(binomtest(only_mine, both).pvalue) if both else 1.0


def wilcoxon(pairs: Any) -> float:
    """Return the p-value of Wilcoxon's signed-rank test of pairs of figures, shape (N, 2)."""
    from scipy.stats import wilcoxon as signed_ranks

    # Without a difference, the test is undefined.
    if len(pairs) == 0 or not np.any(pairs[:, 0] != pairs[:, 1]):
        return 1.0
    return float(
        signed_ranks(
            pairs[:, 0], pairs[:, 1], zero_method="wilcox", correction=False
        ).pvalue
    )
