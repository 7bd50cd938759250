"""Sampled trajectories: what lies between two samples, how they are judged and executed."""

import numpy as np
import pytest

from cnpgen.benchmark.execution import execute_answer
from cnpgen.benchmark.judging import judge_answer
from cnpgen.benchmark.results_file import answer_to_dict
from cnpgen.benchmark.simulator.plant import PLANTS
from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.errors import UsageError
from cnpgen.plans import Plans, make_plans
from tests.examples.jerk_limits import jerk_limited_plan
from tests.examples.plans import load

T = np.linspace(0, 1, 5)


def stored(label: str) -> Plans:
    plan = load(label)
    return make_plans(
        plan.problem, plan.boundary, path_control_points=plan.motion.path, rate_control_points=plan.motion.rate
    )


def sampled(plan: Plans, count: int) -> Trajectory:
    t = np.linspace(0, float(plan.duration[0]), count)
    states = plan.motion.at(plan.motion.phase_at(t[None]))
    return Trajectory(t, states.q[0], states.dq[0], states.ddq[0])


@pytest.mark.parametrize("degree", [1, 3, 5])
def test_a_polynomial_of_its_degree_is_followed_exactly(degree: int) -> None:
    wanted = [np.polynomial.Polynomial(np.arange(1.0, degree + 2)).deriv(order) for order in range(3)]
    parts = [part(T)[:, None] for part in wanted][: (degree + 1) // 2]
    at = np.linspace(0, 1, 37)
    for found, part in zip(Trajectory(T, *parts).states(at), wanted, strict=True):
        np.testing.assert_allclose(found[:, 0], part(at), atol=1e-10)


def test_after_its_end_a_trajectory_stays_at_its_last_position() -> None:
    assert Trajectory(T, T[:, None]).states(np.array([2.0]))[0] == 1.0


def test_what_is_no_trajectory_is_refused() -> None:
    with pytest.raises(UsageError, match="begins at t = 0, got 1"):
        Trajectory(T + 1, T[:, None])
    with pytest.raises(UsageError, match="must increase"):
        Trajectory(T[::-1], T[:, None])
    with pytest.raises(UsageError, match="needs velocities"):
        Trajectory(T, T[:, None], None, T[:, None])
    with pytest.raises(UsageError, match="must be finite"):
        Trajectory(T, T[:, None] * np.nan)


@pytest.mark.parametrize("label", ["hit", "transport"])
def test_a_plan_and_its_samples_are_judged_alike(label: str) -> None:
    plan = stored(label)
    one, other = judge_answer(plan, plan), judge_answer(plan, sampled(plan, 400))
    assert one.valid
    assert other.valid, str(other)
    assert one.paper == other.paper
    assert other.metrics.duration == pytest.approx(one.metrics.duration)
    assert other.metrics.effort == pytest.approx(one.metrics.effort, rel=1e-3)
    for name in ("z_error", "vertical_error"):
        assert getattr(other.metrics, name) == pytest.approx(getattr(one.metrics, name), rel=0.02, nan_ok=True)


def test_a_faster_trajectory_exceeds_the_acceleration_limit() -> None:
    plan = stored("transport")
    slow = sampled(plan, 400)
    fast = Trajectory(slow.t / 2, slow.q, slow.dq * 2, slow.ddq * 4)
    verdict = judge_answer(plan, fast)
    assert not verdict.valid
    assert verdict.margins["joint acceleration"].severity > 1


def test_jumps_in_the_velocity_of_a_linear_trajectory_are_seen_as_accelerations() -> None:
    plan = stored("transport")
    few = sampled(plan, 12)
    verdict = judge_answer(plan, Trajectory(few.t, few.q))
    margin = verdict.margins["joint acceleration"]
    assert abs(margin.value) > 5 * abs(margin.bound)


@pytest.mark.parametrize("known", ["positions", "velocities", "accelerations"])
def test_jerks_are_judged_where_a_problem_limits_them(known: str) -> None:
    example = jerk_limited_plan("transport")
    motion = example.motion
    plan = make_plans(
        example.problem, example.boundary, path_control_points=motion.path, rate_control_points=motion.rate
    )
    whole = judge_answer(plan, plan)
    given = sampled(plan, 400)
    parts = {"positions": (), "velocities": (given.dq,), "accelerations": (given.dq, given.ddq)}[known]
    verdict = judge_answer(plan, Trajectory(given.t, given.q, *parts))
    margin, wanted = (each.margins["joint jerk"] for each in (verdict, whole))
    assert margin.severity > 1
    if known == "accelerations":
        assert margin.part == wanted.part
        assert abs(margin.value) == pytest.approx(abs(wanted.value), rel=0.05)
        assert verdict.metrics.jerk == pytest.approx(whole.metrics.jerk, rel=0.05)


@pytest.mark.slow
def test_a_plan_and_its_samples_are_executed_alike() -> None:
    pytest.importorskip("mujoco")
    plan = stored("hit")
    one, other = (
        execute_answer((plan, answer_to_dict(each), None), plant=PLANTS["nominal"])
        for each in (plan, sampled(plan, 400))
    )
    assert other.hit_time == one.hit_time
    assert other.puck_speed == pytest.approx(one.puck_speed, rel=1e-3)
    assert other.z_error == pytest.approx(one.z_error, rel=0.02)


def test_what_cannot_be_executed_says_so() -> None:
    pytest.importorskip("mujoco")
    plan = stored("transport")
    slow = sampled(plan, 10)
    found = execute_answer((plan, answer_to_dict(Trajectory(slow.t * 1000, slow.q)), None), plant=PLANTS["nominal"])
    assert "cannot be executed" in found.failure
    assert judge_answer(plan, Trajectory(slow.t * 1000, slow.q)).reason == "too long"
