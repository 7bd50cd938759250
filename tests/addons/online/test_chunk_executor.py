"""Execution of action chunks: joins, refusals and stops, measured by Pinocchio and by the full verdict."""

import time as clock
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.addons.online.chunk_checks import ChunkOptions
from cnpgen.addons.online.chunk_executor import ChunkExecutor
from cnpgen.addons.online.switches import SwitchOutcome
from cnpgen.errors import UsageError
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.constraints.joint import JointJerk
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.robot_spec import PerJoint
from tests.examples.example_robots import needs_robots
from tests.refusals import is_refused

pytestmark = needs_robots

RATE, LENGTH = 30.0, 50
HOME = np.radians([0, -45, 0, -135, 0, 90, 45])
OPTIONS = {
    "rate": RATE,
    "length": LENGTH,
    "join": 0.05,
    "max_distance": 0.1,
    "tracking_error": 0.03,
    "stale_after": 0.5,
}
AMPLITUDE = np.array([0.4, 0.3, 0.3, 0.3, 0.4, 0.4, 0.5])


def reference(t):
    """Positions of a smooth motion from rest, shape (K, 7)."""
    return HOME + AMPLITUDE * (1 - np.cos(1.4 * np.asarray(t)))[:, None] / 2


def chunk(t, **options):
    """A chunk of the reference from a time on, with noise and an offset, and a gripper that closes slowly."""
    rng = np.random.default_rng(options.get("seed", 0))
    times = t + np.arange(LENGTH) / RATE
    q = reference(times) + rng.uniform(-5e-4, 5e-4, (LENGTH, 7))
    q += options.get("offset", 0.0) * rng.uniform(-1, 1, 7)
    return np.column_stack([q, np.linspace(0, 1, LENGTH)])


class Controller:
    """An executor with a clock: serves set points at 100 Hz and keeps them."""

    def __init__(self, executor, q=HOME):
        self.executor, self.time, self.points = executor, 100.0, []
        executor.reset((q, np.zeros(7)))
        self.run(0.01)

    def run(self, duration):
        for _ in range(round(duration * 100)):
            self.time += 0.01
            self.points.append(self.executor.set_point(self.time))

    def step(self, values, *, age=0.0, measured=None):
        last = self.points[-1]
        state = (last.q, last.dq) if measured is None else measured
        return self.executor.step(self.time, values, self.time - age, state)

    def run_to_rest(self):
        while self.points[-1].dq.any() or self.points[-2].dq.any():
            self.run(0.05)

    def largest_gaps(self):
        """Largest differences of positions and velocities to the cubic through the neighbouring set points."""
        q, dq = (
            np.array([getattr(x, name) for x in self.points]) for name in ("q", "dq")
        )
        travel = (dq[1:] + dq[:-1]) / 2 * 0.01
        return np.abs(np.diff(q, axis=0) - travel).max()


@pytest.fixture(scope="module")
def shared():
    return ChunkExecutor("panda-3kg", **OPTIONS)


@pytest.fixture
def controller():
    return Controller(ChunkExecutor("panda-3kg", **OPTIONS))


def check_limits(points):
    """Check set points by the limits of the robot, and torques by Pinocchio."""
    robot = open_problem(record_problem(load_problem("panda-3kg")))[1]
    data = robot.model.createData()
    for x in points:
        assert (np.abs(x.dq) <= 1.002 * robot.velocity_limit).all()
        assert (np.abs(x.ddq) <= 1.005 * robot.acceleration_limit + 0.02).all()
        torque = pin.rnea(robot.model, data, x.q, x.dq, x.ddq)
        assert (np.abs(torque) <= 1.006 * robot.torque_limit).all()


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_chunks_join_without_a_jump_within_the_limits_and_end_at_rest(speed):
    control = Controller(ChunkExecutor("panda-3kg", **OPTIONS, speed=speed))
    executor, joins, progress = control.executor, [], 0.0
    for index in range(6):
        join = control.step(chunk(progress, offset=0.02, seed=index))
        assert join.accepted, join
        assert 0 < join.distance < 0.1
        assert join.end_time - join.time <= 1.2 * (LENGTH - 1) / RATE
        before, after = (
            executor._runtime.state_at(join.time - 100.01 + shift)
            for shift in (-1e-9, 1e-9)
        )
        for old, new, size in zip(before, after, (1e-8, 1e-7, 1e-5), strict=True):
            np.testing.assert_allclose(old, new, atol=size)
        joins.append(join)
        control.run(0.5)
        progress = executor._progress.at(executor._runtime.now)
    control.run_to_rest()
    assert control.time <= joins[-1].end_time + 0.1
    check_limits(control.points)
    assert control.largest_gaps() < 1e-4
    assert max(join.speed for join in joins) == pytest.approx(speed, rel=0.1)
    passed = np.array([x.q for x in control.points])
    expected = reference(np.linspace(0, progress + 2, 4000))
    assert max(np.abs(expected - q).max(axis=1).min() for q in passed) < 0.06


def test_the_executed_motion_is_valid_by_the_full_verdict_and_as_the_plan(controller):
    assert controller.step(chunk(0.0)).accepted
    runtime = controller.executor._runtime
    plan, since = runtime.plan_at(1.0)
    assert evaluate_plans(plan).valid.all()
    times = np.linspace(0.1, float(plan.duration[0]) - 0.01, 700)
    exact = plan.motion.at_times(times[None])
    served = runtime.state_at(1.0 - since + times)
    for name, size in (("q", 1e-8), ("dq", 1e-5), ("ddq", 2e-2)):
        np.testing.assert_allclose(
            getattr(served, name), getattr(exact, name)[0], atol=size
        )


def test_a_problem_that_bounds_jerks_is_executed_within_them():
    problem = load_problem("panda-3kg")
    limits = replace(problem.limits, jerk=PerJoint((300.0,) * 7))
    constraint = (*problem.constraint, JointJerk(tolerance=0.005))
    limited = replace(problem, limits=limits, constraint=constraint)
    control = Controller(ChunkExecutor(limited, **OPTIONS, speed=2.0))
    for index in range(4):
        progress = control.executor._progress.at(control.executor._runtime.now)
        assert control.step(chunk(progress, seed=index)).accepted
        plan = control.executor._runtime.plan_at(1e9)[0]
        verdict = evaluate_plans(plan).verdicts[0]
        assert verdict.valid
        assert any("jerk" in name for name in verdict.margins)
        control.run(0.5)


def outlier(values):
    values[20, 2] += 0.3


def far(values):
    values[:, :7] += 0.3


def beyond(values):
    values[:, 3] += np.linspace(0, 5, LENGTH)


def not_finite(values):
    values[7, 1] = np.nan


def no_gripper(values):
    values[7, 7] = np.inf


def jump(values):
    values[25:, 4] += 0.5


def into_itself(values):
    # The forearm folds onto the upper arm, slowly and within all joint limits.
    share = np.linspace(0, 1, LENGTH)[:, None]
    bend = 3 * share**2 - 2 * share**3
    values[:, :7] = HOME + bend * np.array([0, 0.8, 0, -0.6, 0, -0.9, 0])


@pytest.mark.parametrize(
    ("change", "outcome", "text"),
    [
        (outlier, SwitchOutcome.OUTLIER, "joint acceleration: at most -5"),
        (jump, SwitchOutcome.OUTLIER, "panda_joint5"),
        (beyond, SwitchOutcome.OUTLIER, "velocity"),
        (far, SwitchOutcome.FAR, "rad, expected at most 0.1"),
        (not_finite, SwitchOutcome.NOT_FINITE, ""),
        (no_gripper, SwitchOutcome.NOT_FINITE, ""),
        (into_itself, SwitchOutcome.INVALID, "collision with itself"),
    ],
)
def test_a_bad_chunk_is_refused_and_the_running_motion_continues(
    controller, change, outcome, text
):
    assert controller.step(chunk(0.0)).accepted
    controller.run(0.4)
    runtime = controller.executor._runtime
    times = np.linspace(runtime.now, runtime.end_time, 50)
    before = runtime.state_at(times)
    bad = chunk(0.4)
    change(bad)
    join = controller.step(bad)
    assert (join.outcome, join.accepted) == (outcome, False)
    assert text in join.detail
    for old, new in zip(before, runtime.state_at(times), strict=True):
        np.testing.assert_array_equal(old, new)
    assert controller.executor.stopped is None
    controller.run(0.1)
    assert controller.step(chunk(0.5)).accepted


def test_small_excesses_of_position_limits_are_clipped(controller):
    robot = open_problem(record_problem(load_problem("panda-3kg")))[1]
    low = robot.position_lower[3]  # of joint 4, -3.07
    near = np.array(HOME)
    near[3] = low + 0.03
    near[5] = 2.5
    control = Controller(ChunkExecutor("panda-3kg", **OPTIONS), near)
    values = np.tile(near, (LENGTH, 1))
    values[:, 3] -= 0.05 * np.sin(np.linspace(0, np.pi / 2, LENGTH)) ** 2
    join = control.step(values)
    if not join.accepted:  # folded links touch before the limit
        pytest.fail(str(join))
    control.run_to_rest()
    lowest = min(x.q[3] for x in control.points)
    assert low <= lowest < low + 0.02
    assert 0.02 < join.distance < 0.04


def late_chunk(control):
    return control.step(chunk(0.3), age=0.6)


def same_chunk(control):
    control.step(chunk(0.3))
    control.run(0.1)
    return control.step(chunk(0.3), age=0.1)


def older_chunk(control):
    control.step(chunk(0.3))
    control.run(0.1)
    return control.step(chunk(0.2), age=0.2)


def chunk_of_the_future(control):
    return control.step(chunk(0.3), age=-0.1)


def clock_back(control):
    control.step(chunk(0.3))
    control.time -= 0.2
    return control.step(chunk(0.35), age=0.05)


def clock_forwards(control):
    control.time += 3.0
    return control.step(chunk(0.3))


def frozen_arm(control):
    return control.step(chunk(0.3), measured=(HOME, np.zeros(7)))


def unknown_arm(control):
    return control.step(chunk(0.3), measured=(np.full(7, np.nan), np.zeros(7)))


def pushed_arm(control):
    q = control.points[-1].q
    return control.step(chunk(0.3), measured=(q, np.array([0, 0, 3.0, 0, 0, 0, 0])))


@pytest.mark.parametrize(
    ("event", "outcome"),
    [
        (late_chunk, SwitchOutcome.STALE),
        (same_chunk, SwitchOutcome.REPLAYED),
        (older_chunk, SwitchOutcome.REPLAYED),
        (chunk_of_the_future, SwitchOutcome.CLOCK),
        (clock_back, SwitchOutcome.CLOCK),
        (clock_forwards, SwitchOutcome.CLOCK),
        (frozen_arm, SwitchOutcome.TRACKING),
        (unknown_arm, SwitchOutcome.TRACKING),
        (pushed_arm, SwitchOutcome.TRACKING),
    ],
)
def test_a_fault_stops_the_arm_without_a_jump_until_reset(controller, event, outcome):
    assert controller.step(chunk(0.0)).accepted
    controller.run(0.8)
    end = controller.executor._runtime.end_time
    join = event(controller)
    assert (join.outcome, join.accepted) == (outcome, False)
    assert controller.executor.stopped is outcome
    with is_refused(UsageError):
        controller.executor.reset((controller.points[-1].q, np.zeros(7)))
    controller.run(0.1)
    assert controller.step(chunk(0.9)).outcome is outcome  # it is latched
    controller.run_to_rest()
    assert controller.executor._runtime.end_time < end
    assert controller.largest_gaps() < 1e-3
    resting = controller.points[-1].q
    controller.executor.reset((resting, np.zeros(7)))
    assert controller.executor.stopped is None
    controller.run(0.01)
    values = np.tile(np.append(resting, 0.5), (LENGTH, 1))
    assert controller.step(values).accepted


@pytest.mark.parametrize("jump", [-0.3, 5.0])
def test_a_step_of_the_clock_between_set_points_stops_without_a_jump(controller, jump):
    assert controller.step(chunk(0.0)).accepted
    controller.run(0.8)
    before = controller.points[-1]
    controller.time += jump
    controller.run(0.01)
    np.testing.assert_array_equal(controller.points[-1].q, before.q)
    assert controller.executor.stopped is SwitchOutcome.CLOCK
    while not controller.executor._runtime.stopped:  # in the background
        clock.sleep(0.001)
    controller.run_to_rest()
    assert controller.largest_gaps() < 5e-3
    assert not controller.step(chunk(1.0)).accepted


def test_a_new_executor_waits_for_reset(shared):
    fresh = ChunkExecutor("panda-3kg", **OPTIONS)
    assert fresh.stopped is SwitchOutcome.STOPPED
    for call in (
        lambda: fresh.set_point(0.0),
        fresh.stop,
        lambda: fresh.step(0.0, chunk(0.0), 0.0, (HOME, np.zeros(7))),
    ):
        with is_refused(UsageError):
            call()
    with is_refused(UsageError, argument="measured"):
        fresh.reset((HOME, [0, 0, 0.3, 0, 0, 0, 0]))
    with is_refused(UsageError, argument="measured"):
        fresh.reset((HOME, np.full(7, np.nan)))
    with is_refused(UsageError, argument="measured"):
        fresh.reset((np.degrees(HOME), np.zeros(7)))
    with is_refused(UsageError, argument="measured"):
        fresh.reset((np.full(7, np.nan), np.zeros(7)))
    assert shared.stopped is SwitchOutcome.STOPPED


def test_stop_holds_until_reset_and_reset_needs_a_stop(controller):
    with is_refused(UsageError):
        controller.executor.reset((HOME, np.zeros(7)))
    assert controller.step(chunk(0.0)).accepted
    controller.run(0.5)
    controller.executor.stop()
    assert controller.step(chunk(0.5)).outcome is SwitchOutcome.STOPPED
    controller.run_to_rest()
    controller.executor.reset((controller.points[-1].q, np.zeros(7)))
    assert controller.executor.stopped is None


def test_a_delay_skips_the_samples_that_are_due_before_the_join(controller):
    assert controller.step(chunk(0.0)).accepted
    controller.run(0.8)
    progress = controller.executor._progress.at(controller.executor._runtime.now - 0.2)
    join = controller.step(chunk(progress), age=0.2)
    assert join.accepted
    assert 0.25 <= join.skipped / RATE <= 0.25 + 1 / RATE
    assert join.distance < 5e-3  # the samples are those of the time
    assert join.time - controller.time == pytest.approx(
        join.skipped / RATE - 0.2, abs=5e-3
    )


def test_a_chunk_that_comes_too_late_is_refused_and_nothing_stops(controller):
    assert controller.step(chunk(0.0)).accepted
    controller.run(0.3)
    controller.time -= 0.1  # of a call that began earlier
    join = controller.step(chunk(0.3))
    assert join.outcome is SwitchOutcome.LATE
    assert controller.executor.stopped is None
    control = Controller(ChunkExecutor("panda-3kg", **OPTIONS | {"stale_after": 5.0}))
    assert control.step(chunk(0.0)).accepted
    control.run(1.5)
    join = control.step(chunk(0.0), age=1.45)
    assert join.outcome is SwitchOutcome.SHORT
    assert "expected at least 8" in join.detail


def test_stop_after_shortens_the_motion():
    for stop_after in (0.5, 1.0):
        options = ChunkOptions(stop_after=stop_after)
        control = Controller(ChunkExecutor("panda-3kg", **OPTIONS, options=options))
        join = control.step(chunk(0.0))
        assert join.accepted
        assert 0.8 * stop_after < join.end_time - join.time <= stop_after
        control.run_to_rest()
        check_limits(control.points)


def test_other_columns_are_retimed_by_the_same_map_and_never_lead():
    control = Controller(ChunkExecutor("panda-3kg", **OPTIONS, speed=2.0))
    assert control.points[0].others.shape == (0,)
    values = chunk(0.0)
    values[:, 7] = np.arange(LENGTH)  # the index of the sample
    assert control.step(values).accepted
    control.run_to_rest()
    served = [x for x in control.points if len(x.others)]
    index = np.array([x.others[0] for x in served]).astype(int)
    assert (np.diff(index) >= 0).all()
    assert index[-1] == LENGTH - 1
    assert (np.diff(index) > 1).any() or len(index) < LENGTH * 4
    # The joint that moves most has passed the sample that the gripper has.
    joint = int(AMPLITUDE.argmax())
    path = np.array([x.q[joint] for x in served])
    assert (path - values[index, joint]).min() > -6e-3
    ahead = values[np.minimum(index + 1, LENGTH - 1), joint]
    assert (path - ahead).max() < 6e-3


def test_wrong_options_and_shapes_are_refused(controller):
    for change, text in (
        ({"speed": 0.5}, "speed must be from 1 to 10"),
        ({"rate": 0.0}, "rate must be from 0.1 to 1000"),
        ({"join": -1.0}, "join must be from 0.001 to 60"),
        ({"length": 7}, "length"),
        ({"length": 10**6}, "length"),
        ({"stale_after": 1e9}, "stale_after must be from"),
        (
            {"tracking_error": [0.1, 0.2]},
            "tracking_error must be one positive number or 7",
        ),
        ({"tracking_error": 0.0}, "tracking_error"),
    ):
        with pytest.raises(UsageError, match=text):
            ChunkExecutor("panda-3kg", **OPTIONS | change)
    for options, text in (
        ({"stop_after": 0.1}, "stop_after must be at least 0.28 s"),
        ({"noise": 0.0}, "noise must be positive"),
    ):
        with pytest.raises(UsageError, match=text):
            ChunkExecutor("panda-3kg", **OPTIONS, options=ChunkOptions(**options))
    still = (HOME, np.zeros(7))
    for values, measured, text in (
        (np.zeros((49, 7)), still, r"chunk must have shape \(50, D\)"),
        (np.zeros((1, 50, 7)), still, r"chunk must have shape \(50, D\)"),
        (np.zeros((50, 6)), still, "at least 7 columns"),
        (chunk(0.0), (HOME[:3], np.zeros(7)), r"measured must be .* shape \(7,\)"),
    ):
        with pytest.raises(UsageError, match=text):
            controller.executor.step(controller.time, values, controller.time, measured)
    assert controller.step(chunk(0.0)).accepted
    controller.run(0.2)
    with is_refused(UsageError, argument="chunk"):
        controller.step(np.zeros((50, 9)))


def test_a_stop_during_a_step_refuses_its_chunk_after_the_next_reset(monkeypatch):
    executor = ChunkExecutor("panda-3kg", **{**OPTIONS, "join": 0.3})
    controller, motion = Controller(executor), executor._motions.motion

    def stopped_meanwhile(*arguments):
        executor.stop()
        controller.run(0.1)
        executor.reset((HOME, np.zeros(7)))
        return motion(*arguments)

    monkeypatch.setattr(executor._motions, "motion", stopped_meanwhile)
    join = controller.step(chunk(0.0))
    assert join.outcome is SwitchOutcome.STOPPED
    controller.run(1.0)
    np.testing.assert_array_equal(controller.points[-1].q, HOME)


def test_a_chunk_that_is_refused_does_not_fix_the_columns_and_large_values_are_outliers():
    executor = ChunkExecutor("panda-3kg", **OPTIONS)
    controller = Controller(executor)
    assert controller.step(np.full((LENGTH, 7), np.nan)).outcome is (
        SwitchOutcome.NOT_FINITE
    )
    controller.run(0.01)
    assert controller.step(1e300 * chunk(0.0)).outcome is SwitchOutcome.OUTLIER
    with is_refused(UsageError, argument="chunk"):
        controller.step(chunk(0.0)[:, :7])


@pytest.mark.parametrize(
    "wrong",
    [
        {"tracking_error": np.inf},
        {"tracking_error": True},
    ],
    ids=str,
)
def test_options_that_disable_a_check_are_refused(wrong):
    with pytest.raises(UsageError) as raised:
        ChunkExecutor("panda-3kg", **{**OPTIONS, **wrong})
    assert raised.value.argument in wrong


@pytest.mark.parametrize("wrong", [1e308, True, -1.0], ids=str)
def test_times_to_rest_that_disable_the_check_are_refused(wrong):
    with is_refused(UsageError, argument="stop_after"):
        ChunkOptions(stop_after=wrong)


@pytest.mark.parametrize("wrong", [-1.0, 0.0, np.inf, np.nan], ids=str)
def test_noise_that_disables_a_check_is_refused(wrong):
    with is_refused(UsageError, argument="noise"):
        ChunkOptions(noise=wrong)


def test_future_set_points_are_those_that_are_served_later():
    # The join is at none of the times.
    controller = Controller(ChunkExecutor("panda-3kg", **OPTIONS | {"join": 0.055}))
    values = chunk(0.0)
    assert controller.step(values).accepted
    values[:] = np.nan  # the caller may reuse the array
    times = controller.time + np.arange(1, 100) * 0.01
    planned = [controller.executor.state_at(time) for time in times]
    controller.run(0.99)
    for before, served in zip(planned, controller.points[-99:], strict=True):
        for a, b in zip(before, served, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)
    with is_refused(UsageError, argument="time"):
        controller.executor.state_at(times[-1] - 30.0)
    with is_refused(UsageError):
        ChunkExecutor("panda-3kg", **OPTIONS).state_at(0.0)


def test_measured_positions_outside_the_limits_are_refused():
    executor = ChunkExecutor("panda-3kg", **OPTIONS)
    with is_refused(UsageError, argument="measured"):
        executor.reset((HOME + 3.0, np.zeros(7)))
