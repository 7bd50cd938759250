"""Stops of the runtime: they latch, hold in any order of requests, and are valid by an integration of their own."""

import threading
import time

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.addons.online.motion_check import MotionChecker
from cnpgen.addons.online.plan_hits import HitOptions, plan_hits
from cnpgen.addons.online.plan_runtime import PlanRuntime
from cnpgen.addons.online.set_points import sample_motion
from cnpgen.addons.online.stops import earliest_stop
from cnpgen.addons.online.switches import SwitchOutcome
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.refine_plans import solve_plans
from tests.conftest import some
from tests.examples.example_robots import needs_robots
from tests.faults.chunk_orders import run_chunk_orders
from tests.faults.stop_orders import check_states, run_orders, small_arm, valid_plans
from tests.refusals import is_refused

TARGET = [2.49, 0.0]  # m
TICK_S = 1e-3


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner("airhockey-online")


@pytest.fixture
def executing(planner) -> PlanRuntime:
    """A runtime that executes a hit and the way back from time 0 on."""
    home, still = planner.robot.home, np.zeros(6)
    runtime = PlanRuntime(planner, home)
    assert runtime.switch(
        plan_hits(planner, (home, still, still), [1.0, 0.1], TARGET, home=home), 0.0
    ).accepted
    return runtime


def distance_from_path(q, path) -> float:
    """The largest distance of positions from a densely sampled path [rad]."""
    return max(np.abs(path - row).max(axis=1).min() for row in q)


@pytest.mark.parametrize("at", [0.03, 0.2, 0.35, 0.45, 0.6, 0.8, 0.86])
def test_a_stop_is_on_the_path_within_the_limits_and_never_later_than_the_motion(
    planner, executing, at
):
    end = executing.end_time
    times = np.arange(at, end + 0.01, TICK_S)
    path = executing.state_at(np.arange(0, end, 1e-4)).q
    stop = executing.stop(at)
    assert stop.accepted
    assert stop.time == at
    assert at < stop.end_time == executing.end_time <= end
    states = executing.state_at(times)
    check_states(planner.model.problem, times, states)
    assert distance_from_path(states.q[::10], path) < 1e-3
    travelled = np.abs(np.diff(executing.state_at(times).q, axis=0)).sum(axis=0)
    np.testing.assert_allclose(stop.distance, travelled, atol=1e-4)
    rest = executing.state_at(stop.end_time)
    assert not rest.dq.any()
    assert not rest.ddq.any()
    before = executing.state_at(np.array([stop.end_time - 1e-5]))
    assert np.abs(before.ddq / planner.robot.acceleration_limit).max() < 0.02


@pytest.mark.parametrize(
    "name", some(["heavy-object", "panda-cup", "panda-scenes", "ur5-wipe"])
)
def test_stops_of_transports_and_among_obstacles_are_valid(name):
    plans = valid_plans(name, 12)[1]
    rng, stops, checker = np.random.default_rng(3), 0, MotionChecker()
    for plan in plans:
        motion = sample_motion(plan, 0.0)
        for at in rng.uniform(0.0, motion.end_time, 4):
            stop = earliest_stop(checker, motion, at, measured=True)
            assert stop.end_time <= motion.end_time
            assert not checker.violation(stop, at, stop.end_time)
            times = np.arange(at, stop.end_time, TICK_S)
            if stop is not motion and len(times) > 1:
                check_states(plan.problem, times, stop.at(times))
                stops += 1
    assert stops > len(plans)
    assert len(plans) >= 3


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["heavy-object-drive", pytest.param("panda-scenes-drive", marks=needs_robots)],
)
def test_stops_of_arms_with_drives_are_within_the_limits_of_the_motors(name):
    """Nearly all stops end before their motion, with the first time law, by Pinocchio with rotors and exact friction."""
    plans = solve_plans(draw_boundary_problems(name, 5, seed=5), workers=1).plans
    robot = open_problem(plans.problem)[1]
    drive, model = robot.drive, robot.model.copy()
    model.armature = drive.armature
    data, rng, earlier = model.createData(), np.random.default_rng(1), []
    for index in np.flatnonzero(evaluate_plans(plans, workers=1).valid):
        motion, checker = sample_motion(plans[[index]], 0.0), MotionChecker()
        for at in motion.end_time * np.append(0.05, rng.uniform(0.1, 0.8, 4)):
            stop = earliest_stop(checker, motion, at, measured=True)
            earlier.append(stop is not motion)
            assert not checker.violation(stop, at, stop.end_time)
            times = np.arange(at, stop.end_time, TICK_S)
            for q, dq, ddq in zip(*stop.at(times), strict=True):
                torque = pin.rnea(model, data, q, dq, ddq)
                torque = torque + drive.viscous * dq + drive.coulomb * np.sign(dq)
                assert (np.abs(torque) <= 1.006 * drive.torque_limit).all()
    assert len(earlier) >= 15
    assert np.mean(earlier) > 0.8


def test_the_law_of_a_stop_counts_rotors_and_friction(monkeypatch):
    """With strong drives, the first time law is within the limits of the motors, and none is measured in vain."""
    problems = draw_boundary_problems("heavy-object-drive", 2, seed=5)
    plans, checker = solve_plans(problems, workers=1).plans, MotionChecker()
    measure, found = checker.violation, []
    monkeypatch.setattr(
        checker, "violation", lambda *given: found.append(measure(*given)) or found[-1]
    )
    for index in np.flatnonzero(evaluate_plans(plans, workers=1).valid):
        motion = sample_motion(plans[[index]], 0.0)
        for share in np.linspace(0.1, 0.75, 8):
            earliest_stop(checker, motion, share * motion.end_time, measured=True)
    assert len(found) > 6
    assert not any(found)


def test_a_stop_holds_although_a_replan_was_being_computed(planner, executing):
    home, go_on, started = planner.robot.home, threading.Event(), threading.Event()

    def make_plan(state):
        started.set()
        assert go_on.wait(60)
        return planner.plan(state.q, home, start_dq=state.dq, start_ddq=state.ddq)

    with executing:
        executing.set_point(0.1)
        running = executing.replan(make_plan, 0.2)
        waiting = executing.replan(lambda _: None, 0.3)
        assert started.wait(60)
        stop = executing.stop(0.25)
        resting = executing.state_at(3.0).q
        assert waiting.result(timeout=60).outcome is SwitchOutcome.STOPPED
        go_on.set()
        assert running.result(timeout=60).outcome is SwitchOutcome.STOPPED
        later = executing.replan(make_plan, 2.0).result(timeout=60)
        assert later.outcome is SwitchOutcome.STOPPED
        plan = planner.plan(resting, home)
        assert executing.switch(plan, 2.0).outcome is SwitchOutcome.STOPPED
    assert executing.end_time == stop.end_time
    np.testing.assert_array_equal(executing.state_at(3.0).q, resting)


def test_a_stopped_runtime_resumes_at_rest_and_only_after_the_stop(planner, executing):
    with is_refused(UsageError):
        executing.resume(planner.robot.home)
    executing.set_point(0.15)
    stop = executing.stop(0.2)
    assert executing.stop(0.3) is stop  # a second stop changes nothing
    measured = executing.state_at(stop.end_time).q + 1e-3
    with is_refused(UsageError, argument="at"):
        executing.resume(measured)
    executing.set_point(np.arange(0.15, stop.end_time + 0.5, 0.01))
    for wrong in (measured[:3], np.full(6, np.nan)):
        with is_refused(UsageError, argument="measured_q"):
            executing.resume(wrong)
    with pytest.raises(UsageError, match="measured_q must be an array of numbers"):
        executing.resume("here")
    assert executing.stopped
    executing.resume(measured)
    assert not executing.stopped
    at = stop.end_time + 1.0
    with is_refused(UsageError):
        executing.resume(measured, at=at)
    state = executing.set_point([at - 0.2, at])
    np.testing.assert_array_equal(state.q, [measured, measured])
    assert not state.dq.any()
    assert executing.switch(planner.plan(measured, planner.robot.home), at).accepted


def test_a_stop_that_comes_too_late_uses_a_kept_one(planner, executing, monkeypatch):
    from cnpgen.addons.online import plan_runtime

    def slow(*arguments, **named):
        executing.set_point(np.arange(0.1, 0.35, 0.01))  # the clock runs meanwhile
        return earliest_stop(*arguments, **named)

    end, begun = executing.end_time, time.monotonic()
    while len(executing._kept_stops._stops) < 6 and time.monotonic() < begun + 60:
        time.sleep(0.01)
    monkeypatch.setattr(plan_runtime, "earliest_stop", slow)
    stop = executing.stop(0.2)
    assert 0.34 < stop.time <= 0.34 + 0.1
    assert stop.end_time < end
    times = np.arange(0.34, stop.end_time, TICK_S)
    check_states(planner.model.problem, times, executing.state_at(times))


def test_an_accepted_switch_is_not_dropped_silently(planner):
    home = planner.robot.home
    away = home + np.array([0.2, 0, 0, 0, 0, 0])
    runtime = PlanRuntime(planner, home, judge=False)
    assert runtime.switch(planner.plan(home, away), 0.5).detail.count("replaces") == 0
    sooner = runtime.switch(planner.plan(home, away), 0.2)
    assert sooner.accepted
    assert "replaces the motion that was accepted for 0.5 s" in sooner.detail
    stopped = runtime.stop(0.1)
    assert stopped.detail == "replaces the motion that was accepted for 0.2 s"
    np.testing.assert_array_equal(runtime.state_at([0.3, 2.0]).q, [home, home])


def test_motions_end_without_an_acceleration_and_report_the_additional_time(
    planner, executing
):
    home, still = planner.robot.home, np.zeros(6)
    hit = plan_hits(planner, (home, still, still), [1.0, 0.1], TARGET, home=home)
    switch = PlanRuntime(planner, home).switch(hit, 0.0)
    assert "of the acceleration limit, which falls to 0 in" in switch.detail
    end = executing.end_time
    states = executing.state_at(end - np.array([1e-2, 1e-3, 1e-4, 1e-5]))
    share = np.abs(states.ddq / planner.robot.acceleration_limit).max(axis=1)
    assert (share < [1.01, 0.3, 0.03, 0.003]).all()
    times = np.arange(0.0, end, TICK_S)
    check_states(planner.model.problem, times, executing.state_at(times))


def test_hits_with_a_way_back_are_accepted_by_default(planner):
    home, still = planner.robot.home, np.zeros(6)
    random = np.random.default_rng(0)
    pucks = random.uniform([0.8, -0.4], [1.2, 0.4], (40, 2))
    # A hit that is invalid at 0.98 of the highest speed.
    pucks[0] = 0.94604407, 0.00477811
    for puck in pucks:
        hits = plan_hits(planner, (home, still, still), puck, TARGET, home=home)
        switch = PlanRuntime(planner, home, keep_stops=False).switch(hits, 0.0)
        assert switch.accepted, (puck, switch)


def test_hits_that_are_invalid_at_the_default_speed_are_slower(planner):
    home, still = planner.robot.home, np.zeros(6)
    pucks = [[0.94604407, 0.00477811], [1.0, 0.1]]
    state = (home, still, still)
    fast = HitOptions(speed_share=0.98)
    asked = plan_hits(planner, state, pucks, TARGET, home=home, options=fast)
    found = plan_hits(planner, state, pucks, TARGET, home=home)
    assert evaluate_plans(asked.plans).valid.tolist() == [False, True]
    assert evaluate_plans(found.plans).valid.all()
    speeds = (hits.plans.columns["hit_speed"] for hits in (found, asked))
    share = np.divide(*speeds)
    assert share[0] <= 0.98
    assert share[1] == 1.0
    unreachable = plan_hits(planner, state, [3.0, 0.0], TARGET, home=home)
    assert len(unreachable.plans) == 0


def test_a_failed_replan_gives_its_reason(planner, executing):
    home = planner.robot.home

    def out_of_reach(state):
        return plan_hits(planner, state, [3.0, 0.0], TARGET, home=home)

    with executing:
        hit = executing.replan(out_of_reach, 0.4).result(timeout=60)
        empty = executing.replan(lambda s: out_of_reach(s).plans, 0.4)
        assert empty.result(timeout=60).outcome is SwitchOutcome.NO_PLAN
    assert hit.outcome is SwitchOutcome.NO_PLAN
    assert hit.detail == "no hitting configuration"


def test_close_returns_although_a_planner_hangs(executing):
    release, started = threading.Event(), threading.Event()

    def hang(_):
        started.set()
        release.wait(60)

    hanging = executing.replan(hang, 0.4)
    assert started.wait(60)
    waiting = executing.replan(lambda _: None, 0.4)
    begun = time.monotonic()
    assert not executing.close(timeout=0.2)
    assert time.monotonic() - begun < 10
    assert hanging.result(timeout=1).outcome is SwitchOutcome.CLOSED
    assert waiting.result(timeout=1).outcome is SwitchOutcome.CLOSED
    with is_refused(UsageError):
        executing.replan(lambda _: None, 0.5)
    release.set()
    assert executing.close()  # the planner has returned, and its thread has ended
    for timeout in (0.0, -1.0, np.nan, True):
        with is_refused(UsageError, argument="timeout"):
            executing.close(timeout=timeout)


def test_set_points_in_the_past_are_refused_and_the_history_is_what_was_executed(
    planner,
):
    home = planner.robot.home
    runtime = PlanRuntime(planner, home)
    away = home + np.array([0.2, 0, 0, 0, 0, 0])
    assert runtime.switch(planner.plan(home, away), 1.0).accepted
    times = np.arange(0.0, 3.0, 0.01)
    executed = runtime.set_point(times)
    assert runtime.switch(planner.plan(away, home), 4.0).accepted
    for past in (0.999, 0.5, 2.98, [3.5, 0.5], -1e9, [2.995, 2.994]):
        with is_refused(UsageError, argument="time"):
            runtime.set_point(past)
    recent = times >= 2.99 - 1.0
    history = runtime.state_at(times[recent])
    for old, kept in zip(executed, history, strict=True):
        np.testing.assert_array_equal(old[recent], kept)
    for past in (0.999, 1.98, -1.0):
        with is_refused(UsageError, argument="time"):
            runtime.state_at(past)
    np.testing.assert_array_equal(runtime.set_point(2.99).q, executed.q[-1])


def test_steps_above_the_stated_one_are_refused_and_change_nothing(planner, executing):
    executing.set_point(0.2)
    for ahead in (0.6, [0.21, 0.6]):
        with is_refused(UsageError, argument="time"):
            executing.set_point(ahead)
    executing.set_point(0.201)
    patient = PlanRuntime(planner, planner.robot.home, max_step=9.0, history=0.25)
    assert patient.switch(
        planner.plan(planner.robot.home, planner.robot.home + 0.01), 0.0
    ).outcome in {SwitchOutcome.INVALID, SwitchOutcome.ACCEPTED}
    patient.set_point(5.0)


@pytest.mark.parametrize(
    "time", [True, [False, True], [0.3, 0.2], [0.0, np.nan], [0.2, 0.3, 0.29999]]
)
def test_descending_times_booleans_and_nan_are_refused(executing, time):
    for evaluate in (executing.set_point, executing.state_at):
        with is_refused(UsageError, argument="time"):
            evaluate(time)
    with is_refused(UsageError, argument="at"):
        executing.stop(True)


def test_nothing_changes_after_a_stop_in_any_order_of_requests():
    outcome = run_orders(5, seed=2026)
    assert outcome.findings == []
    assert outcome.requests["stop, ACCEPTED"] >= 2


def test_no_chunk_changes_a_motion_after_a_stop_in_any_order_of_requests():
    outcome = run_chunk_orders(5, seed=2026)
    assert outcome.findings == []
    assert outcome.requests["chunk, STOPPED"] >= 2


class QueueLock:
    """A lock that threads get in the order in which they ask for it."""

    def __init__(self):
        self.changed, self.threads = threading.Condition(), []

    def __enter__(self):
        with self.changed:
            self.threads.append(threading.current_thread())
            self.changed.notify_all()
            self.changed.wait_for(lambda: self.threads[0] is threading.current_thread())

    def __exit__(self, *_):
        with self.changed:
            self.threads.pop(0)
            self.changed.notify_all()

    def wait_for(self, thread):
        """Wait until a thread asks for the lock."""
        with self.changed:
            assert self.changed.wait_for(lambda: thread in self.threads, 60)


def test_a_stop_that_is_being_computed_is_finished_before_the_runtime_resumes(
    planner, executing, monkeypatch
):
    from cnpgen.addons.online import plan_runtime

    computing, go_on = threading.Event(), threading.Event()

    def slow(*arguments, **named):
        computing.set()
        assert go_on.wait(60)
        return earliest_stop(*arguments, **named)

    lock = QueueLock()
    monkeypatch.setattr(executing, "_stopping", lock)
    monkeypatch.setattr(plan_runtime, "earliest_stop", slow)
    end, home, stops = executing.end_time, planner.robot.home, []
    threads = [
        threading.Thread(target=lambda: stops.append(executing.stop(0.2))),
        threading.Thread(target=lambda: stops.append(executing.stop(0.3))),
        threading.Thread(target=executing.resume, args=(home,), kwargs={"at": 9.0}),
    ]
    threads[0].start()
    assert computing.wait(60)
    for thread in threads[1:]:
        thread.start()
        lock.wait_for(thread)
    assert threads[2].is_alive()
    assert executing.stopped
    go_on.set()
    for thread in threads:
        thread.join(60)
    # The first stop is complete, whatever came after it.
    assert stops[0].end_time < end
    np.testing.assert_array_equal(executing.state_at(9.0).q, home)
    at_end, later = executing.state_at([stops[0].end_time, 8.9]).q
    np.testing.assert_array_equal(at_end, later)


def test_the_motions_of_a_runtime_are_those_until_and_after_a_stop(planner, executing):
    executing.stop(0.25)
    starts = [motion.start for motion in executing._timeline]
    assert starts == sorted(starts)
    assert [motion.end_time for motion in executing._timeline][-1] == executing.end_time


def test_stops_of_stops_are_within_the_limits_between_samples():
    checker, random = MotionChecker(), np.random.default_rng(51)
    plans = small_arm().plans
    limit = open_problem(plans[0].problem)[1].acceleration_limit
    for number in range(480):
        motion = sample_motion(plans[number % len(plans)], 0.0, step=4e-3)
        for at in np.sort(random.uniform(0.0, 0.29, 3))[::-1].tolist():
            motion = earliest_stop(checker, motion, at, measured=False)
            times = np.arange(at, motion.end_time, 5e-5)
            assert (np.abs(motion.at(times).ddq) <= 1.005 * limit).all()
