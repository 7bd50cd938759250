"""Execution of action chunks: motions that are within all limits, join without a jump, and end at rest."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.online.callers_clock import ROUNDING_S, CallersClock
from cnpgen.addons.online.chunk_checks import (
    MIN_CHUNK_SAMPLES,
    TIMES_S,
    ChunkChecks,
    ChunkOptions,
    bounded,
    check_rest,
    checked_errors,
    checked_state,
    horizon,
)
from cnpgen.addons.online.chunk_motions import ChunkMotion, ChunkMotions
from cnpgen.addons.online.chunk_progress import ChunkProgress
from cnpgen.addons.online.plan_runtime import PlanRuntime, positive
from cnpgen.addons.online.set_points import ChunkSetPoint
from cnpgen.addons.online.switches import ChunkJoin, SwitchOutcome
from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_record, open_problem
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer, number
from cnpgen.store.dataset_spec import StoredProblem

RATES_HZ = 0.1, 1000.0  # range of an option
MAX_CHUNK_SAMPLES = 1000
MAX_SPEED = 10.0
STOP_DELAY_S = 0.05  # of a stop after its cause: it is computed meanwhile
MAX_POSITION = 1e6  # rad or m, of a chunk
GRID_STEP_S = 4e-3  # of sampled motions, whose knots are 0.1 s apart
MAX_MEASURED_SPEED = 1.1  # fraction of the velocity limits


class ChunkExecutor:
    """Execution of the action chunks of a policy, for controllers that need a set point at any time.

    Every accepted chunk becomes one motion that continues the running one without a
    jump of position, velocity or acceleration, follows the chunk, and ends at rest. It
    is executed only if it is valid by the independent verdict up to its end. So the arm
    rests at most 1.2 chunk lengths after the last join if no other chunk is accepted.
    Times are those of one monotonic clock. A new executor waits for ``reset``.

    The columns of a chunk are the joints of the problem in their order [rad], then any
    others, such as a gripper's. These are held from the time at which the arm reaches
    their sample, so they never lead. Parameters of the problem are nominal.

    ``set_point`` may run in another thread than ``step``. Both must be called at least
    every ``stale_after``.

    Args:
        problem: Problem, record, or name or path of a problem: it has all limits.
        rate: Samples of a chunk per second [Hz].
        length: Number of samples of a chunk.
        join: Time from a call of ``step`` to the earliest join [s], at least the time
            that ``step`` takes. The join is at the next sample.
        max_distance: Largest distance of a motion from the samples of its raw chunk
            [rad], including the difference at the join; motions beyond are refused.
        tracking_error: Largest difference of measured positions from the set points
            [rad], one number or shape (n,). It includes the lag of the servos.
        stale_after: Largest age of an observation when its chunk arrives, and largest
            step of the clock between calls [s].
        speed: Largest speed along a chunk in units of its own timing, at least 1.
        options: Noise of chunks, and a shorter time to rest.

    Raises:
        UsageError: A number is not positive, the speed is below 1, the chunk has too
            few samples, or ``stop_after`` is too short for them.
        CnpgenError: The problem cannot be read, or a dependency is missing.
    """

    @checked_arguments
    @one_thread()
    def __init__(
        self,
        problem: Problem | StoredProblem | str | Path,
        *,
        rate: float,
        length: int,
        join: float,
        max_distance: float,
        tracking_error: float | ArrayLike,
        stale_after: float,
        speed: float = 1.0,
        options: ChunkOptions | None = None,
    ) -> None:
        self._record = as_record(problem)
        opened, self._robot = open_problem(self._record)
        self._rate = bounded("rate", rate, *RATES_HZ, "Hz")
        self._join = bounded("join", join, *TIMES_S, "s")
        self._length = integer(
            "length", length, least=MIN_CHUNK_SAMPLES, most=MAX_CHUNK_SAMPLES
        )
        self._max_distance = positive("max_distance", max_distance)
        self._stale_after = bounded("stale_after", stale_after, *TIMES_S, "s")
        self._tracking_error = checked_errors(tracking_error, self._robot.n)
        max_speed = bounded("speed", speed, 1.0, MAX_SPEED, "times the own one")
        options = options or ChunkOptions()
        self._horizon = horizon(options.stop_after, self._length, self._rate)
        self._checks = ChunkChecks(
            opened,
            self._robot,
            length=self._length,
            rate=self._rate,
            noise=options.noise,
        )
        self._motions = ChunkMotions(self._record, self._rate, max_speed)
        self._lengths = self._motions.prepare(self._lengths_left(max_speed))
        self._lock = threading.RLock()
        self._runtime: PlanRuntime | None = None
        self._latched: SwitchOutcome | None = SwitchOutcome.STOPPED
        self._clock = CallersClock(self._stale_after)
        self._observed = -np.inf  # time of the last observation

    def _lengths_left(self, max_speed: float) -> list[int]:
        """Return the numbers of samples that delays leave, one of each parametrization of motions."""
        # Samples that pass between the observation and the join, at the largest speed.
        delay = (self._stale_after + self._join) * max_speed
        skipped = min(int(delay * self._rate) + 1, self._length - MIN_CHUNK_SAMPLES)
        left = range(self._length - skipped, self._length + 1)
        # Samples beyond the horizon are not followed.
        return [min(samples, self._horizon) for samples in left]

    @property
    def stopped(self) -> SwitchOutcome | None:
        """The reason why the executor has stopped and waits for ``reset``; None while it accepts chunks."""
        return self._latched

    @checked_arguments
    def reset(self, measured: tuple[ArrayLike, ArrayLike]) -> None:
        """Accept chunks of later observations. The arm rests at its measured positions until one is accepted.

        Args:
            measured: Measured positions [rad] and velocities [rad/s], shape (n,) each,
                of an arm that is at rest.

        Raises:
            UsageError: The arm moves, or a stop has not ended.
        """
        q, dq = checked_state(measured, self._robot.n)
        names = self._record.joint_names
        check_rest(self._robot, names, (q, dq), self._tracking_error)
        with self._lock:
            if self._latched is None:
                raise UsageError("the executor has not stopped, so it cannot be reset")
            if self._runtime is None:
                self._runtime = self._start(q)
            else:
                left = self._runtime.end_time - self._runtime.now
                if left > 0:
                    raise UsageError(
                        f"the arm needs {left:.3g} s more of set points to stop"
                    )
                self._runtime.resume(q)
            # Observations before the reset show an arm that was moved since.
            self._observed = self._clock.last(self._runtime.now)
            self._latched = None

    @checked_arguments
    def stop(self) -> None:
        """Stop the arm on its path as early as possible, and refuse all chunks until ``reset``.

        Raises:
            UsageError: The executor was never reset.
        """
        self._checked_runtime()
        self._latch(SwitchOutcome.STOPPED)

    @checked_arguments
    def set_point(self, time: float) -> ChunkSetPoint:
        """Return the state to follow at a time [s]; see ``PlanRuntime.set_point``.

        If the clock steps backwards, or forwards by more than ``stale_after``, the arm
        stops, and its set points continue from the last one.

        Raises:
            UsageError: The executor was never reset.
        """
        runtime, inner = self._read_clock(number("time", time))
        state = runtime.set_point(inner)
        return ChunkSetPoint(*state, self._progress.others_at(inner))

    @checked_arguments
    def state_at(self, time: float) -> ChunkSetPoint:
        """Return the set point at a future time [s], which a later chunk may replace, or at one that has passed.

        Times more than ``2 stale_after`` before the last set point are refused.

        Raises:
            UsageError: The time is too early, or the executor was never reset.
        """
        runtime = self._checked_runtime()
        offset = self._clock.offset
        at = number("time", time)
        # Without a set point, the clocks have no common time: the arm rests at reset.
        inner = runtime.now if offset is None else at - offset
        return ChunkSetPoint(*runtime.state_at(inner), self._progress.others_at(inner))

    @checked_arguments
    @one_thread()
    def step(
        self,
        time: float,
        chunk: ArrayLike,
        observed_at: float,
        measured: tuple[ArrayLike, ArrayLike],
    ) -> ChunkJoin:
        """Join a chunk to the running motion, if that is valid and in time; else the running motion continues.

        A chunk that is stale or not newer than the last one, a step of the clock, and
        measured positions or velocities beyond their limits stop the arm. It then waits
        for ``reset``.

        Args:
            time: Present time [s].
            chunk: Samples of the joints and other columns, shape (length, D). Sample 0
                is due at ``observed_at``, the next ones at the speed of the arm.
            observed_at: Time of the observation from which the chunk was computed [s].
            measured: Measured positions [rad] and velocities [rad/s] at ``time``, shape
                (n,) each.

        Raises:
            UsageError: A shape is wrong, or the executor was never reset.
        """
        # A stop during this call refuses the chunk, also after the next reset.
        stops = None if self._runtime is None else self._runtime.stops
        q, others = self._checks.read(chunk)
        state = checked_state(measured, self._robot.n)
        now = number("time", time)
        observed = number("observed_at", observed_at)
        runtime, inner = self._read_clock(now, is_step=True)
        if self._latched is None:
            cause = self._age(now, observed) or self._mismatch(runtime, inner, state)
            # A refused observation counts as seen, so that it cannot be sent again.
            self._observed = max(observed, self._observed)
            if cause is not None:
                self._latch(cause)
        if self._latched is not None:
            return self._refusal(self._latched, inner)
        # Both clocks differ by a constant, so the age of the observation is kept.
        times = inner, inner - now + observed
        return self._join_chunk(runtime, q, others, times=times, stops=stops)

    def _join_chunk(
        self,
        runtime: PlanRuntime,
        q: Array,
        others: Array,
        *,
        times: tuple[float, float],
        stops: int | None,
    ) -> ChunkJoin:
        """Check a chunk, fit a motion to it and switch to it.

        ``times`` are those of the call and of the observation on the clock of the
        runtime, and ``stops`` the number of its stops before the call.
        """
        now, observed = times
        if not (np.isfinite(q).all() and np.isfinite(others).all()):
            return self._refusal(SwitchOutcome.NOT_FINITE, now)
        # The first finite chunk defines the number of columns.
        self._checks.keep_columns(q.shape[1] + others.shape[1])
        if (np.abs(q) > MAX_POSITION).any():
            detail = f"a position above {MAX_POSITION:g}"
            return self._refusal(SwitchOutcome.OUTLIER, now, detail)
        if detail := self._checks.refuted(q):
            return self._refusal(SwitchOutcome.OUTLIER, now, detail)
        at, skipped = self._progress.next_sample(observed, now + self._join, self._rate)
        if self._length - skipped < MIN_CHUNK_SAMPLES:
            detail = f"{max(self._length - skipped, 0)}, expected at least {MIN_CHUNK_SAMPLES}"
            return self._refusal(SwitchOutcome.SHORT, at, detail)
        # Samples that are due before the join have passed.
        used = slice(skipped, skipped + self._horizon)
        motion = self._motions.motion(q[used], others[used], runtime.state_at(at))
        distance = motion.distance
        join = ChunkJoin(SwitchOutcome.FAR, at, distance=distance, skipped=skipped)
        if distance <= self._max_distance:
            return self._switch(runtime, motion, join, stops)
        text = f"{distance:.3g} rad, expected at most {self._max_distance:g}"
        return self._in_callers_time(replace(join, detail=text))

    def _switch(
        self,
        runtime: PlanRuntime,
        motion: ChunkMotion,
        join: ChunkJoin,
        stops: int | None,
    ) -> ChunkJoin:
        """Switch to the fastest speed that is valid, or to the chunk's own timing."""
        # A grid decides the speed, the verdict decides its use: the chunk's own timing
        # is tried last.
        for index in dict.fromkeys((self._motions.fastest(motion), 0)):
            plan, speed = motion.at_speed(index)
            # The chunk is added before the switch, since its set points may be served
            # at once.
            executed = self._progress.executed(motion, plan, join.time)
            self._progress.add(executed)
            switch = runtime.switch(plan, join.time, stops=stops)
            if not switch.accepted:
                self._progress.remove(executed)
            join = replace(
                join, outcome=switch.outcome, detail=switch.detail, speed=speed
            )
            if switch.outcome is not SwitchOutcome.INVALID:
                break
        return self._in_callers_time(join)

    def _start(self, q: Array) -> PlanRuntime:
        """Start a runtime at rest.

        Motions that stand still, one of each parametrization, make the matrices of the
        verdict before the first chunk: later they would make a step eight times as long.
        """
        runtime = PlanRuntime(
            self._record,
            q,
            history=2 * self._stale_after + self._join,
            max_step=self._stale_after,
            keep_stops=False,
            grid_step=GRID_STEP_S,
        )
        self._progress = ChunkProgress(runtime)
        for length in self._lengths:
            # Only the parametrization matters here, so every chunk rests at the present
            # positions.
            samples = np.tile(q, (length, 1))
            still = self._motions.motion(samples, samples[:, :0], runtime.state_at(0.0))
            runtime.switch(still.at_speed(self._motions.fastest(still))[0], 0.0)
        return runtime

    def _read_clock(
        self, time: float, *, is_step: bool = False
    ) -> tuple[PlanRuntime, float]:
        """Return the runtime and its time at a time of the caller's clock [s]; the arm stops if the clock steps."""
        runtime = self._checked_runtime()
        inner, is_continuous = self._clock.read(time, runtime.now, is_step=is_step)
        if not is_continuous:
            self._latch(SwitchOutcome.CLOCK, in_background=not is_step)
        return runtime, inner

    def _checked_runtime(self) -> PlanRuntime:
        if self._runtime is None:
            raise UsageError("the executor waits for reset(measured)")
        return self._runtime

    def _latch(self, cause: SwitchOutcome, *, in_background: bool = False) -> None:
        """Stop the runtime and refuse chunks; the first cause is kept."""
        runtime = self._checked_runtime()
        # Two threads may find causes at once.
        with self._lock:
            if self._latched is not None:
                return
            self._latched = cause
        begin = runtime.now + STOP_DELAY_S
        if in_background:
            # A stop takes longer than a set point may.
            threading.Thread(target=runtime.stop, args=(begin,), daemon=True).start()
        else:
            runtime.stop(begin)

    def _age(self, now: float, observed: float) -> SwitchOutcome | None:
        """Return why the observation of a chunk is too old or not new; None if it is neither."""
        # An observation of the future belongs to another clock.
        if observed > now + ROUNDING_S:
            return SwitchOutcome.CLOCK
        if now - observed > self._stale_after:
            return SwitchOutcome.STALE
        is_new = observed > self._observed + ROUNDING_S
        return None if is_new else SwitchOutcome.REPLAYED

    def _mismatch(
        self, runtime: PlanRuntime, time: float, measured: tuple[Array, Array]
    ) -> SwitchOutcome | None:
        """Return TRACKING if a measured state is too far from the set point or too fast; None otherwise."""
        # The arm is compared with the set point of the same time.
        error = np.abs(measured[0] - runtime.state_at(time).q)
        speed = np.abs(measured[1]) / self._robot.velocity_limit
        follows = (error <= self._tracking_error) & (speed <= MAX_MEASURED_SPEED)
        # Nan does not follow.
        return None if follows.all() else SwitchOutcome.TRACKING

    def _refusal(
        self, outcome: SwitchOutcome, at: float, detail: str = ""
    ) -> ChunkJoin:
        return self._in_callers_time(ChunkJoin(outcome, at, detail))

    def _in_callers_time(self, join: ChunkJoin) -> ChunkJoin:
        """Return a result of the runtime with times of the caller's clock."""
        offset = self._clock.offset or 0.0
        end = self._checked_runtime().end_time + offset
        return replace(join, time=join.time + offset, end_time=end)
