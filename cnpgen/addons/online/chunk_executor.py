"""Execution of action chunks: motions that are within all limits, join without a jump, and end at rest."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.addons.online.chunk_checks import ChunkChecks
from cnpgen.addons.online.chunk_fit import ChunkFit, chunk_fit
from cnpgen.addons.online.chunk_progress import ChunkProgress, ExecutedChunk
from cnpgen.addons.online.chunk_speeds import ChunkSpeeds
from cnpgen.addons.online.plan_runtime import PlanRuntime, positive
from cnpgen.addons.online.set_points import SetPoint
from cnpgen.addons.online.switches import ChunkJoin, SwitchOutcome
from cnpgen.errors import UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_record, open_problem
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer, number, numbers
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.trajectory.spline import basis
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

MIN_SAMPLES = 8  # of a chunk after the join: fewer have no reliable velocity
MAX_DURATION = 1.2  # of a motion, in chunk lengths
NOISE_RAD = 1e-3
STOP_DELAY_S = 0.05  # of a stop after its cause: it is computed meanwhile
GRID_STEP_S = 4e-3  # of sampled motions, whose knots are 0.1 s apart
MAX_MEASURED_SPEED = 1.1  # fraction of the velocity limits
MAX_RESTING_SPEED = 0.05  # fraction of the velocity limits, of an arm that is at rest
CLOCK_ROUNDING_S = 1e-9


class ChunkSetPoint(NamedTuple):
    """Positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (n,), and the other columns, (D - n,)."""

    q: Array
    dq: Array
    ddq: Array
    others: Array


@dataclass(frozen=True)
class _Candidate:
    """A motion of a chunk in its own timing, with its fit and faster rates.

    Attributes:
        fit: Matrices of the fit.
        plan: The motion.
        rates: Rate control points of all speeds [1/s], shape (M, R).
        distance: Largest distance from the raw samples [rad].
        others: Other columns from the join on, shape (K, D - n).
    """

    fit: ChunkFit
    plan: Plans
    rates: Array
    distance: float
    others: Array


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
        noise: Largest random error of a chunk's positions [rad]. A chunk is refused if
            no motion within it meets the limits of velocities, accelerations and jerks.
        stop_after: Time after a join at which the arm rests at the latest without
            another chunk [s]; by default 1.2 chunk lengths. Later samples are not used.

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
        noise: float = NOISE_RAD,
        stop_after: float | None = None,
    ) -> None:
        self._record = as_record(problem)
        opened, self._robot = open_problem(self._record)
        self._rate, self._join = positive("rate", rate), positive("join", join)
        self._length = integer("length", length, least=MIN_SAMPLES)
        self._max_distance = positive("max_distance", max_distance)
        self._stale_after = positive("stale_after", stale_after)
        self._tracking_error = _checked_error(tracking_error, self._robot.n)
        if (max_speed := number("speed", speed)) < 1:
            raise UsageError(f"must be at least 1, got {speed:g}", argument="speed")
        self._horizon = _horizon(stop_after, self._length, self._rate)
        self._checks = ChunkChecks(
            opened,
            self._robot,
            length=self._length,
            rate=self._rate,
            noise=positive("noise", noise),
        )
        self._speeds = ChunkSpeeds(self._record, max_speed)
        self._lock = threading.RLock()
        self._runtime: PlanRuntime | None = None
        self._latched: SwitchOutcome | None = SwitchOutcome.STOPPED
        self._offset: float | None = None  # of the caller's clock to the runtime's
        self._observed = self._stepped = -np.inf  # last observation and step
        self._prepare()

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
        q, dq = self._checked_state(measured)
        if (
            moving := np.abs(dq) > MAX_RESTING_SPEED * self._robot.velocity_limit
        ).any():
            joint = self._record.joint_names[int(moving.argmax())]
            raise UsageError(
                f"the arm must be at rest, but {joint} moves at {dq[moving][0]:.3g} rad/s",
                concerns="measured",
            )
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
            if self._offset is not None:
                self._observed = max(self._stepped, self._runtime.now + self._offset)
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
        q, others = self._checks.read(chunk)
        state = self._checked_state(measured)
        now = number("time", time)
        observed = number("observed_at", observed_at)
        runtime, inner = self._read_clock(now, is_step=True)
        if self._latched is None:
            cause = self._age(now, observed) or self._mismatch(runtime, inner, state)
            self._observed = max(observed, self._observed)
            if cause is not None:
                self._latch(cause)
        if self._latched is not None:
            return self._result(self._latched, inner)
        return self._join_chunk(runtime, inner, q, others, inner - now + observed)

    def _join_chunk(
        self, runtime: PlanRuntime, now: float, q: Array, others: Array, observed: float
    ) -> ChunkJoin:
        """Check a chunk, fit a motion to it and switch to it; times are those of the runtime."""
        if not (np.isfinite(q).all() and np.isfinite(others).all()):
            return self._result(SwitchOutcome.NOT_FINITE, now)
        if detail := self._checks.refuted(q):
            return self._result(SwitchOutcome.OUTLIER, now, detail)
        at, skipped = self._progress.next_sample(observed, now + self._join, self._rate)
        if self._length - skipped < MIN_SAMPLES:
            detail = (
                f"{max(self._length - skipped, 0)}, expected at least {MIN_SAMPLES}"
            )
            return self._result(SwitchOutcome.SHORT, at, detail)
        used = slice(skipped, skipped + self._horizon)
        motion = self._candidate(q[used], others[used], runtime.state_at(at))
        found = {"distance": motion.distance, "skipped": skipped}
        if motion.distance > self._max_distance:
            detail = (
                f"{motion.distance:.3g} rad, expected at most {self._max_distance:g}"
            )
            return self._result(SwitchOutcome.FAR, at, detail, **found)
        return self._switch(runtime, motion, at, found)

    def _candidate(self, q: Array, others: Array, state: SetPoint) -> _Candidate:
        """Fit a motion from a state of the running one to the samples after the join, in their own timing."""
        fit = chunk_fit(len(q), self._rate)
        inside = self._checks.clipped(q)
        speeds = self._speeds.speeds
        running = fit.running_speed(inside, state, float(speeds[-1]))
        rates = fit.rate(running, speeds)
        samples = fit.blended(inside, state, running)
        boundary, path = fit.fit(samples, state, rates[0])
        if len(self._record.parameters):
            nominal = self._robot.nominal_parameters[None]
            boundary = replace(boundary, parameters=nominal)
        plan = make_plans(
            self._record,
            boundary,
            path_control_points=path[None],
            rate_control_points=rates[:1],
            degree=fit.spec.degree,
            source="action chunk",
        )
        reached = basis(fit.phases, len(path), fit.spec.degree) @ path
        return _Candidate(fit, plan, rates, float(np.abs(reached - q).max()), others)

    def _switch(
        self,
        runtime: PlanRuntime,
        motion: _Candidate,
        at: float,
        found: dict[str, float],
    ) -> ChunkJoin:
        """Switch to the fastest speed that is valid, or to the chunk's own timing."""
        fit, rates = motion.fit, motion.rates
        fastest = 0
        if len(rates) > 1:
            paths = np.repeat(motion.plan.path_control_points, len(rates), axis=0)
            motions = Motion(paths, rates, fit.spec.degree)
            fastest = self._speeds.fastest(motions, motion.plan.scene.poses)
        for index in dict.fromkeys((fastest, 0)):
            plan = replace(motion.plan, rate_control_points=rates[index : index + 1])
            s = np.linspace(0, 1, len(fit.times))
            executed = ExecutedChunk(
                plan,
                at,
                self._progress.at(at),
                plan.motion.time_at(s)[0],
                fit.times,
                motion.others,
                fit.step,
            )
            self._progress.add(executed)
            switch = runtime.switch(plan, at)
            if not switch.accepted:
                self._progress.remove(executed)
            if switch.outcome is not SwitchOutcome.INVALID:
                break
        speed = float(rates[index].max()) * fit.duration
        return self._result(switch.outcome, at, switch.detail, **found, speed=speed)

    def _prepare(self) -> None:
        """Compute the matrices of all lengths that delays leave."""
        delay = (self._stale_after + self._join) * float(self._speeds.speeds[-1])
        for skipped in range(int(delay * self._rate) + 2):
            length = min(self._length - skipped, self._horizon)
            if length >= MIN_SAMPLES:
                self._speeds.grid(chunk_fit(length, self._rate).spec)

    def _start(self, q: Array) -> PlanRuntime:
        """Start a runtime at rest; a motion that stands still loads the judge before the first chunk."""
        runtime = PlanRuntime(
            self._record,
            q,
            history=2 * self._stale_after + self._join,
            max_step=self._stale_after,
            keep_stops=False,
            grid_step=GRID_STEP_S,
        )
        self._progress = ChunkProgress(runtime)
        samples = np.tile(q, (self._horizon, 1))
        still = self._candidate(samples, samples[:, :0], runtime.state_at(0.0))
        self._speeds.fastest(still.plan.motion, still.plan.scene.poses)
        runtime.switch(still.plan, 0.0)
        return runtime

    def _read_clock(
        self, time: float, *, is_step: bool = False
    ) -> tuple[PlanRuntime, float]:
        """Return the runtime and its time at a time of the caller's clock [s].

        After a step of the clock its time continues from the last set point, and the
        arm stops.
        """
        runtime = self._checked_runtime()
        with self._lock:
            if self._offset is None:
                self._offset = time - runtime.now
            inner = time - self._offset
            # Another thread may have served set points since the time of a step.
            earliest = runtime.now - (self._stale_after if is_step else 0.0)
            stepped_back = is_step and time < self._stepped
            self._stepped = time if is_step else self._stepped
            ahead = inner - runtime.now > self._stale_after
            if inner >= earliest - CLOCK_ROUNDING_S and not (stepped_back or ahead):
                return runtime, inner if is_step else max(inner, runtime.now)
            self._offset = time - runtime.now
        self._latch(SwitchOutcome.CLOCK, in_background=not is_step)
        return runtime, runtime.now

    def _checked_runtime(self) -> PlanRuntime:
        if self._runtime is None:
            raise UsageError("the executor waits for reset(measured)")
        return self._runtime

    def _latch(self, cause: SwitchOutcome, *, in_background: bool = False) -> None:
        """Stop the runtime and refuse chunks; the first cause is kept."""
        runtime = self._checked_runtime()
        with self._lock:
            if self._latched is not None:
                return
            self._latched = cause
        begin = runtime.now + STOP_DELAY_S
        if in_background:  # a stop takes longer than a set point may
            threading.Thread(target=runtime.stop, args=(begin,), daemon=True).start()
        else:
            runtime.stop(begin)

    def _age(self, now: float, observed: float) -> SwitchOutcome | None:
        """Return why the observation of a chunk is too old or not new; None if it is neither."""
        if observed > now + CLOCK_ROUNDING_S:
            return SwitchOutcome.CLOCK
        if now - observed > self._stale_after:
            return SwitchOutcome.STALE
        return SwitchOutcome.REPLAYED if observed <= self._observed else None

    def _mismatch(
        self, runtime: PlanRuntime, time: float, measured: tuple[Array, Array]
    ) -> SwitchOutcome | None:
        """Return TRACKING if a measured state is too far from the set point or too fast; None otherwise."""
        q, dq = measured
        error = np.abs(q - runtime.state_at(time).q)
        follows = (error <= self._tracking_error).all()  # nan does not follow
        fastest = MAX_MEASURED_SPEED * self._robot.velocity_limit
        return (
            None
            if follows and (np.abs(dq) <= fastest).all()
            else SwitchOutcome.TRACKING
        )

    def _checked_state(
        self, measured: tuple[ArrayLike, ArrayLike]
    ) -> tuple[Array, Array]:
        """Return measured positions and velocities, shape (n,) each; they may be nan."""
        n = self._robot.n
        state = [numbers("measured", values) for values in measured]
        if [values.shape for values in state] != [(n,), (n,)]:
            raise UsageError(
                f"must be positions and velocities of shape ({n},),"
                f" got {[values.shape for values in state]}",
                argument="measured",
            )
        return state[0], state[1]

    def _result(
        self, outcome: SwitchOutcome, at: float, detail: str = "", **found: float
    ) -> ChunkJoin:
        """Return the result of a step at a time of the runtime, in the caller's time."""
        runtime, offset = self._checked_runtime(), self._offset or 0.0
        return ChunkJoin(
            outcome,
            at + offset,
            detail,
            end_time=runtime.end_time + offset,
            **found,  # type: ignore[arg-type]
        )


def _checked_error(tracking_error: ArrayLike, n: int) -> Array:
    """Return positive tracking errors, shape (n,)."""
    errors = numbers("tracking_error", tracking_error)
    if errors.shape not in {(), (n,)} or not (errors > 0).all():
        raise UsageError(
            f"must be one positive number or {n} of them, got {tracking_error!r:.100}",
            argument="tracking_error",
        )
    return np.broadcast_to(errors, (n,))


def _horizon(stop_after: float | None, length: int, rate: float) -> int:
    """Return the number of samples that a motion follows, so that it rests after a time [s]."""
    if stop_after is None:
        return length
    samples = int(stop_after / MAX_DURATION * rate + CLOCK_ROUNDING_S) + 1
    if samples < MIN_SAMPLES:
        least = MAX_DURATION * (MIN_SAMPLES - 1) / rate
        raise UsageError(
            f"must be at least {least:.3g} s, the time of {MIN_SAMPLES} samples,"
            f" got {stop_after:g}",
            argument="stop_after",
        )
    return min(samples, length)
