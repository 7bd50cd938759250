"""Random orders of chunks, set points and stops of an executor in threads: after a stop, the motion never changes."""

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.online.chunk_executor import ChunkExecutor
from cnpgen.addons.online.switches import ChunkJoin
from cnpgen.errors import UsageError
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from tests.faults.stop_orders import (
    MAX_DELAY_S,
    MAX_WAIT_S,
    SMALL_DELAY_S,
    TICK_S,
    call_in_threads,
    check_states,
)
from tests.faults.stop_orders import StopOutcome as Outcome

Array = NDArray[np.float64]

PROBLEM = "airhockey"  # without its table: the arm follows chunks in joint space
N_LIMITS = 3  # constraints of position, velocity and acceleration
RATE_HZ, LENGTH = 30.0, 12
STALE_S = 0.5
SET_POINT_STEP_S = 0.02
MAX_FIRST_SET_POINTS = 14  # at most 70 % of a chunk
AMPLITUDE_RAD, FREQUENCY = 0.3, 1.2


class ChunkOrders:
    """One executor, which is reset before every order."""

    def __init__(self) -> None:
        problem = load_problem(PROBLEM)
        self._problem = replace(problem, constraint=problem.constraint[:N_LIMITS])
        self._executor = ChunkExecutor(
            self._problem,
            rate=RATE_HZ,
            length=LENGTH,
            join=0.02,
            max_distance=0.1,
            tracking_error=0.05,
            stale_after=STALE_S,
        )
        self._record = record_problem(self._problem)
        self._home = open_problem(self._record)[1].home
        self._time = 100.0
        self._errors: list[str] = []

    def run(self, seed: str, outcome: Outcome) -> None:
        """Run one order: a motion, then requests in threads, and a stop that must hold."""
        self._random = np.random.default_rng([*seed.encode()])
        self._requests, self._errors = outcome.requests, []
        still = np.zeros_like(self._home)
        self._executor.reset((self._home, still))
        self._serve(1)
        assert self._step(0.0).accepted, "the first chunk is refused"
        self._serve(int(self._random.integers(2, MAX_FIRST_SET_POINTS)))
        call_in_threads(
            self._call, self._chosen_requests(), self._random, SMALL_DELAY_S
        )
        assert not self._errors, self._errors[0]
        self._check()

    def _chosen_requests(self) -> list[tuple[str, Callable[[], object]]]:
        """Return requests in a random order, with their kinds."""
        shift = self._random.uniform(-0.02, 0.02, 3).tolist()
        requests: list[tuple[str, Callable[[], object]]] = [
            ("chunk", lambda: self._step(shift[0])),
            ("chunk", lambda: self._step(shift[1])),
            ("chunk", lambda: self._step(shift[2])),
            ("chunk, stop", self._executor.stop),
            ("chunk, stop", self._executor.stop),
            ("chunk, set points", lambda: self._serve(5)),
            ("chunk, reset", lambda: self._executor.reset((self._home, self._home))),
        ]
        order = self._random.permutation(len(requests))
        return [requests[index] for index in order if self._random.random() < 0.8]

    def _call(self, kind: str, request: Callable[[], object], delay: float) -> None:
        """Make a request; the boundary of a thread, where errors become findings."""
        time.sleep(delay)
        try:
            result = request()
            name = getattr(getattr(result, "outcome", None), "name", "made")
        except UsageError:
            name = "refused"
        except Exception as error:  # noqa: BLE001 - a foreign exception is a finding
            name = type(error).__name__
            self._errors.append(f"{kind}: {name} {error}")
        self._requests[f"{kind}, {name}"] += 1

    def _step(self, shift: float) -> ChunkJoin:
        """Send a chunk that swings from the next set point on."""
        self._serve(1)
        state = self._executor._runtime.state_at(self._executor._runtime.now)
        ahead = np.arange(LENGTH) / RATE_HZ
        swing = AMPLITUDE_RAD * (1 - np.cos(FREQUENCY * ahead))[:, None] / 2
        chunk = state.q + swing + shift
        return self._executor.step(self._time, chunk, self._time, (state.q, state.dq))

    def _serve(self, count: int) -> None:
        """Serve set points, as a controller does."""
        for _ in range(count):
            self._time += SET_POINT_STEP_S
            self._executor.set_point(self._time)

    def _check(self) -> None:
        """Stop, and check that no chunk changes the motion, and the motion itself."""
        executor, runtime = self._executor, self._executor._runtime
        executor.stop()
        deadline = time.monotonic() + MAX_WAIT_S
        while not runtime.stopped:  # a stop after a step of the clock is in a thread
            assert time.monotonic() < deadline, "a stop hangs"
            time.sleep(MAX_DELAY_S / 10)
        stop = runtime.stop(0.0)
        end = max(stop.end_time, runtime.now)
        times = np.arange(runtime.now, end + 0.05, TICK_S)
        before = runtime.state_at(times)
        assert not self._step(0.0).accepted, "a chunk was accepted after a stop"
        for old, new in zip(before, runtime.state_at(times), strict=True):
            assert np.array_equal(old, new), "the motion changed after a stop"
        check_states(self._record, times, before)
        while runtime.now < stop.end_time:
            self._serve(1)


def run_chunk_orders(count: int, *, seed: int = 0, first: int = 0) -> Outcome:
    """Run random orders of chunks; arguments as of ``run_orders``."""
    outcome, orders = Outcome(), ChunkOrders()
    for number in range(first, first + count):
        try:
            orders.run(f"{seed} {number} chunks", outcome)
        except (AssertionError, UsageError) as error:
            text = " ".join(str(error).split())[:300]
            outcome.findings.append(f"seed {seed}, chunk order {number}: {text}")
            print(outcome.findings[-1], file=sys.stderr, flush=True)
            orders = ChunkOrders()
    return outcome
