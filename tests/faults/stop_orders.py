"""Random orders of stop, replan, switch, resume and close in threads: a stop holds, and its own integration is valid.

All choices follow from the seed and the number of the order. The order in which threads
come to run also depends on the load of the machine.
"""

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cnpgen.addons.online.motion_check import MotionChecker
from cnpgen.addons.online.plan_runtime import PlanRuntime
from cnpgen.addons.online.set_points import SetPoint, sample_motion
from cnpgen.addons.online.stops import earliest_stop
from cnpgen.addons.online.switches import Stop, Switch, SwitchOutcome
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.join import concatenate
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import ProblemRecord, open_problem, record_problem
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

PROBLEM = "heavy-object"
MODELS = ("heavy-object", "panda-cup", "panda-scenes", "ur5-wipe")  # of single stops
N_PLANS = 12
TICK_S = 2.5e-4  # the jerk jumps at the begin of a stop, within a step of integration
TORQUE_STRIDE = 40  # ticks between checked torques
KEPT_STOPS_SHARE = 0.2  # of runtimes that compute stops before they are needed
MAX_DELAY_S = 0.01  # of the start of a request, and of planning
LARGE_EVERY = 20  # every such order is of a shipped model, whose plans are judged
# The others follow short motions of an arm in joint space: threads meet as often there,
# and an order takes a tenth of the time.
SMALL_PROBLEM, N_LIMITS = "airhockey", 3  # limits of position, velocity, acceleration
SMALL_DURATION_S, SMALL_STEP_RAD, SMALL_GRID_S = 0.3, 0.05, 4e-3
SMALL_DELAY_S = 2e-3
MAX_WAIT_S = 120.0  # for a thread; a longer one hangs
REFUSED = (  # what a request of a random order may be told
    "the runtime is closed",
    "must not be before the last set point",
    "was not stopped",
    "the stop ends at",
)


def call_in_threads(
    call: Callable[[str, Callable[[], object], float], None],
    requests: Sequence[tuple[str, Callable[[], object]]],
    random: np.random.Generator,
    longest: float = MAX_DELAY_S,
) -> None:
    """Call each request, a kind and a function, in a thread of its own after a random delay [s]; wait for all."""
    delays = random.uniform(0.0, longest, len(requests))
    threads = [
        threading.Thread(target=call, args=(*request, delay))
        for request, delay in zip(requests, delays, strict=True)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(MAX_WAIT_S)
        assert not thread.is_alive(), "a request hangs"


@dataclass
class StopOutcome:
    """Outcomes of random orders and of single stops.

    Attributes:
        requests: Number of requests by kind and result.
        findings: Failures, one line each.
    """

    requests: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


def valid_plans(name: str, count: int = N_PLANS) -> tuple[Planner, list[Plans]]:
    """Return a planner of a shipped model, and plans of random problems that are valid."""
    planner = Planner(name)
    problems = draw_boundary_problems(name, count, seed=7)
    plans = planner.plan_batch(problems.boundary, columns=problems.columns)
    valid = np.flatnonzero(evaluate_plans(plans).valid)
    return planner, [plans[[row]] for row in valid]


def check_states(problem: ProblemRecord, times: Array, states: SetPoint) -> None:
    """Check states at equal time steps: own integration of their derivatives, limits, and torques of Pinocchio.

    Raises:
        AssertionError: The states are not the integrals of their derivatives, or exceed
            a limit.
    """
    robot = open_problem(problem)[1]
    q, dq, ddq = states
    step = np.diff(times)[:, None]
    # Integrals of a cubic through derivatives at both ends: errors of step^4.
    speed = dq[0] + np.cumsum((ddq[1:] + ddq[:-1]) / 2 * step, axis=0)
    travel = (dq[1:] + dq[:-1]) / 2 * step - (ddq[1:] - ddq[:-1]) / 12 * step**2
    np.testing.assert_allclose(speed, dq[1:], atol=2e-3)
    np.testing.assert_allclose(q[0] + np.cumsum(travel, axis=0), q[1:], atol=1e-6)
    assert (np.abs(dq) <= 1.002 * robot.velocity_limit).all(), "joint velocity"
    share = np.abs(ddq) / robot.acceleration_limit
    assert share.max() <= 1.005, f"acceleration {share.max():.6g} of the limit"
    if "payload_mass" not in robot.parameters.names:
        data = robot.model.createData()
        every = slice(None, None, TORQUE_STRIDE)
        for state in zip(q[every], dq[every], ddq[every], strict=True):
            torque = pin.rnea(robot.model, data, *state)
            assert (np.abs(torque) <= 1.006 * robot.torque_limit).all(), "joint torque"


@dataclass(frozen=True)
class OrderedArm:
    """An arm whose runtimes get random orders of requests.

    Attributes:
        runtime: Returns a runtime at rest at joint positions [rad], shape (n,); the
            second argument is whether it keeps stops.
        plans: Valid plans.
        plan: Returns a plan between two joint positions at rest.
        delay: Longest delay of a request [s].
    """

    runtime: Callable[[Array, bool], PlanRuntime]
    plans: list[Plans]
    plan: Callable[[Array, Array], Plans | None]
    delay: float = MAX_DELAY_S


def large_arm() -> OrderedArm:
    """Return the arm of a shipped model; its plans and stops are judged."""
    planner, plans = valid_plans(PROBLEM)

    def runtime(q: Array, keeps: bool) -> PlanRuntime:
        return PlanRuntime(planner, q, history=1e3, max_step=9.0, keep_stops=keeps)

    return OrderedArm(runtime, plans, planner.plan)


def small_arm() -> OrderedArm:
    """Return an arm in joint space with short motions from rest to rest, which are valid by their size."""
    problem = load_problem(SMALL_PROBLEM)
    record = record_problem(replace(problem, constraint=problem.constraint[:N_LIMITS]))
    home, spline = open_problem(record)[1].home, problem.trajectory
    # Smoothstep: six equal control points at each end, so that the arm rests there.
    x = np.clip(np.linspace(-0.5, 1.5, spline.path_control_points), 0.0, 1.0)[:, None]
    share = x**2 * (3 - 2 * x)

    def plan(start: Array, goal: Array) -> Plans:
        still = np.zeros((1, len(home)))
        boundary = Boundary(start[None], still, still, goal[None], still, still)
        path = (start + share * (goal - start))[None]
        rate = np.full((1, spline.rate_control_points), 1 / SMALL_DURATION_S)
        return make_plans(
            record, boundary, path_control_points=path, rate_control_points=rate
        )

    def runtime(q: Array, keeps: bool) -> PlanRuntime:
        return PlanRuntime(
            record,
            q,
            history=1e3,
            max_step=9.0,
            keep_stops=keeps,
            judge=False,
            grid_step=SMALL_GRID_S,
        )

    steps = SMALL_STEP_RAD * np.random.default_rng(7).uniform(
        -1, 1, (N_PLANS, len(home))
    )
    plans = [plan(home, home + step) for step in steps]
    assert evaluate_plans(concatenate(plans)).valid.all()
    return OrderedArm(runtime, plans, plan, SMALL_DELAY_S)


def run_orders(
    count: int,
    *,
    seed: int = 0,
    first: int = 0,
    large_every: int = LARGE_EVERY,
) -> StopOutcome:
    """Run random orders of requests.

    Args:
        count: Number of orders.
        seed: Seed of all choices.
        first: Number of the first order.
        large_every: Every such order is of a shipped model.
    """
    outcome = StopOutcome()
    small, large = small_arm(), large_arm()
    for number in range(first, first + count):
        arm = small if number % large_every else large
        try:
            _Order(arm, f"{seed} {number}", outcome.requests).run()
        except AssertionError as error:
            text = " ".join(str(error).split())[:300]
            outcome.findings.append(f"seed {seed}, order {number}: {text}")
            print(outcome.findings[-1], file=sys.stderr, flush=True)
    return outcome


class _Order:
    """One runtime and its requests, each in a thread."""

    def __init__(self, arm: OrderedArm, seed: str, requests: Counter[str]) -> None:
        self._random = np.random.default_rng([*seed.encode()])
        self._there = arm.plans[self._random.integers(len(arm.plans))]
        self._start = self._there.boundary.start_q[0]
        self._arm, self._requests = arm, requests
        keeps = self._random.random() < KEPT_STOPS_SHARE  # they take most time
        self._runtime = arm.runtime(self._start, keeps)
        self._served: list[tuple[float, SetPoint]] = []
        self._errors: list[str] = []

    def run(self) -> None:
        """Start all requests, stop, and check that nothing changes after that."""
        assert self._runtime.switch(self._there, 0.0).accepted
        requests = self._chosen_requests()
        call_in_threads(self._call, requests, self._random, self._arm.delay)
        assert not self._errors, self._errors[0]
        self._check(self._runtime.stop(self._runtime.end_time + 1.0))

    def _chosen_requests(self) -> list[tuple[str, Callable[[], object]]]:
        """Return requests in a random order, with their kinds."""
        random, runtime, end = self._random, self._runtime, self._runtime.end_time
        at = random.uniform(0.02, 1.2 * end, 8)
        moments = np.sort(random.uniform(0.0, 0.8 * end, 5))
        requests: list[tuple[str, Callable[[], object]]] = [
            ("replan", lambda: runtime.replan(self._make_plan, at[0])),
            ("replan", lambda: runtime.replan(self._make_plan, end + at[1])),
            ("switch", lambda: self._switch(at[2])),
            ("switch", lambda: self._switch(end + at[3])),
            ("stop", lambda: runtime.stop(at[4])),
            ("stop", lambda: runtime.stop(at[5])),
            ("set points", lambda: self._serve(moments)),
            ("resume", lambda: self._resume(at[6])),
            ("close", lambda: runtime.close(timeout=0.01)),
        ]
        kept = random.uniform(size=len(requests)) < 0.8
        chosen = [request for request, keep in zip(requests, kept, strict=True) if keep]
        return [chosen[index] for index in random.permutation(len(chosen))]

    def _call(self, kind: str, request: Callable[[], object], delay: float) -> None:
        """Make a request; the boundary of a thread, where errors become findings."""
        time.sleep(delay)
        try:
            result = request()
            name = result.outcome.name if isinstance(result, Switch) else "made"
        except UsageError as error:
            name = "refused"
            if not any(text in str(error) for text in REFUSED):
                self._errors.append(f"{kind}: {error}")
        except Exception as error:  # noqa: BLE001 - a foreign exception is a finding
            name = type(error).__name__
            self._errors.append(f"{kind}: {name} {error}")
        self._requests[f"{kind}, {name}"] += 1

    def _make_plan(self, state: SetPoint) -> Plans | None:
        """Plan a way back from rest, and a plan that jumps or none from a moving arm."""
        time.sleep(self._arm.delay * abs(float(np.sin(1e3 * state.q.sum()))))
        if not state.dq.any():
            return self._arm.plan(state.q, self._start)
        return self._there if state.q[0] > 0 else None

    def _switch(self, at: float) -> Switch:
        return self._runtime.switch(self._make_plan(self._runtime.state_at(at)), at)

    def _serve(self, moments: Array) -> None:
        """Serve set points, as a controller does, and keep them."""
        for moment in moments.tolist():
            self._served.append((moment, self._runtime.set_point(moment)))
            time.sleep(self._arm.delay / 10)

    def _resume(self, at: float) -> None:
        """Stop, and resume at the positions at the end of the stop, where the arm rests."""
        later = self._runtime.stop(at).end_time + 0.1
        self._runtime.resume(self._runtime.state_at(later).q, at=later)

    def _check(self, stop: Stop) -> None:
        """Check that the stop holds, that served set points are of its motion, and the motion itself."""
        runtime = self._runtime
        times = np.arange(0.0, stop.end_time + 0.1, TICK_S)
        before = runtime.state_at(times)
        check_states(self._there.problem, times, before)
        expected = {SwitchOutcome.STOPPED, SwitchOutcome.CLOSED}
        later = runtime.switch(self._there, stop.end_time + 0.5)
        assert later.outcome in expected, f"a switch was {later.outcome.name}"
        runtime.close(timeout=MAX_WAIT_S)
        for old, new in zip(before, runtime.state_at(times), strict=True):
            assert np.array_equal(old, new), "the motion changed after a stop"
        for moment, served in self._served:
            state = runtime.state_at(moment)
            step = np.abs(state.q - served.q).max()
            assert step < 1e-9, f"the set point at {moment} s was {step:g} rad away"


def stop_at_hard_moments(count: int, *, seed: int = 0) -> StopOutcome:
    """Stop valid motions of several models at random times: near their ends and where they are fast."""
    outcome, random = StopOutcome(), np.random.default_rng(seed)
    checker, n_of_each = MotionChecker(), -(-count // len(MODELS))
    for name in MODELS:
        plans = valid_plans(name)[1]
        for number in range(n_of_each):
            motion = sample_motion(plans[number % len(plans)], 0.0)
            left = random.uniform(0.0, 0.1) if number % 2 else random.uniform(0.0, 0.9)
            at = motion.end_time - min(left, motion.end_time)
            stop = earliest_stop(checker, motion, at, measured=True)
            outcome.requests[f"{name}, {'stop' if stop is not motion else 'end'}"] += 1
            try:
                assert stop.end_time <= motion.end_time, "later than not stopping"
                times = np.arange(at, stop.end_time, TICK_S)
                if len(times) > 1:
                    record = plans[number % len(plans)].problem
                    check_states(record, times, stop.at(times))
            except AssertionError as error:
                text = " ".join(str(error).split())[:200]
                outcome.findings.append(f"{name}, seed {seed}, {number}: {text}")
    return outcome
