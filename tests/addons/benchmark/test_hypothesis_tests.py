"""Ratios, quartiles and p-values, compared with enumeration."""

from itertools import product
from math import comb

import numpy as np
import pytest
import scipy

from cnpgen.addons.benchmark.hypothesis_tests import (
    holm,
    mcnemar,
    summarize_results,
    values_of,
    wilcoxon,
    wilson,
)


def row(
    planned: bool = True, valid: bool = True, seconds: float = 0.1, scored: bool = True
) -> dict:
    verdict = {
        "valid": valid,
        "paper": {"valid": valid, "finished": True},
        "metrics": {"duration_s": 4 * seconds, "z_error_mm_s": 0.2},
        "value_over_bound": {"joint acceleration": 1.5},
    }
    executed = {
        "nominal": {
            "scored": scored,
            "touched_early": False,
            "z_error_mm_s": 0.3,
            "plane_error_mm": 5.0,
            "commanded_plane_error_mm": 15.0,
        }
    }
    result = {
        "answer": {} if planned else None,
        "planning_s": seconds,
        "planning_cpu_s": seconds,
    }
    return {**result, "verdict": verdict, "executed": executed} if planned else result


def test_a_row_without_a_plan_counts_as_a_failure() -> None:
    values = values_of(row(planned=False), "nominal")
    assert values["planned"] is values["valid"] is values["success"] is False
    assert "duration_s" not in values


def test_a_crash_has_no_planning_time_and_a_stop_has_one() -> None:
    failed = row(planned=False)
    assert "planning_cpu_ms" in values_of({**failed, "ending": "out of time"})
    crashed = values_of({**failed, "ending": "crashed"})
    assert crashed["planned"] is False
    assert not {"planning_ms", "planning_cpu_ms"} & set(crashed)


def test_planned_and_executed_errors_are_distinguished() -> None:
    values = values_of(row(), "nominal")
    assert (values["planned_z_error_mm_s"], values["z_error_mm_s"]) == (0.2, 0.3)
    assert "z_error_mm_s" not in values_of(row())


def test_penalty_points_count_as_violated_constraints() -> None:
    rows = [row(), row()]
    for known, points in zip(rows, (0.0, 3.0), strict=True):
        known["executed"]["challenge"] = {
            **known["executed"]["nominal"],
            "penalty_points": points,
        }
    assert [values_of(known, "challenge")["violated"] for known in rows] == [
        False,
        True,
    ]
    assert "violated" not in values_of(rows[0], "nominal")
    assert (
        summarize_results({"a": rows}, "challenge")["a"]["ratios"]["violated"]["count"]
        == 1
    )


def test_a_summary_has_counts_and_quartiles() -> None:
    rows = [
        row(seconds=seconds, scored=seconds < 0.4)
        for seconds in (0.1, 0.2, 0.3, 0.4, 0.5)
    ]
    summary = summarize_results({"a": rows, "b": [row(planned=False)] * 5}, "nominal")
    assert summary["a"]["ratios"]["scored"]["count"] == 3
    assert summary["a"]["figures"]["planning_ms"]["median"] == pytest.approx(300)
    assert summary["a"]["figures"]["planning_ms"]["q1"] == pytest.approx(200)
    scored = summary["b"]["ratios"]["scored"]
    assert {key: scored[key] for key in ("count", "of", "share", "p")} == {
        "count": 0,
        "of": 5,
        "share": 0.0,
        "p": 0.25,
    }
    assert "duration_s" not in summary["b"]["figures"]


@pytest.mark.parametrize(("only_one", "only_other"), [(0, 5), (1, 9), (3, 3), (0, 0)])
def test_mcnemar_is_the_exact_binomial_test_of_discordant_problems(
    only_one: int, only_other: int
) -> None:
    mine = np.array([True] * only_one + [False] * only_other + [True] * 4)
    theirs = np.array([False] * only_one + [True] * only_other + [True] * 4)
    n, smaller = only_one + only_other, min(only_one, only_other)
    expected = min(1.0, 2 * sum(comb(n, k) for k in range(smaller + 1)) / 2**n)
    assert mcnemar(mine, theirs) == pytest.approx(expected)


def test_wilcoxon_equals_the_enumeration_of_signs() -> None:
    differences = np.array([1.0, -2.0, 3.0, 4.0, 5.5, 7.0])
    ranks = np.argsort(np.argsort(np.abs(differences))) + 1
    observed = ranks[differences > 0].sum()
    sums = [
        sum(r for r, s in zip(ranks, signs, strict=True) if s)
        for signs in product((False, True), repeat=6)
    ]
    high = sum(rank_sum >= observed for rank_sum in sums)
    assert wilcoxon(np.stack([differences, np.zeros(6)], axis=1)) == pytest.approx(
        2 * high / 64
    )


def test_equal_figures_have_p_value_one() -> None:
    assert wilcoxon(np.ones((5, 2))) == 1.0
    assert wilcoxon(np.empty((0, 2))) == 1.0


def test_the_plane_tolerance_decides_success() -> None:
    assert values_of(row(), "nominal")["success"]
    assert not values_of(row(), "nominal", 0.014)["success"]
    assert values_of(row(), "nominal", 0.015)["success"]


def test_rows_that_do_not_apply_are_not_counted() -> None:
    unsuitable = [{**row(planned=False), "ending": "not applicable"}] * 3
    summary = summarize_results({"a": [row()] * 3, "b": unsuitable}, "nominal")
    assert summary["b"] == {"ratios": {}, "figures": {}}
    assert summary["a"]["ratios"]["scored"]["of"] == 3
    assert values_of(row(), "heavier") == {}  # not executed there
    assert values_of(row(planned=False), "heavier")["success"] is False


@pytest.mark.parametrize(
    ("count", "n"), [(0, 81), (41, 81), (80, 81), (81, 81), (1, 1)]
)
def test_the_interval_of_a_ratio_equals_that_of_scipy(count: int, n: int) -> None:
    expected = scipy.stats.binomtest(count, n).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(
        wilson(count / n, n), (expected.low, expected.high), atol=1e-12
    )


def test_p_values_are_corrected_by_the_definition_of_holm() -> None:
    p_values = [0.01, 0.04, 0.03, 0.005, 0.9]
    ranked, expected, largest = sorted(p_values), {}, 0.0
    for index, p in enumerate(ranked):
        largest = max(largest, min(1.0, (len(ranked) - index) * p))
        expected[p] = largest
    assert holm(p_values) == pytest.approx([expected[p] for p in p_values])
    assert holm([]) == []


def test_tails_are_the_next_larger_values() -> None:
    rows = [
        {**row(seconds=seconds / 1000), "problem": seconds}
        for seconds in range(1, 1001)
    ]
    figure = summarize_results({"a": rows})["a"]["figures"]["planning_ms"]
    assert (figure["p99"], figure["p999"], figure["max"]) == pytest.approx(
        (991, 1000, 1000)
    )
    few = summarize_results({"a": rows[:50]})["a"]["figures"]["planning_ms"]
    assert few["p99"] == few["p999"] == few["max"] == pytest.approx(50)


def test_repetitions_are_compared_as_means_of_their_problems() -> None:
    def repeated(shift: float) -> list[dict]:
        return [
            {**row(seconds=0.1 * (problem + 1) + shift + 0.001 * number), "problem": problem, "repetition": number}
            for number in range(4) for problem in range(6)
        ]  # fmt: skip

    figures = summarize_results(
        {"a": repeated(0.0), "b": repeated(0.01)}, reference="a"
    )["b"]["figures"]["planning_ms"]
    assert figures["of"] == 24
    assert figures["p"] == pytest.approx(2 / 64)  # six problems, not 24 values
    ratio = summarize_results({"a": repeated(0.0)})["a"]["ratios"]["valid"]
    assert (ratio["count"], ratio["of"]) == (24, 24)
    assert ratio["low"] == pytest.approx(wilson(1.0, 6)[0])
