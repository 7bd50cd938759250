"""Ratios, quartiles and p-values, compared with enumeration."""

from itertools import product
from math import comb

import numpy as np
import pytest

from cnpgen.benchmark.hypothesis_tests import mcnemar, summarize_results, values_of, wilcoxon


def row(planned: bool = True, valid: bool = True, seconds: float = 0.1, scored: bool = True) -> dict:
    verdict = {
        "valid": valid,
        "paper": {"valid": valid, "finished": True},
        "metrics": {"duration_s": 4 * seconds, "z_error_mm_s": 0.2},
        "value_over_bound": {"joint acceleration": 1.5},
    }
    executed = {"nominal": {"scored": scored, "success": scored, "z_error_mm_s": 0.3}}
    result = {"answer": {} if planned else None, "planning_s": seconds, "planning_cpu_s": seconds}
    return {**result, "verdict": verdict, "executed": executed} if planned else result


def test_a_row_without_a_plan_counts_as_a_failure() -> None:
    values = values_of(row(planned=False), "nominal")
    assert values["planned"] is values["valid"] is values["success"] is False
    assert "duration_s" not in values


def test_planned_and_executed_errors_are_distinguished() -> None:
    values = values_of(row(), "nominal")
    assert (values["planned_z_error_mm_s"], values["z_error_mm_s"]) == (0.2, 0.3)
    assert "z_error_mm_s" not in values_of(row())


def test_a_summary_has_counts_and_quartiles() -> None:
    rows = [row(seconds=seconds, scored=seconds < 0.4) for seconds in (0.1, 0.2, 0.3, 0.4, 0.5)]
    summary = summarize_results({"a": rows, "b": [row(planned=False)] * 5}, "nominal")
    assert summary["a"]["ratios"]["scored"]["count"] == 3
    assert summary["a"]["figures"]["planning_ms"]["median"] == pytest.approx(300)
    assert summary["a"]["figures"]["planning_ms"]["q1"] == pytest.approx(200)
    assert summary["b"]["ratios"]["scored"] == {"count": 0, "of": 5, "share": 0.0, "p": 0.25}
    assert "duration_s" not in summary["b"]["figures"]


@pytest.mark.parametrize(("only_one", "only_other"), [(0, 5), (1, 9), (3, 3), (0, 0)])
def test_mcnemar_is_the_exact_binomial_test_of_discordant_problems(only_one: int, only_other: int) -> None:
    mine = np.array([True] * only_one + [False] * only_other + [True] * 4)
    theirs = np.array([False] * only_one + [True] * only_other + [True] * 4)
    n, smaller = only_one + only_other, min(only_one, only_other)
    expected = min(1.0, 2 * sum(comb(n, k) for k in range(smaller + 1)) / 2**n)
    assert mcnemar(mine, theirs) == pytest.approx(expected)


def test_wilcoxon_equals_the_enumeration_of_signs() -> None:
    differences = np.array([1.0, -2.0, 3.0, 4.0, 5.5, 7.0])
    ranks = np.argsort(np.argsort(np.abs(differences))) + 1
    observed = ranks[differences > 0].sum()
    sums = [sum(r for r, s in zip(ranks, signs, strict=True) if s) for signs in product((False, True), repeat=6)]
    high = sum(rank_sum >= observed for rank_sum in sums)
    assert wilcoxon(np.stack([differences, np.zeros(6)], axis=1)) == pytest.approx(2 * high / 64)


def test_equal_figures_have_p_value_one() -> None:
    assert wilcoxon(np.ones((5, 2))) == 1.0
    assert wilcoxon(np.empty((0, 2))) == 1.0
