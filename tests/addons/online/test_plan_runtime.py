"""Execution of plans in time: set-points, switches, refusals and stops, measured with SciPy, Pinocchio and MuJoCo."""

import sys
import threading

import numpy as np
import pytest
import scipy

from cnpgen.addons.benchmark.simulator.reference import TICK_S, Reference
from cnpgen.addons.online.plan_hits import plan_hits
from cnpgen.addons.online.plan_runtime import PlanRuntime
from cnpgen.addons.online.switches import SwitchOutcome
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.join import JoinedPlans, join_plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.results import HitOptions
from tests.conftest import HANGING, Arm
from tests.refusals import is_refused

TARGET = [2.49, 0.0]  # m
SHARE = 0.95  # of the maximum hitting speed, so that velocities stay within their limits after the hit


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner("airhockey-online")


def hit_and_return(planner: Planner, state, puck) -> JoinedPlans:
    """A hit and the way back to the base configuration."""
    hit = plan_hits(
        planner, state, puck, TARGET, options=HitOptions(speed_share=SHARE)
    ).plans
    q, dq, ddq = hit.states_at(hit.duration)
    return join_plans(
        hit, planner.plan(q, planner.robot.home, start_dq=dq, start_ddq=ddq)
    )


@pytest.fixture
def runtime(planner) -> PlanRuntime:
    return PlanRuntime(planner, planner.robot.home)


@pytest.fixture
def executing(planner, runtime) -> PlanRuntime:
    """A runtime that executes a hit and the way back from time 0.1 s on."""
    assert runtime.switch(
        hit_and_return(planner, runtime.state_at(0.1), [1.0, 0.2]), 0.1
    ).accepted
    return runtime


def states_of_scipy(plan, times):
    """Positions of one plan by SciPy: its phase is the solution of ds/dt = r(s)."""

    def spline(control):
        knots = np.r_[np.zeros(7), np.linspace(0, 1, len(control) - 6), np.ones(7)]
        return scipy.interpolate.BSpline(knots, control, 7)

    path, rate = (
        spline(plan.path_control_points[0]),
        spline(plan.rate_control_points[0]),
    )
    solution = scipy.integrate.solve_ivp(
        lambda _, s: rate(np.clip(s, 0, 1)),
        (0, times[-1]),
        [0.0],
        t_eval=times,
        rtol=1e-11,
        atol=1e-12,
        method="DOP853",
        max_step=1e-3,
    )
    s = np.clip(solution.y[0], 0, 1)
    return path(s), path.derivative()(s) * rate(s)[:, None]


def test_set_points_are_the_states_of_the_plan(planner, runtime):
    sequence = hit_and_return(planner, runtime.state_at(0.0), [0.95, -0.1])
    assert runtime.switch(sequence, 0.0).accepted
    hit = sequence.parts[0]
    times = np.linspace(1e-4, float(hit.duration[0]) - 1e-4, 53)
    q, dq = states_of_scipy(hit, times)
    points = runtime.set_point(times)
    np.testing.assert_allclose(points.q, q, atol=1e-8)
    np.testing.assert_allclose(points.dq, dq, atol=1e-6)
    np.testing.assert_allclose(runtime.state_at(9.0).q, planner.robot.home, atol=1e-9)
    assert not runtime.state_at(9.0).dq.any()
    assert 0 < runtime.end_time - float(sequence.duration[0]) < 0.1  # its end is slower


def test_a_switch_in_flight_is_continuous_in_position_velocity_and_acceleration(
    planner, executing
):
    old = executing.state_at(0.25)
    assert executing.switch(hit_and_return(planner, old, [1.05, -0.1]), 0.25).accepted
    before, after = (
        executing.state_at(np.array([0.25 + step])) for step in (-1e-9, 1e-9)
    )
    for left, right, tolerance in zip(before, after, (1e-8, 1e-7, 1e-5), strict=True):
        np.testing.assert_allclose(left, right, atol=tolerance)
    assert np.abs(old.dq).max() > 0.2
    times = np.arange(0.0, executing.end_time, 1e-4)
    q, dq, ddq = executing.set_point(times)
    np.testing.assert_allclose((q[2:] - q[:-2]) / 2e-4, dq[1:-1], atol=1e-4)
    np.testing.assert_allclose(
        (dq[2:] - dq[:-2]) / 2e-4, ddq[1:-1], atol=0.2
    )  # the jerk jumps


def test_plans_that_must_not_be_executed_are_refused_and_the_motion_continues(
    planner, executing
):
    state, end = executing.state_at(0.3), executing.end_time
    sequence = hit_and_return(planner, state, [1.05, -0.1])
    before = executing.state_at(np.linspace(0.1, end, 40))
    far = planner.plan(
        state.q, planner.robot.home + 0.6, start_dq=state.dq, start_ddq=state.ddq
    )
    refusals = {
        SwitchOutcome.NO_PLAN: executing.switch(None, 0.3),
        SwitchOutcome.MOVING: executing.switch(sequence.parts[0], 0.3),
        SwitchOutcome.JUMP: executing.switch(sequence, 0.31),
        SwitchOutcome.INVALID: executing.switch(far, 0.3),
    }
    executing.set_point(0.301)
    refusals[SwitchOutcome.LATE] = executing.switch(sequence, 0.3)
    for outcome, switch in refusals.items():
        assert switch.outcome is outcome
        assert not switch.accepted
    assert "jumps by" in refusals[SwitchOutcome.JUMP].detail
    assert refusals[SwitchOutcome.INVALID].detail
    assert executing.end_time == end
    for old, new in zip(
        before, executing.state_at(np.linspace(0.1, end, 40)), strict=True
    ):
        np.testing.assert_array_equal(old, new)


def test_replanning_in_the_background_switches_if_it_is_in_time(planner, executing):
    with executing:
        in_time = executing.replan(
            lambda state: hit_and_return(planner, state, [1.05, -0.1]), 0.3
        )
        assert in_time.result(timeout=60).accepted
        reached = threading.Event()

        def wait_and_plan(state):
            assert reached.wait(60)
            return hit_and_return(planner, state, [0.95, 0.1])

        late = executing.replan(wait_and_plan, 0.35)
        executing.set_point(0.36)
        reached.set()
        assert late.result(timeout=60).outcome is SwitchOutcome.LATE
        failed = executing.replan(lambda _: 1 / 0, 0.5).result(timeout=60)
        refused = executing.replan(
            lambda state: planner.plan(state.q[:3], state.q), 0.5
        ).result(timeout=60)
    assert (failed.outcome, refused.outcome) == (
        SwitchOutcome.FAILED,
        SwitchOutcome.FAILED,
    )
    assert failed.detail == "ZeroDivisionError: division by zero"
    assert "start_q" in refused.detail


@pytest.mark.parametrize("at", [0.2, 0.35, 0.55])
def test_a_stop_is_faster_than_the_motion_and_valid(planner, executing, at):
    end, robot = executing.end_time, open_problem(planner.model.problem)[1]
    start = executing.state_at(at)
    assert executing.stop(at).accepted
    assert executing.end_time < min(end, at + 0.5)
    q, dq, ddq = executing.set_point(np.arange(at, executing.end_time, 1e-3))
    assert np.abs(dq[0] - start.dq).max() < 1e-6
    assert (np.abs(dq) <= 1.002 * robot.velocity_limit).all()
    assert (np.abs(ddq) <= 1.005 * robot.acceleration_limit).all()
    heights = [Arm(robot).pose(joints).translation[2] for joints in q[::10]]
    assert np.abs(np.array(heights) - 0.16).max() < 2e-3
    assert not executing.set_point(executing.end_time).dq.any()


def test_a_stop_of_an_arm_at_rest_changes_nothing(planner, runtime):
    assert runtime.stop(0.5).accepted
    np.testing.assert_array_equal(runtime.set_point(2.0).q, planner.robot.home)


def test_invalid_arguments_raise_errors(planner, runtime):
    with is_refused(UsageError, argument="q"):
        PlanRuntime(planner, np.zeros(5))
    plans = planner.plan(np.zeros((2, 6)), np.ones((2, 6)))
    with is_refused(UsageError, argument="plan"):
        runtime.switch(plans, 0.5)


def test_a_hit_that_is_replanned_in_flight_scores_in_the_simulator_at_1_khz(
    planner, runtime
):
    """The puck turns out to lie elsewhere 0.12 s after the start; the arm hits it there, returns, and rests."""
    pytest.importorskip("mujoco")
    from cnpgen.addons.benchmark.simulator.execute import execute
    from cnpgen.addons.benchmark.simulator.plant import PLANTS
    from cnpgen.addons.benchmark.simulator.simulate import simulator_scene

    sequence = hit_and_return(planner, runtime.state_at(0.0), [1.0, 0.2])
    assert runtime.switch(sequence, 0.0).accepted
    points, contact_end, hit = [], 0.0, None
    for tick in range(2500):
        time = tick * TICK_S
        if tick == 100:
            new = hit_and_return(planner, runtime.state_at(0.12), [1.05, 0.05])
            assert runtime.switch(new, 0.12).accepted
            hit, contact_end = new.parts[0], 0.12 + float(new.parts[0].duration[0])
        points.append(runtime.set_point(time))
    q, dq, ddq = (np.array(values) for values in zip(*points, strict=True))
    scene = simulator_scene(hit, PLANTS["nominal"])
    np.testing.assert_allclose(scene.puck, [1.05, 0.05], atol=1e-6)
    execution = execute(
        scene, Reference(q, dq, ddq, contact_end), hit.columns["goal_xyz"][0]
    )
    assert execution.executed.success
    assert execution.executed.plane_error < 5e-3
    assert execution.executed.torque_use < 1
    base = (
        Arm(open_problem(planner.model.problem)[1]).pose(planner.robot.home).translation
    )
    resting = execution.tip[min(2400, len(execution.tip) - 1)]
    assert np.linalg.norm(resting - base) < 5e-3
    assert evaluate_plans(hit).valid.all()


@pytest.mark.parametrize("time", [np.nan, np.inf, [0.0, np.nan], [], [[0.0]]])
def test_set_points_at_impossible_times_are_refused_and_change_nothing(planner, time):
    runtime = PlanRuntime(planner, planner.robot.home)
    for evaluate in (runtime.set_point, runtime.state_at):
        with is_refused(UsageError, argument="time"):
            evaluate(time)
    assert (
        runtime.switch(
            planner.plan(planner.robot.home, planner.robot.home), 0.0
        ).outcome
        != SwitchOutcome.LATE
    )


def test_plans_and_stops_have_the_parameters_of_the_runtime():
    planner = Planner("heavy-object-loads")
    problems = draw_boundary_problems("heavy-object-loads", 1, seed=2)
    start, goal = problems.boundary.start_q[0], problems.boundary.goal_q[0]
    runtime = PlanRuntime(planner, start, parameters=[6.0])
    plans = {mass: planner.plan(start, goal, parameters=[mass]) for mass in (6.0, 7.0)}
    refused = runtime.switch(plans[7.0], 0.0)
    assert refused.outcome is SwitchOutcome.INVALID
    assert "parameters" in refused.detail
    assert runtime.switch(plans[6.0], 0.0).accepted
    with is_refused(UsageError, argument="parameters"):
        PlanRuntime(planner, start, parameters=[15.0])
    with is_refused(UsageError, argument="parameters"):
        PlanRuntime(planner, start, parameters=[[5.0], [6.0]])


def test_a_planner_that_ends_the_process_is_a_failed_request_and_the_next_one_is_served(
    planner,
):
    with PlanRuntime(planner, planner.robot.home) as runtime:
        for _ in range(2):
            found = runtime.replan(lambda _: sys.exit("enough"), 1.0).result(HANGING)
            assert found.outcome is SwitchOutcome.FAILED
            assert "enough" in found.detail


@pytest.mark.parametrize("step", [1e-8, 0.01])
def test_grids_that_miss_a_limit_or_fill_the_memory_are_refused(planner, step):
    with is_refused(UsageError, argument="grid_step"):
        PlanRuntime(planner, planner.robot.home, grid_step=step)
