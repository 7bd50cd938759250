"""Smooth conditions between moments: their largest value does not depend on where one looks first."""

from importlib import import_module

import numpy as np
import pytest

from cnpgen.judges.plans.sampling import Samples
from tests.conftest import some
from tests.examples.plans import bent, course, load, raised

judge_module = import_module("cnpgen.judges.plans.judge")  # the package has a function of the same name


@pytest.mark.parametrize("label", some(["replan", "transport", "hit"], 2))
@pytest.mark.parametrize("seed", some([1, 2]))
def test_margins_are_those_of_a_very_fine_grid(label: str, seed: int) -> None:
    plan = bent(load(label), 0.01, seed=seed)
    exact, margins = course(plan, 20001), plan.judged().margins
    found, limit = margins["joint torque"], plan.robot.torque_limit
    joint = plan.robot.joint_names.index(found.part)
    worst = (np.abs(exact.tau[:, joint]) - limit[joint]).max()
    assert found.excess == pytest.approx(worst, abs=1e-2 * found.allowed)
    if "table height" in margins:
        name, worst = "table height", np.abs(exact.tip[:, 2] - margins["table height"].bound).max()
    else:
        name, worst = "tilt", np.abs(exact.rotation[:, :2, 2]).max()
    assert margins[name].excess == pytest.approx(worst, abs=1e-2 * margins[name].allowed)


@pytest.mark.slow
def test_without_the_closer_look_a_peak_between_moments_would_be_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan that is further off the table than is allowed by a nanometre, between moments 10 ms apart."""
    plan = bent(load("replan"), 0.05, seed=1)
    off = np.abs(course(plan, 200_001).tip[:, 2] - plan.judged().margins["table height"].bound).max()
    strict = plan.with_constraint("Table", tolerance=off - 1e-9)
    assert not strict.judged(step=1e-2).margins["table height"].ok
    monkeypatch.setattr(judge_module, "look_at_peaks", lambda _: iter(()))
    assert strict.judged(step=1e-2).margins["table height"].ok


def test_the_largest_excess_at_a_kink_of_a_funnel_is_found() -> None:
    """A motion that comes down to the table slowly exceeds its funnel most just where that begins to close, or ends."""
    plan = raised(load("replan"), 0.01)
    fine, coarse = (plan.judged(step=step).margins["table height"] for step in (1e-4, 1e-2))
    assert coarse.excess == pytest.approx(fine.excess, abs=1e-2 * fine.allowed)


@pytest.mark.parametrize("top", [1.2, 1 + 1e-6, 1 - 1e-6, 0.9])
@pytest.mark.parametrize("first", [0.3, 0.5123])
def test_a_sharp_smooth_peak_is_climbed_to_its_top_where_that_decides(first: float, top: float) -> None:
    """One condition with a peak between samples: more samples are taken until its top is known."""
    asked: list[np.ndarray] = []

    class Condition:
        name = "peak"

    class Measured:
        constraint, condition = None, Condition()

        def __init__(self, s: np.ndarray) -> None:
            self.share = top - 40 * np.square(s - first)[None] - 300 * np.abs(s - first)[None] ** 3

    class Survey:
        samples = Samples(np.linspace(0, 1, 24), np.linspace(0, 1, 24))
        measured = (Measured(np.linspace(0, 1, 24)),)

        def move(self, s: np.ndarray) -> None:
            asked.append(s)

        def measure(self, _: object, s: np.ndarray) -> list[Measured]:
            return [Measured(s)]

        def margin(self, found: Measured, _: np.ndarray) -> float:
            return float(found.share.max())

    sampled = float(Survey.measured[0].share.max())
    found = [sampled, *(margin for _, margin in judge_module.look_at_peaks(Survey()))]
    assert max(found) == pytest.approx(top, abs=1e-2)
    assert (max(found) > 1) == (top > 1)
    assert sum(len(s) for s in asked) < 60
