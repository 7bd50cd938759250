"""Refining until a deadline: never worse than given, said to be cut, no step that would end too late."""

import itertools
import json
import time

import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make.boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.load import load_plans
from cnpgen.plans.plans import Plans
from cnpgen.plans.save import save_plans
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.plans import refine_plans, solve_plans
from cnpgen.refine.solver import sqp
from cnpgen.refine.task import Outcome
from tests.conftest import some


@pytest.fixture(scope="module")
def given() -> Plans:
    """Plans of a network, some of which are valid."""
    return Planner("airhockey-replan").plan_batch(draw_boundary_problems("airhockey-replan", 12, seed=4).boundary)


@pytest.fixture(scope="module")
def whole(given: Plans):
    return refine_plans(given, workers=1)


def paced(monkeypatch: pytest.MonkeyPatch, pace: float) -> None:
    """Let every look at the clock take ``pace`` [s], and nothing else any time."""
    ticks = itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: pace * next(ticks))


@pytest.mark.parametrize("looks", some([1, 8, 14, 20, 30], 1, "slow"))
def test_whatever_the_deadline_no_plan_is_worse_than_given(given, whole, monkeypatch, looks):
    paced(monkeypatch, 1e-3)
    found = refine_plans(given, options=RefineOptions(deadline=looks * 1e-3), workers=1)
    before = evaluate_plans(given, workers=1).valid
    assert found.valid[before].all()
    assert (found.plans.duration[before] <= given.duration[before] * (1 + 1e-3)).all()
    np.testing.assert_array_equal(found.valid, evaluate_plans(found.plans, workers=1).valid)
    if looks == 1:
        np.testing.assert_array_equal(found.plans.path_control_points[before], given.path_control_points[before])
        assert {each.outcome for each in found.refined} == {Outcome.OUT_OF_TIME}
        assert {each.iterations for each in found.refined} == {0}
    if looks == 30:
        gained = given.duration - found.plans.duration
        assert gained.sum() > 0.5 * (given.duration - whole.plans.duration).sum()
        assert found.valid.all()


def test_with_all_the_time_in_the_world_plans_are_as_good_as_without_a_deadline(given, whole):
    found = refine_plans(given, options=RefineOptions(deadline=600.0), workers=1)
    np.testing.assert_array_equal(found.valid, whole.valid)
    np.testing.assert_allclose(found.plans.duration, whole.plans.duration, rtol=1e-9)
    assert [each.outcome for each in found.refined] == [each.outcome for each in whole.refined]


def test_no_step_is_begun_that_would_end_too_late(given, monkeypatch):
    steps: list[float] = []
    advance = sqp._Descent.advance
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    def one(descent: sqp._Descent) -> None:
        advance(descent)
        clock[0] += 2e-3
        steps.append(clock[0])

    monkeypatch.setattr(sqp._Descent, "advance", one)
    refine_plans(given[0], options=RefineOptions(deadline=9e-3), workers=1)
    assert 0 < len(steps) <= 4
    assert max(steps) <= 9e-3


def test_without_a_plan_one_attempt_is_made_and_judged(given):
    found = solve_plans(given[:2], options=RefineOptions(deadline=1e-6), workers=1)
    assert {each.outcome for each in found.refined} == {Outcome.OUT_OF_TIME}
    assert np.isfinite(found.plans.path_control_points).all()
    np.testing.assert_array_equal(found.valid, evaluate_plans(found.plans, workers=1).valid)


def test_a_plan_says_its_deadline_and_without_one_nothing_of_it(given, whole):
    assert "deadline" not in json.loads(whole.plans.refined_with)
    found = refine_plans(given[0], options=RefineOptions(deadline=1e-3), workers=1)
    assert json.loads(found.plans.refined_with)["deadline"] == 1e-3


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), "soon"])
def test_a_deadline_that_makes_no_sense_is_refused(value):
    with pytest.raises(UsageError, match="deadline must be"):
        RefineOptions(deadline=value)


def test_the_command_says_what_the_deadline_did(given, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_plans("given.h5", given)
    code = main(["refine", "given.h5", "-o", "by.h5", "--deadline", "0.001ms"])
    assert code == int(not evaluate_plans(given, workers=1).valid.all())
    assert "12 the best until the deadline: with more time there may be a better one" in capsys.readouterr().err
    np.testing.assert_array_equal(load_plans("by.h5").columns["refine_outcome"], 9)
    assert main(["refine", "given.h5", "-o", "by.h5", "--force", "--deadline", "soon"]) == 2
    assert "expected a time above 0" in capsys.readouterr().err
