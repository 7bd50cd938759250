"""Refinement until a deadline: never worse than the input, reported as cut short, no step that would end too late."""

import itertools
import json
import time

import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plan_file import load_plans, save_plans
from cnpgen.plans.plans import Plans
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refine_plans import refine_plans, solve_plans
from cnpgen.refine.solver import sqp
from cnpgen.refine.task import Outcome
from tests.conftest import some
from tests.refusals import is_refused


@pytest.fixture(scope="module")
def input_plans() -> Plans:
    """Return plans of a network, some of which are valid."""
    return Planner("airhockey-replan").plan_batch(
        draw_boundary_problems("airhockey-replan", 12, seed=4).boundary
    )


@pytest.fixture(scope="module")
def without_deadline(input_plans: Plans):
    return refine_plans(input_plans, workers=1)


def count_clock_readings(monkeypatch: pytest.MonkeyPatch, duration: float) -> None:
    """Let every reading of the clock take ``duration`` [s], and everything else no time."""
    ticks = itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: duration * next(ticks))


@pytest.mark.parametrize("readings", some([1, 8, 14, 20, 30], 1, "slow"))
def test_no_plan_is_worse_than_the_input_for_any_deadline(
    input_plans, without_deadline, monkeypatch, readings
):
    count_clock_readings(monkeypatch, 1e-3)
    found = refine_plans(
        input_plans, options=RefineOptions(deadline=readings * 1e-3), workers=1
    )
    before = evaluate_plans(input_plans, workers=1).valid
    assert found.valid[before].all()
    assert (
        found.plans.duration[before] <= input_plans.duration[before] * (1 + 1e-3)
    ).all()
    np.testing.assert_array_equal(
        found.valid, evaluate_plans(found.plans, workers=1).valid
    )
    if readings == 1:
        np.testing.assert_array_equal(
            found.plans.path_control_points[before],
            input_plans.path_control_points[before],
        )
        assert {result.outcome for result in found.results} == {Outcome.OUT_OF_TIME}
        assert {result.iterations for result in found.results} == {0}
    if readings == 30:
        gained = input_plans.duration - found.plans.duration
        assert (
            gained.sum()
            > 0.5 * (input_plans.duration - without_deadline.plans.duration).sum()
        )
        assert found.valid.all()


def test_with_a_long_deadline_plans_are_as_good_as_without_one(
    input_plans, without_deadline
):
    found = refine_plans(input_plans, options=RefineOptions(deadline=600.0), workers=1)
    np.testing.assert_array_equal(found.valid, without_deadline.valid)
    np.testing.assert_allclose(
        found.plans.duration, without_deadline.plans.duration, rtol=1e-9
    )
    assert [result.outcome for result in found.results] == [
        result.outcome for result in without_deadline.results
    ]


def test_no_step_starts_that_would_end_too_late(input_plans, monkeypatch):
    steps: list[float] = []
    advance = sqp._Iterate.advance
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    def timed(iterate: sqp._Iterate) -> None:
        advance(iterate)
        clock[0] += 2e-3
        steps.append(clock[0])

    monkeypatch.setattr(sqp._Iterate, "advance", timed)
    refine_plans(input_plans[0], options=RefineOptions(deadline=9e-3), workers=1)
    assert 0 < len(steps) <= 4
    assert max(steps) <= 9e-3


def test_without_an_input_plan_one_attempt_is_made_and_judged(input_plans):
    found = solve_plans(
        input_plans[:2], options=RefineOptions(deadline=1e-6), workers=1
    )
    assert {result.outcome for result in found.results} == {Outcome.OUT_OF_TIME}
    assert np.isfinite(found.plans.path_control_points).all()
    np.testing.assert_array_equal(
        found.valid, evaluate_plans(found.plans, workers=1).valid
    )


def test_the_options_of_a_plan_contain_its_deadline_only_if_it_has_one(
    input_plans, without_deadline
):
    assert "deadline" not in json.loads(without_deadline.plans.refined_with)
    found = refine_plans(
        input_plans[0], options=RefineOptions(deadline=1e-3), workers=1
    )
    assert json.loads(found.plans.refined_with)["deadline"] == 1e-3


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), "soon"])
def test_an_invalid_deadline_is_refused(value):
    with is_refused(UsageError, argument="deadline"):
        RefineOptions(deadline=value)


def test_the_command_reports_plans_cut_short_by_the_deadline(
    input_plans, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    save_plans("input.h5", input_plans)
    code = main(["refine", "input.h5", "-o", "by.h5", "--deadline", "0.001ms"])
    assert code == int(not evaluate_plans(input_plans, workers=1).valid.all())
    assert (
        "12 the best plan until the deadline; more time may give a better one"
        in capsys.readouterr().err
    )
    np.testing.assert_array_equal(load_plans("by.h5").columns["refine_outcome"], 9)
    assert (
        main(["refine", "input.h5", "-o", "by.h5", "--force", "--deadline", "soon"])
        == 2
    )
    assert "expected a time above 0" in capsys.readouterr().err
