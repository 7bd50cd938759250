"""Contacts between two moments: peaks of depth are found, and nothing else changes."""

from importlib import import_module

import numpy as np
import pytest
from example_plans import bent, load

from cnpgen.verdict import Margin
from cnpgen.verdict.closer import keep_worse

judge_module = import_module("cnpgen.verdict.judge")  # the package has a function of the same name


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
