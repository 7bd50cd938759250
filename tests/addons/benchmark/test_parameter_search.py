"""Random search over the parameters of a planner."""

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cnpgen.addons.benchmark.parameter_search import (
    Trial,
    _rank,
    _trial,
    random_parameters,
    search_parameters,
)
from cnpgen.cli.main import main
from cnpgen.errors import UsageError


def test_random_values_lie_in_their_ranges_and_are_log_uniform_in_wide_ones() -> None:
    ranges = {
        "whole": (5, 50),
        "narrow": (1, 2),
        "wide": (1e-4, 1.0),
        "signed": (-1.0, 100.0),
    }
    draws = [
        random_parameters(ranges, [3, number], whole={"whole"}) for number in range(400)
    ]
    assert all(isinstance(draw["whole"], int) for draw in draws)
    assert len({draw["narrow"] for draw in draws}) == len(
        draws
    )  # the notation of the range does not matter
    for key, (low, high) in ranges.items():
        assert all(low <= draw[key] <= high for draw in draws)
    assert np.median([draw["wide"] for draw in draws]) == pytest.approx(1e-2, rel=0.6)
    assert np.median([draw["signed"] for draw in draws]) == pytest.approx(49.5, rel=0.2)
    assert random_parameters(ranges, [3, 7], whole={"whole"}) == draws[7]


@pytest.mark.parametrize("ends", [(2.0, 1.0), (1.0,), (0.0, float("inf"))])
def test_invalid_ranges_are_refused(ends: tuple[float, ...]) -> None:
    with pytest.raises(
        UsageError, match="ranges must have two increasing numbers for 'iterations'"
    ):
        random_parameters({"iterations": ends}, [0])


def test_trials_are_ranked_by_solved_problems_then_by_times() -> None:
    nan = float("nan")
    trials = [
        Trial(0, {}, 0.5, 1.0, nan),
        Trial(1, {}, 0.9, 5.0, 2.0),
        Trial(2, {}, 0.9, 4.0, 2.0),
    ]
    trials += [Trial(3, {}, 0.9, 9.0, 1.0), Trial(4, {}, 0.5, 9.0, 3.0)]
    assert [trial.number for trial in sorted(trials, key=_rank)] == [3, 2, 1, 4, 0]


def test_a_trial_counts_the_successes_on_all_plants() -> None:
    shares = {"nominal": 1.0, "challenge": 0.5}
    figures = {"planning_cpu_ms": {"median": 7.0}, "duration_s": {"median": 0.4}}
    benchmark = SimpleNamespace(
        executions=tuple(shares),
        summary=lambda plant: {
            "aqp": {"ratios": {"success": {"share": shares[plant]}}, "figures": figures}
        },
    )
    assert _trial(3, {}, benchmark, "aqp") == Trial(3, {}, 0.75, 7.0, 0.4)  # type: ignore[arg-type]


@pytest.mark.slow
def test_one_command_searches_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "benchmark",
        "hits-81",
        "--search",
        "trajopt.iterations=1..100",
        "--trials",
        "2",
        "--n",
        "1",
    ]
    assert main([*command, "-o", str(tmp_path)]) == 0
    rows = list(csv.DictReader((tmp_path / "search.csv").read_text().splitlines()))
    assert sorted(row["trial"] for row in rows) == ["0", "1", "2"]
    assert sorted(row["iterations"] == "" for row in rows) == [False, False, True]
    assert rows[0]["planning_cpu_ms"] in capsys.readouterr().out
    again = search_parameters(
        "hits-81", tmp_path, "trajopt", {"iterations": (1, 100)}, trials=2, n=1
    )
    assert [str(trial.planning_cpu_ms) for trial in again] == [
        row["planning_cpu_ms"] for row in rows
    ]


@pytest.mark.parametrize(
    "text", ["trajopt.iterations=5", "iterations=1..2", "trajopt.iterations=a..b"]
)
def test_the_command_refuses_other_texts(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "hits-81", "--search", text]) == 2
    assert "expected NAME.KEY=LOW..HIGH" in capsys.readouterr().err


def test_the_command_searches_for_one_planner_only(
    capsys: pytest.CaptureFixture[str],
) -> None:
    ranges = ["trajopt.iterations=1..9", "drake.samples=5..9"]
    assert main(["benchmark", "hits-81", "--search", *ranges]) == 2
    assert "--search has fields of one planner" in capsys.readouterr().err
