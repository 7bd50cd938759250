"""Smooth conditions between moments: their largest value does not depend on where one looks first."""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

from cnpgen.judges.plans.judge import Judge
from cnpgen.judges.plans.sampling import Samples
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spline import basis
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


class OfOneCondition:
    """A survey of one condition, whose excess is a function of the phase and that was looked at evenly."""

    def __init__(self, share: Callable[[np.ndarray], np.ndarray], samples: int = 24) -> None:
        self._share, s = share, np.linspace(0, 1, samples)
        self.samples, self.measured, self.asked = Samples(s, s), self.measure(None, s), 0

    def move(self, s: np.ndarray) -> None:
        self.asked += len(s)

    def measure(self, _: object, s: np.ndarray) -> list[SimpleNamespace]:
        return [SimpleNamespace(constraint=None, condition=SimpleNamespace(name="it"), share=self._share(s)[None])]

    def margin(self, found: SimpleNamespace, _: np.ndarray) -> float:
        return float(found.share.max())

    def largest(self) -> float:
        """The largest excess that the samples and a closer look show."""
        return max([self.measured[0].share.max(), *(margin for _, margin in judge_module.look_at_peaks(self))])


@pytest.mark.parametrize("top", [1.2, 1 + 1e-6, 1 - 1e-6, 0.9])
@pytest.mark.parametrize("first", [0.3, 0.5123])
def test_a_sharp_smooth_peak_is_climbed_to_its_top_where_that_decides(first: float, top: float) -> None:
    """One condition with a peak between samples: more samples are taken until its top is known."""
    survey = OfOneCondition(lambda s: top - 40 * np.square(s - first) - 300 * np.abs(s - first) ** 3)
    largest = survey.largest()
    assert largest == pytest.approx(top, abs=1e-2)
    assert (largest > 1) == (top > 1)
    assert survey.asked < 100


def _rises_slowly_and_falls_fast(s: np.ndarray) -> np.ndarray:
    return np.exp(8 * (s - 0.5)) - 0.3 * np.exp(40 * (s - 0.5))


def _begins_near_its_top(s: np.ndarray) -> np.ndarray:
    return -30 * np.square(s - 0.01)


def _has_two_tops_in_one_interval(s: np.ndarray) -> np.ndarray:
    return -4e5 * np.square(np.square(s - 0.5) - 1e-4)


@pytest.mark.parametrize("by", [1e-5, -1e-5])
@pytest.mark.parametrize("shape", [_rises_slowly_and_falls_fast, _begins_near_its_top, _has_two_tops_in_one_interval])
def test_tops_that_are_no_parabolas_between_three_samples_decide_as_any_other(
    shape: Callable[[np.ndarray], np.ndarray], by: float
) -> None:
    top = shape(np.linspace(0, 1, 10_000_001)).max()
    survey = OfOneCondition(lambda s: 1 + 10 * (shape(s) - top) + by)
    assert (survey.largest() > 1) == (by > 0)


def test_a_kink_of_the_torque_at_a_knot_of_either_spline_is_seen_at_first() -> None:
    """Splines of degree 3 have accelerations with kinks: here one peak at a knot that lies between the other's."""
    plan, points, rates, knot = load("hit"), 9, 16, 1 / 6
    path = np.repeat(plan.robot.base[None, None], points, axis=1)
    bumps = np.clip(1 - 6 * np.abs(np.arange(7) / 6 - knot), 0, None) - 0.5 * (np.abs(np.arange(7) - 1) == 1)
    path[0, :, 1] += 300 * np.linalg.lstsq(basis(np.arange(7) / 6, points, 3, 2), bumps, rcond=None)[0]
    motion = Motion(path, np.full((1, rates), 2.0), 3)
    state = motion.at(np.array([0.0, 1.0]))
    ends = Boundary(*(getattr(state, name)[:, k] for k in (0, 1) for name in ("q", "dq", "ddq")))
    only = tuple(each for each in plan.problem.constraint if isinstance(each, JointTorque))
    given = motion, ends, plan.start_xyz, plan.goal_xyz
    margin = Judge(replace(plan.problem, constraint=only), plan.robot)(*given)[0].margins["joint torque"]
    assert margin.phase == pytest.approx(knot, abs=1e-9)
    share = margin.excess / margin.allowed
    for by in (0.999, 1.001):
        constraint = tuple(replace(each, tolerance=each.tolerance * share * by) for each in only)
        judge = Judge(replace(plan.problem, constraint=constraint), plan.robot)
        assert [judge(*given, brief=brief)[0].valid for brief in (True, False)] == [by > 1] * 2
