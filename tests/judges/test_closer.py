"""Contacts between two moments: peaks of depth are found, and nothing else changes."""

from importlib import import_module

import numpy as np
import pytest

from cnpgen.judges.plans.closer import BOWED, Intervals
from tests.conftest import some
from tests.examples.plans import bent, load

judge_module = import_module("cnpgen.judges.plans.judge")  # the package has a function of the same name


@pytest.mark.parametrize(("by", "seed"), some([(0.0, 0), (0.005, 3), (0.01, 5), (0.02, 2)], 1, "slow"))
def test_where_edges_pass_each_other_between_two_moments_the_peak_is_found(
    by: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = bent(load("dragging"), by, seed=seed)
    found = plan.judged()
    monkeypatch.setattr(judge_module, "look_closer", lambda _: iter(()))
    coarse, fine = plan.judged(), plan.judged(step=2e-5)
    deepest = fine.margins["object contact"].excess
    assert deepest - coarse.margins["object contact"].excess > 1e-4
    assert found.margins["object contact"].excess == pytest.approx(deepest, abs=1e-5)
    assert found.margins["object contact"].time == pytest.approx(fine.margins["object contact"].time, abs=1e-4)
    others = [{name: margin for name, margin in v.margins.items() if margin.unit != "m"} for v in (found, coarse)]
    assert others[0] == others[1]
    assert found.metrics.to_dict() == coarse.metrics.to_dict()
    assert found.paper == coarse.paper
    assert found.samples == coarse.samples


@pytest.mark.parametrize(("seed", "step"), [(9, 1e-3), (8, 3e-3)])
def test_a_peak_far_from_the_deepest_moment_is_found_where_it_decides(seed: int, step: float) -> None:
    """The object touches twice; where it is a little less deep at the moments, it is deeper between them."""
    plan = bent(load("dragging"), 0.02, seed=seed)
    deepest = plan.judged(step=step / 40).margins["object contact"]
    moments = plan.judged(step=step).margins["object contact"]
    assert abs(deepest.time - moments.time) > 10 * step
    strict = plan.with_constraint("ObjectContact", tolerance=moments.excess + 2e-5).judged(step=step)
    found = strict.margins["object contact"]
    assert not found.ok
    assert found.excess == pytest.approx(deepest.excess, abs=2e-5)
    assert found.time == pytest.approx(deepest.time, abs=step)


def between(room: list[float], ways: list[float]) -> Intervals:
    """Intervals between moments at which one pair of bodies has so much room; so far they move from one to the next."""
    moments, values = np.linspace(0, 1, len(room)), np.array(room)
    ends = [np.column_stack([each[:-1], each[1:]]) for each in (moments, values)]
    return Intervals(ends[0], ends[1][None], np.array(ways))


def test_intervals_beside_the_deepest_moment_are_divided() -> None:
    assert between([5.0, 1.0, 3.0, 3.0], [1.0] * 3).deepest().tolist() == [True, True, False]
    assert between([1.0, 2.0, 3.0], [0.0] * 2).deepest().tolist() == [True, False]
    assert between([3.0, 2.0, 1.0], [0.0] * 2).deepest().tolist() == [False, True]


def test_intervals_that_could_hide_more_than_is_allowed_are_divided() -> None:
    room = [5.0, 1.0, 3.0, 3.0, 2.0, 2.0, 9.0, 9.0]
    assert not between(room, [1.0] * 7).hiding().any()
    assert np.flatnonzero(between(room, [1.0, 1.0, 1.0, 1.0, 4.0, 1.0, 18.0]).hiding()).tolist() == [4, 6]
    assert not between(room, [1.0, 1.0, 1.0, 1.0, 3.9, 1.0, 17.8]).hiding().any()


def test_what_bends_more_than_a_straight_line_is_counted_in() -> None:
    assert between([1.0, 1.0], [2.0]).hiding().all()
    assert not between([1.0, 1.0], [2.0 / BOWED - 1e-9]).hiding().any()


def test_where_more_than_is_allowed_is_exceeded_anyway_nothing_is_searched() -> None:
    assert not between([5.0, -0.1, 3.0], [50.0] * 2).hiding().any()
    assert not between([5.0, np.nan, 3.0], [50.0] * 2).hiding().any()


def test_of_more_intervals_than_can_be_looked_into_those_that_hide_most_are_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cnpgen.judges.plans.closer.MOST", 2)
    found = between([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [9.0, 9.0, 20.0, 9.1, 30.0]).hiding()
    assert np.flatnonzero(found).tolist() == [2, 4]


def test_a_peak_at_either_end_is_no_trouble() -> None:
    """The object stands deepest at its very start, or at its very end."""
    plan = load("transport")
    for ends in ((0.01, 0.0), (0.0, 0.01)):
        start, goal = (
            xyz + np.array([0, 0, up]) for xyz, up in zip((plan.start_xyz, plan.goal_xyz), ends, strict=True)
        )
        verdict = type(plan)(plan.problem, plan.robot, plan.motion, plan.boundary, start, goal).judged()
        margin = verdict.margins["object contact"]
        assert margin.excess == pytest.approx(0.0095, abs=1e-3)
        assert (margin.phase < 0.5) == (ends[0] > 0)
