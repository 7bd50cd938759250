"""Contacts between two moments: peaks of depth are found, and nothing else changes."""

from importlib import import_module

import numpy as np
import pytest

from cnpgen.judges.plans import Margin
from cnpgen.judges.plans.closer import intervals, keep_worse
from tests.examples.plans import bent, load

judge_module = import_module("cnpgen.judges.plans.judge")  # the package has a function of the same name


@pytest.mark.parametrize(("by", "seed"), [(0.0, 0), (0.005, 3), (0.01, 5), (0.02, 2)])
def test_where_edges_pass_each_other_between_two_moments_the_peak_is_found(
    by: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = bent(load("dragging"), by, seed=seed)
    found = plan.judged()
    monkeypatch.setattr(judge_module, "look_closer", lambda *_: [])
    coarse, fine = plan.judged(), plan.judged(step=2e-5)
    deepest = fine.margins["object contact"].excess
    assert deepest - coarse.margins["object contact"].excess > 1e-4
    assert found.margins["object contact"].excess == pytest.approx(deepest, abs=1e-5)
    assert found.margins["object contact"].time == pytest.approx(fine.margins["object contact"].time, abs=1e-4)
    others = [{name: margin for name, margin in v.margins.items() if name != "object contact"} for v in (found, coarse)]
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


def moving(distances: list[float], ways: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Distances from one obstacle, and the corners of an object that moves by so much from moment to moment."""
    corners = np.zeros((8, 3, len(distances)))
    corners[:, 0] = np.concatenate([[0.0], np.cumsum(ways)])
    return np.array([distances]), corners


def test_intervals_beside_the_deepest_moment_and_those_that_could_hide_too_much_are_chosen() -> None:
    distances = [5.0, 1.0, 3.0, 3.0, 2.0, 2.0, 9.0, 9.0]
    assert intervals(*moving(distances, [1.0] * 7), 0.0).tolist() == [0, 1]
    assert intervals(*moving(distances, [1.0, 1.0, 1.0, 1.0, 4.1, 1.0, 18.1]), 0.0).tolist() == [0, 1, 4, 6]
    assert intervals(*moving(distances, [1.0, 1.0, 1.0, 1.0, 3.9, 1.0, 17.9]), 0.0).tolist() == [0, 1]


def test_where_the_deepest_moment_is_too_deep_already_nothing_else_is_looked_into() -> None:
    assert intervals(*moving([5.0, -1.0, 3.0, 3.0, 2.0], [50.0] * 4), -0.5).tolist() == [0, 1]


def test_at_either_end_there_is_one_interval_and_nan_is_no_trouble() -> None:
    assert intervals(*moving([1.0, 2.0, 3.0], [0.0] * 2), 0.0).tolist() == [0]
    assert intervals(*moving([3.0, 2.0, 1.0], [0.0] * 2), 0.0).tolist() == [1]
    assert intervals(*moving([3.0, np.nan, 1.0], [9.0] * 2), 0.0).tolist() == [0, 1]


def test_of_more_intervals_than_can_be_looked_into_those_that_hide_most_are_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cnpgen.judges.plans.closer.MOST", 2)
    distances, corners = moving([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [9.0, 9.0, 20.0, 9.1, 30.0])
    assert intervals(distances, corners, 0.0).tolist() == [0, 2, 4]


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


def contact(excess: float, reason: str = "object in collision") -> Margin:
    return Margin("object contact", reason, "m", "", -excess, 0.0, excess, 1e-3, 0.0, 0.0)


def test_of_both_looks_the_more_severe_margin_is_kept() -> None:
    other = Margin("tilt", "not vertical", "rad", "x", 0.1, 0.0, 0.1, 0.03, 0.0, 0.0)
    margins = [other, contact(1e-4), contact(5e-4)]
    assert keep_worse(margins, []) == margins
    assert keep_worse(margins, [contact(2e-4), contact(4e-4)]) == [other, contact(2e-4), contact(5e-4)]
    assert keep_worse(margins, [contact(9e-4, "another"), contact(8e-4)]) == [other, contact(8e-4), contact(5e-4)]
