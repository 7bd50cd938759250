"""Sampled trajectories: interpolation, verdicts and execution."""

import numpy as np
import pytest

from cnpgen.addons.benchmark.answers import execute_answer, judge_answer
from cnpgen.addons.benchmark.results_file import answer_to_dict
from cnpgen.addons.benchmark.run_suite import verdict_to_dict
from cnpgen.addons.benchmark.simulator.plant import PLANTS
from cnpgen.addons.trajectories.evaluate_trajectories import evaluate_trajectories
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.errors import UsageError
from cnpgen.plans import Plans, make_plans
from tests.examples.jerk_limits import jerk_limited_plan
from tests.examples.plans import load
from tests.refusals import is_refused

T = np.linspace(0, 1, 5)


def stored(label: str) -> Plans:
    plan = load(label)
    return make_plans(
        plan.problem,
        plan.boundary,
        path_control_points=plan.motion.path,
        rate_control_points=plan.motion.rate,
    )


def sampled(plan: Plans, count: int) -> Trajectory:
    t = np.linspace(0, float(plan.duration[0]), count)
    states = plan.motion.at(plan.motion.phase_at(t[None]))
    return Trajectory(t, states.q[0], states.dq[0], states.ddq[0])


@pytest.mark.parametrize("degree", [1, 3, 5])
def test_interpolation_reproduces_polynomials(degree: int) -> None:
    expected = [
        np.polynomial.Polynomial(np.arange(1.0, degree + 2)).deriv(order)
        for order in range(3)
    ]
    parts = [part(T)[:, None] for part in expected][: (degree + 1) // 2]
    times = np.linspace(0, 1, 37)
    for values, part in zip(Trajectory(T, *parts).states(times), expected, strict=True):
        np.testing.assert_allclose(values[:, 0], part(times), atol=1e-10)


def test_a_trajectory_stays_at_its_last_position() -> None:
    assert Trajectory(T, T[:, None]).states(np.array([2.0]))[0] == 1.0


def test_invalid_samples_are_refused() -> None:
    with is_refused(UsageError, argument="t"):
        Trajectory(T + 1, T[:, None])
    with is_refused(UsageError, argument="t"):
        Trajectory(T[::-1], T[:, None])
    with is_refused(UsageError, argument="ddq"):
        Trajectory(T, T[:, None], None, T[:, None])
    with is_refused(UsageError, argument="q"):
        Trajectory(T, T[:, None] * np.nan)


@pytest.mark.parametrize("label", ["hit", "transport"])
def test_a_plan_and_its_samples_have_the_same_verdict(label: str) -> None:
    plan = stored(label)
    of_plan, of_samples = (
        judge_answer(plan, plan),
        judge_answer(plan, sampled(plan, 400)),
    )
    assert of_plan.valid
    assert of_samples.valid, str(of_samples)
    assert of_plan.paper == of_samples.paper
    assert of_samples.metrics.duration == pytest.approx(of_plan.metrics.duration)
    assert of_samples.metrics.effort == pytest.approx(of_plan.metrics.effort, rel=1e-3)
    for name in ("z_error", "vertical_error"):
        assert getattr(of_samples.metrics, name) == pytest.approx(
            getattr(of_plan.metrics, name), rel=0.02, nan_ok=True
        )


def test_a_faster_trajectory_exceeds_the_acceleration_limit() -> None:
    plan = stored("transport")
    slow = sampled(plan, 400)
    fast = Trajectory(slow.t / 2, slow.q, slow.dq * 2, slow.ddq * 4)
    verdict = judge_answer(plan, fast)
    assert not verdict.valid
    assert verdict.margins["joint acceleration"].severity > 1


def test_positions_alone_have_no_accelerations_that_could_be_valid() -> None:
    plan = stored("transport")
    samples = sampled(plan, 400)
    verdict = judge_answer(plan, Trajectory(samples.t, samples.q))
    broken = {name for name, margin in verdict.margins.items() if not margin.ok}
    assert {"joint acceleration", "joint torque"} < broken
    assert verdict.margins["joint acceleration"].violation == np.inf
    assert verdict.margins["joint position"].ok
    assert "joint acceleration" not in verdict_to_dict(verdict)["value_over_bound"]


@pytest.mark.parametrize(("label", "count"), [("hit", 300), ("transport", 300)])
@pytest.mark.parametrize("speed", [1.0, 1.1])
def test_the_verdict_is_that_of_the_evaluation_of_the_same_curve(
    label: str, count: int, speed: float
) -> None:
    plan = stored(label)
    exact = sampled(plan, count)
    samples = Trajectory(
        exact.t / speed, exact.q, exact.dq * speed, exact.ddq * speed**2
    )
    verdict = judge_answer(plan, samples)
    (expected,) = evaluate_trajectories(
        plan.problem, [samples], interpolation="quintic"
    ).verdicts
    assert {
        name: margin.ok
        for name, margin in verdict.margins.items()
        if name in expected.conditions
    } == {
        name: entry.decision == "valid" for name, entry in expected.conditions.items()
    }
    margin = expected.conditions["joint velocity"].margin
    if speed == 1:
        assert verdict.margins["joint velocity"] == margin
    else:  # a lower bound of all curves
        assert 1 < margin.severity <= verdict.margins["joint velocity"].severity


@pytest.mark.parametrize("known", ["positions", "velocities", "accelerations"])
def test_jerks_are_judged_if_the_problem_limits_them(known: str) -> None:
    example = jerk_limited_plan("transport")
    motion = example.motion
    plan = make_plans(
        example.problem,
        example.boundary,
        path_control_points=motion.path,
        rate_control_points=motion.rate,
    )
    expected = judge_answer(plan, plan)
    samples = sampled(plan, 400)
    parts = {
        "positions": (),
        "velocities": (samples.dq,),
        "accelerations": (samples.dq, samples.ddq),
    }[known]
    verdict = judge_answer(plan, Trajectory(samples.t, samples.q, *parts))
    margin, expected_margin = (
        result.margins["joint jerk"] for result in (verdict, expected)
    )
    assert margin.severity > 1
    if known == "accelerations":
        assert margin.part == expected_margin.part
        assert abs(margin.value) == pytest.approx(abs(expected_margin.value), rel=0.05)
        assert verdict.metrics.jerk == pytest.approx(expected.metrics.jerk, rel=0.05)


@pytest.mark.slow
def test_a_plan_and_its_samples_have_the_same_execution() -> None:
    pytest.importorskip("mujoco")
    plan = stored("hit")
    of_plan, of_samples = (
        execute_answer((plan, answer_to_dict(answer), None), plant=PLANTS["nominal"])
        for answer in (plan, sampled(plan, 400))
    )
    assert of_samples.hit_time == of_plan.hit_time
    assert of_samples.puck_speed == pytest.approx(of_plan.puck_speed, rel=1e-3)
    assert of_samples.z_error == pytest.approx(of_plan.z_error, rel=0.02)


def test_a_trajectory_of_excessive_duration_is_not_executed() -> None:
    pytest.importorskip("mujoco")
    plan = stored("transport")
    samples = sampled(plan, 10)
    executed = execute_answer(
        (plan, answer_to_dict(Trajectory(samples.t * 1000, samples.q)), None),
        plant=PLANTS["nominal"],
    )
    assert "cannot be executed" in executed.failure
    assert (
        judge_answer(plan, Trajectory(samples.t * 1000, samples.q)).reason == "too long"
    )
