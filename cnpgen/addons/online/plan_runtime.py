"""Execution of plans in time: set-points, replanning in the background, switches without a jump, and safe stops."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.online.kept_stops import KeptStops
from cnpgen.addons.online.motion_check import MotionChecker
from cnpgen.addons.online.plan_admission import Admission, Executable, plan_of_request
from cnpgen.addons.online.replan_requests import ReplanRequests
from cnpgen.addons.online.set_points import (
    GRID_STEPS_S,
    MAX_GRID_STEP_S,
    PlanOrSequence,
    SampledMotion,
    SetPoint,
    at_rest,
)
from cnpgen.addons.online.stops import earliest_stop
from cnpgen.addons.online.switches import Stop, Switch, SwitchOutcome
from cnpgen.addons.online.timeline import Timeline
from cnpgen.arrays import Array
from cnpgen.errors import CnpgenError, UsageError
from cnpgen.planner.planner import Planner
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, as_record, open_problem
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import (
    check_range,
    concerning,
    distinct,
    number,
    numbers,
)
from cnpgen.store.dataset_spec import StoredProblem

PlanFunction = Callable[[SetPoint], Executable | None]
"""A function of the state at the switch that returns one plan, sequence or hit from there, or None."""

HISTORY_S = 1.0  # for which ``state_at`` returns the executed motion
MAX_SET_POINT_STEP_S = 0.1  # a joint moves no further from one set point to the next than at its velocity limit in this time
CLOSING_TIME_S = 2.0  # for which ``close`` waits for a planner
MAX_LATE_STOPS = 3  # of computed stops whose begin has passed meanwhile
STOP_LEAD_S = 0.02  # of the next one
REPORT_SAMPLES = 500  # of the distance that a stop travels


class PlanRuntime:
    """A plan in execution, for controllers that need a set-point at any time.

    The runtime executes only motions that are valid and end at rest: single plans to
    rest, or sequences such as a hit and its way back. If no valid plan arrives in time,
    the motion in execution continues to its end and the arm rests there. Times are
    those of the caller's clock, which must be monotonic.

    Plans of models that leave goal accelerations free end with a step of acceleration.
    The runtime slows down the end of such a motion on its path, so that the
    acceleration falls to zero; ``Switch.detail`` states the additional time.

    ``set_point`` costs microseconds and may run in another thread than planning.

    Args:
        planner: Plans are of its robot; its problem defines the limits. Or the problem,
            its record, name or path, for plans of other sources.
        q: Joint positions of the arm, which is at rest [rad], shape (n,).
        time: Start time [s].
        judge: Whether to check every plan and stop by the independent verdict, which
            takes a few milliseconds.
        parameters: Parameters of the problem, such as the mass of the load, which all
            plans have, shape (width,); nominal by default.
        history: Time for which ``state_at`` returns the executed motion [s].
        max_step: Largest step from one set point to the next: that of each joint at its
            velocity limit in this time [s].
        keep_stops: Whether stops are computed in the background before they are needed,
            which may take all of a processor core after a switch.
        grid_step: Largest step of the grid on which motions are sampled [s]. Steps of
            1 ms suit time-optimal motions; slower ones may have steps of at most 4 ms.

    Raises:
        UsageError: The positions have another shape or are not finite, or a parameter
            is outside its range.
    """

    @checked_arguments
    def __init__(
        self,
        planner: Planner | Problem | StoredProblem | str | Path,
        q: ArrayLike,
        *,
        time: float = 0.0,
        judge: bool = True,
        parameters: ArrayLike | None = None,
        history: float = HISTORY_S,
        max_step: float = MAX_SET_POINT_STEP_S,
        keep_stops: bool = True,
        grid_step: float = MAX_GRID_STEP_S,
    ) -> None:
        record = _record_of(planner)
        self._robot = robot = open_problem(record)[1]
        check_range("grid_step", number("grid_step", grid_step), *GRID_STEPS_S, "s")
        self._judge = judge
        self._checker = MotionChecker()
        self._admission = Admission(
            record,
            parameters,
            judge=judge,
            checker=self._checker,
            grid_step=grid_step,
        )
        self._timeline = Timeline(
            at_rest(_checked_positions("q", q, robot.n), number("time", time)),
            history=positive("history", history),
            max_step=positive("max_step", max_step) * robot.velocity_limit,
        )
        self._lock = threading.RLock()
        # Held while a stop is computed, so that no ``resume`` comes in between, and a
        # second ``stop`` returns the finished result.
        self._stopping = threading.RLock()
        self._kept_stops = KeptStops(self._checker, measured=judge)
        self._keeps_stops = keep_stops
        self._requests = ReplanRequests()
        self._stop: Stop | None = None  # until the runtime is resumed
        self._stops = 0
        self._closed = False

    def __enter__(self) -> PlanRuntime:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @checked_arguments
    def close(self, *, timeout: float = CLOSING_TIME_S) -> bool:
        """Refuse all further plans, and wait for planning in the background to end.

        The motion in execution continues to its end.

        Args:
            timeout: Maximum time to wait [s].

        Returns:
            Whether planning has ended. A planner that hangs is left in a daemon thread.
        """
        with self._lock:
            self._closed = True
        self._kept_stops.follow(None)
        return self._requests.close(positive("timeout", timeout))

    @property
    def end_time(self) -> float:
        """Time from which on the arm is at rest, if no other plan follows [s]."""
        return self._timeline.end_time

    @property
    def now(self) -> float:
        """Last time of a set point [s]; the start time before the first one."""
        return self._timeline.now

    @property
    def stops(self) -> int:
        """Number of stops and resumptions so far; see ``switch``."""
        return self._stops

    @property
    def stopped(self) -> bool:
        """Whether a stop was accepted and the runtime has not been resumed."""
        return self._stop is not None

    @checked_arguments
    def set_point(self, time: ArrayLike) -> SetPoint:
        """Return the state to follow, and exclude switches before it.

        Args:
            time: Time [s], one number or ascending times of shape (K,), not before the
                last one of the previous call.

        Returns:
            State of shape (n,), or (K, n).

        Raises:
            UsageError: The times do not ascend, or a joint would step further than
                ``max_step`` allows. Nothing changes then.
        """
        times = _checked_times(time)
        with self._lock:
            return self._timeline.serve(times)

    @checked_arguments
    def state_at(self, time: ArrayLike) -> SetPoint:
        """Return the state at a future time, from which a new plan may start, or at a past one.

        Args:
            time: Time [s], one number or ascending times of shape (K,), at most
                ``history`` before the last time of ``set_point``.
        """
        times = _checked_times(time)
        with self._lock:
            return self._timeline.state_at(times)

    @checked_arguments
    def plan_at(self, time: float) -> tuple[PlanOrSequence | None, float]:
        """Return the plan whose path is followed at a time [s], and the time since its start at which it is there [s].

        They differ from those of the plan while the arm stops. At rest it is None.
        """
        found = number("time", time)
        with self._lock:
            part = self._timeline.part_at(found)
        return part.plan, float(np.interp(found, part.edges, part.plan_times))

    @checked_arguments
    def switch(
        self, plan: Executable | None, at: float, *, stops: int | None = None
    ) -> Switch:
        """Switch to a plan at a time, if it is valid, ends at rest and arrives in time.

        A motion that was accepted for a later time is replaced, and ``Switch.detail``
        says so.

        Args:
            plan: One plan, one sequence, or one hit of ``plan_hits``, from
                ``state_at(at)`` to rest; None is refused.
            at: Switch time [s], not before the last time of ``set_point``.
            stops: ``stops`` when the plan was requested: a stop or a resumption since
                then refuses it. By default only one during this call does.

        Raises:
            UsageError: There are several plans, or they are of another robot.
        """
        before = self._stops if stops is None else stops
        return self._switch(plan, number("at", at), before)

    @checked_arguments
    def replan(self, make_plan: PlanFunction, at: float) -> Future[Switch]:
        """Plan in the background and switch if the plan arrives in time.

        Requests are served one after the other. The motion in execution continues if a
        request is refused. A stop refuses all requests made before it.

        Args:
            make_plan: Called in the background with the state at the switch.
            at: Switch time [s].

        Returns:
            Future of the result; errors of ``make_plan`` are results, too.

        Raises:
            UsageError: The runtime is closed.
        """
        at = number("at", at)
        stops = self._stops
        return self._requests.submit(lambda: self._replan(make_plan, at, stops), at)

    @checked_arguments
    def stop(self, at: float) -> Stop:
        """Stop as early as possible from a time on, and refuse all plans until ``resume``.

        The arm stops on the path of the motion in execution, so that no obstacle is
        touched. If its path is shorter than a stop, the motion continues to its end. If
        the time has passed when the stop is computed, one that was computed before is
        used, which begins at most 0.1 s later.

        Args:
            at: Time at which the stop begins [s].

        Returns:
            Begin and end of the stop and the distance that each joint travels.
        """
        at = number("at", at)
        with self._stopping:
            with self._lock:
                # Refuses all plans of earlier requests.
                self._stops += 1
                # A second stop returns the result of the first one.
                if self._stop is not None:
                    return self._stop
                begin = max(at, self._timeline.now)
                # Plans are refused from here on, also while the stop is computed.
                self._stop = _report(self._timeline.part_at(begin), begin)
                dropped = self._timeline.drop_after(begin)
            self._requests.refuse_waiting(SwitchOutcome.STOPPED)
            return self._stop_on_path(begin, dropped)

    @checked_arguments
    def resume(self, measured_q: ArrayLike, *, at: float | None = None) -> None:
        """Accept plans again after a stop. The arm rests at its measured positions until a plan follows.

        Args:
            measured_q: Joint positions of the arm, which is at rest [rad], shape (n,).
            at: Time from which on they are the set points [s], not before the end of
                the stop; by default the last time of ``set_point``.

        Raises:
            UsageError: The runtime was not stopped, or the stop has not ended.
        """
        q = _checked_positions("measured_q", measured_q, self._robot.n)
        with self._stopping, self._lock:
            time = self._timeline.now if at is None else number("at", at)
            if self._stop is None:
                raise UsageError("the runtime was not stopped, so it cannot resume")
            if time < self._timeline.end_time or time < self._timeline.now:
                raise UsageError(
                    f"the stop ends at {self._timeline.end_time:.6g} s, and {time:.6g} s"
                    " is before that or before the last set point",
                    concerns="at",
                )
            self._timeline.restart(at_rest(q, time))
            self._stop = None
            self._stops += 1

    def _stop_on_path(self, begin: float, dropped: list[float]) -> Stop:
        """Compute a stop and follow it, or a kept one if it comes too late."""
        # The begin of a stop may pass while the stop is computed.
        for _ in range(MAX_LATE_STOPS):
            motion = self._timeline.part_at(begin)
            with self._kept_stops.paused():
                stop = earliest_stop(self._checker, motion, begin, measured=self._judge)
            with self._lock:
                now = self._timeline.now
                # Set points after the begin have been served, so only a later stop can
                # be used.
                if now > begin:
                    kept = self._kept_stops.after(motion, now)
                    if kept is None:
                        begin = now + STOP_LEAD_S
                        continue
                    begin, stop = kept
                self._timeline.replace_last(stop)
                break
        self._kept_stops.follow(None)
        with self._lock:
            motion = self._timeline.part_at(begin)
            self._stop = _report(motion, begin, _replaced(dropped))
            return self._stop

    def _switch(self, plan: Executable | None, at: float, stops: int) -> Switch:
        """Switch to a plan that was requested after a number of stops and resumptions."""
        plan, reason = plan_of_request(plan)
        if plan is None:
            return Switch(SwitchOutcome.NO_PLAN, at, reason)
        if refusal := self._refusal(at, stops):
            return Switch(refusal, at)
        motion, detail = self._admission.refusal_or_motion(plan, at)
        if isinstance(motion, SwitchOutcome):
            return Switch(motion, at, detail)
        with self._lock:
            # The clock and the stops may have changed while the plan was judged.
            if refusal := self._refusal(at, stops):
                return Switch(refusal, at)
            # The state at the switch is that of the motion in execution now.
            before = self._timeline.state_at(np.array(at))
            if jump := self._admission.jump(before, motion):
                return Switch(SwitchOutcome.JUMP, at, jump)
            replaced = _replaced(self._timeline.append(motion))
            self._kept_stops.follow(motion if self._keeps_stops else None)
        detail = "; ".join(filter(None, (detail, replaced)))
        return Switch(SwitchOutcome.ACCEPTED, at, detail)

    def _refusal(self, at: float, stops: int) -> SwitchOutcome | None:
        """Return the reason for which no plan is accepted for a time, None if there is none."""
        with self._lock:
            if self._closed:
                return SwitchOutcome.CLOSED
            if self._stop is not None or stops != self._stops:
                return SwitchOutcome.STOPPED
            return SwitchOutcome.LATE if at < self._timeline.now else None

    def _replan(self, make_plan: PlanFunction, at: float, stops: int) -> Switch:
        """Plan and switch; the boundary of the background thread, where errors become results."""
        try:
            if refusal := self._refusal(at, stops):
                return Switch(refusal, at)
            return self._switch(make_plan(self.state_at(at)), at, stops)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - errors of the caller's function are results
            kind = "" if isinstance(error, CnpgenError) else f"{type(error).__name__}: "
            return Switch(SwitchOutcome.FAILED, at, f"{kind}{error}")


def _record_of(planner: object) -> ProblemRecord:
    """Return the record of a planner's problem, or of a problem."""
    with concerning("planner"):
        return as_record(
            planner.model.problem if isinstance(planner, Planner) else planner
        )


def _report(motion: SampledMotion, begin: float, detail: str = "") -> Stop:
    """Return the result of a stop that begins at a time of a motion [s]."""
    end = max(begin, motion.end_time)
    times = np.linspace(begin, end, REPORT_SAMPLES)
    # Sums of absolute steps: a joint may reverse while the arm stops.
    distance = np.abs(np.diff(motion.at(times).q, axis=0)).sum(axis=0)
    return Stop(SwitchOutcome.ACCEPTED, begin, detail, end, distance)


def _replaced(starts: list[float]) -> str:
    """Return a text about replaced motions, empty if there are none."""
    if not starts:
        return ""
    times = ", ".join(f"{start:.6g}" for start in starts)
    return f"replaces the motion that was accepted for {times} s"


def positive(name: str, value: float) -> float:
    """Return an argument as a positive number.

    Raises:
        UsageError: It is not positive.
    """
    if (found := number(name, value)) <= 0:
        raise UsageError(f"must be positive, got {found:g}", argument=name)
    return found


def _checked_positions(name: str, q: ArrayLike, n: int) -> Array:
    """Return finite positions of n joints, shape (n,)."""
    positions = numbers(name, q)
    if positions.shape != (n,) or not np.isfinite(positions).all():
        raise UsageError(
            f"must be finite and have shape ({n},), got {q!r:.100}", argument=name
        )
    return positions


def _checked_times(time: ArrayLike) -> Array:
    """Return finite ascending times of shape () or (K,), K > 0."""
    times = numbers("time", time)
    if np.asarray(time).dtype == bool:
        raise UsageError(f"must be times [s], got {time!r:.100}", argument="time")
    if times.ndim > 1 or not times.size:
        raise UsageError(
            f"must be a number or ascending times of shape (K,), got shape {times.shape}",
            argument="time",
        )
    if not (math.isfinite(times) if times.ndim == 0 else np.isfinite(times).all()):
        raise UsageError(f"must be finite, got {time!r:.100}", argument="time")
    if times.ndim and (falls := np.diff(times) < 0).any():
        first = int(falls.argmax())
        later, earlier = distinct(times[first], times[first + 1])
        raise UsageError(
            f"must ascend, got {later} s and then {earlier} s", argument="time"
        )
    return times
