"""Execution of plans in time: set-points, replanning in the background, switches without a jump, and safe stops."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.addons.online.set_points import (
    SampledMotion,
    SetPoint,
    at_rest,
    sample_motion,
)
from cnpgen.errors import CnpgenError, UsageError
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.join import JoinedPlans
from cnpgen.plans.plans import Plans
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import number, numbers

Array = NDArray[np.float64]
PlanFunction = Callable[[SetPoint], Plans | JoinedPlans | None]
"""A function of the state at the switch that returns one plan or one sequence of plans from there, or None."""

# Of q [rad]; of dq and ddq as fractions of the limits.
MAX_SWITCH_GAPS = 1e-6, 1e-5, 1e-3
MAX_END_SPEED = 1e-6  # fraction of the velocity limits: a plan ends at rest
BRAKING_LOOKAHEADS_S = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5])


class SwitchOutcome(Enum):
    """Result of a request to switch to another plan; the value is a description."""

    ACCEPTED = "accepted"
    NO_PLAN = "the planner returned no plan"
    FAILED = "the planner raised an error"
    LATE = "the plan arrived after the switch time"
    JUMP = "the plan does not start in the state at the switch"
    MOVING = "the plan does not end at rest"
    INVALID = "the plan is not valid"


@dataclass(frozen=True)
class Switch:
    """Result of a request to switch to another plan.

    Attributes:
        outcome: The result; only accepted plans are executed.
        time: Switch time [s].
        detail: Further text, such as the judge's reason; or empty.
    """

    outcome: SwitchOutcome
    time: float
    detail: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the plan is executed."""
        return self.outcome is SwitchOutcome.ACCEPTED


class PlanRuntime:
    """A plan in execution, for controllers that need a set-point at any time.

    The runtime executes only motions that are valid and end at rest: single plans to
    rest, or sequences such as a hit and its way back. If no valid plan arrives in time,
    the motion in execution continues to its end and the arm rests there. Times are
    those of the caller's clock.

    ``set_point`` costs microseconds and may run in another thread than planning.

    Args:
        planner: Plans stops (``stop``); its problem defines the limits.
        q: Joint positions of the arm, which is at rest [rad], shape (n,).
        time: Start time [s].
        judge: Whether to check every plan by the independent verdict, which takes a few
            milliseconds.
        parameters: Parameters of the problem, such as the mass of the load, which all
            plans have, shape (width,); nominal by default.

    Raises:
        UsageError: The positions have another shape or are not finite, or a parameter
            is outside its range.
    """

    @checked_arguments
    def __init__(
        self,
        planner: Planner,
        q: ArrayLike,
        *,
        time: float = 0.0,
        judge: bool = True,
        parameters: ArrayLike | None = None,
    ) -> None:
        self._planner, self._judge = planner, judge
        self._parameters = _checked_parameters(planner, parameters)
        positions = numbers("q", q)
        if positions.shape != (planner.robot.n,) or not np.isfinite(positions).all():
            raise UsageError(
                f"must be finite and have shape ({planner.robot.n},), got {q!r:.100}",
                argument="q",
            )
        self._timeline: tuple[SampledMotion, ...] = (
            at_rest(positions, number("time", time)),
        )
        self._now = -np.inf
        self._lock = threading.Lock()
        self._executor: ThreadPoolExecutor | None = None

    def __enter__(self) -> PlanRuntime:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Wait for planning in the background to end, and stop its thread."""
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
            self._executor = None

    @property
    def end_time(self) -> float:
        """Time from which on the arm is at rest, if no other plan follows [s]."""
        return self._timeline[-1].end_time

    @checked_arguments
    def set_point(self, time: ArrayLike) -> SetPoint:
        """Return the state to follow, and exclude switches before it.

        Args:
            time: Time [s], one number or ascending times of shape (K,).

        Returns:
            State of shape (n,), or (K, n).
        """
        times = _checked_times(time)
        with self._lock:
            self._now = max(self._now, float(np.max(times)))
            timeline = self._timeline
        return _evaluate(timeline, times)

    @checked_arguments
    def state_at(self, time: ArrayLike) -> SetPoint:
        """Return the state at a future time, from which a new plan may start.

        See ``set_point``.
        """
        return _evaluate(self._timeline, _checked_times(time))

    @checked_arguments
    def switch(self, plan: Plans | JoinedPlans | None, at: float) -> Switch:
        """Switch to a plan at a time, if it is valid, ends at rest and arrives in time.

        Args:
            plan: One plan or one sequence, from ``state_at(at)`` to rest; None is
                refused.
            at: Switch time [s], not before the last time of ``set_point``.

        Raises:
            UsageError: There are several plans, or they are of another robot.
        """
        at = number("at", at)
        if plan is None:
            return Switch(SwitchOutcome.NO_PLAN, at)
        self._check_plan(plan)
        if at < self._now:
            return Switch(SwitchOutcome.LATE, at)
        if (outcome := self._find_reason(plan)) is not None:
            return Switch(outcome[0], at, outcome[1])
        motion = sample_motion(plan, at)
        with self._lock:
            if at < self._now:
                return Switch(SwitchOutcome.LATE, at)
            if detail := self._jump(motion, at):
                return Switch(SwitchOutcome.JUMP, at, detail)
            before = [
                part
                for part in self._timeline
                if part.start < at or part is self._timeline[0]
            ]
            timeline = (*before, motion)
            first = max(
                (
                    index
                    for index, part in enumerate(timeline)
                    if part.start <= self._now
                ),
                default=0,
            )
            self._timeline = timeline[
                first:
            ]  # without motions that ended because another one followed
        return Switch(SwitchOutcome.ACCEPTED, at)

    @checked_arguments
    def replan(self, make_plan: PlanFunction, at: float) -> Future[Switch]:
        """Plan in the background and switch if the plan arrives in time.

        Requests are served one after the other. The motion in execution continues if a
        request is refused.

        Args:
            make_plan: Called in the background with the state at the switch.
            at: Switch time [s].

        Returns:
            Future of the result; errors of ``make_plan`` are results, too.
        """
        if self._executor is None:
            self._executor = ThreadPoolExecutor(
                max_workers=1, thread_name_prefix="cnpgen-replan"
            )
        return self._executor.submit(self._replan, make_plan, number("at", at))

    @checked_arguments
    def stop(self, at: float) -> Switch:
        """Stop as fast as the planner can from a time on; if no stop is valid, the motion continues to its end.

        Args:
            at: Time at which the stop begins [s].

        Raises:
            UsageError: The planner's model does not plan from moving states to rest.
        """
        at = number("at", at)
        current = _part_at(self._timeline, at)
        if at >= current.end_time:
            return Switch(SwitchOutcome.ACCEPTED, at, "the arm is at rest")
        return self.switch(
            plan_stop(self._planner, current, at, parameters=self._parameters), at
        )

    def _replan(self, make_plan: PlanFunction, at: float) -> Switch:
        """Plan and switch; the boundary of the background thread, where errors become results."""
        try:
            return self.switch(make_plan(self.state_at(at)), at)
        except Exception as error:  # noqa: BLE001 - errors of the caller's function are results
            kind = "" if isinstance(error, CnpgenError) else f"{type(error).__name__}: "
            return Switch(SwitchOutcome.FAILED, at, f"{kind}{error}")

    def _check_plan(self, plan: Plans | JoinedPlans) -> None:
        """Raise an error for several plans and for plans of another robot."""
        if len(plan) != 1:
            raise UsageError(
                f"must be one plan or one sequence, got {len(plan)}", argument="plan"
            )
        names = self._planner.model.problem.joint_names
        if plan.problem.joint_names != names:
            raise UsageError(
                f"the plan is of {plan.problem.name!r} with other joints than {names}",
                concerns="plan",
            )

    def _find_reason(
        self, plan: Plans | JoinedPlans
    ) -> tuple[SwitchOutcome, str] | None:
        """Return the reason why a plan must not be executed at any time.

        None if there is none.
        """
        parts: tuple[Any, ...] = (
            plan.parts if isinstance(plan, JoinedPlans) else (plan,)
        )
        for part in parts:
            own, expected = part.boundary.parameters, self._parameters
            if (
                own is not None
                and expected is not None
                and not np.array_equal(own[0], expected)
            ):
                return (
                    SwitchOutcome.INVALID,
                    f"its parameters are {own[0]}, those of the runtime {expected}",
                )
        duration = plan.duration
        if not np.isfinite(duration).all():
            return SwitchOutcome.INVALID, "its duration is not finite"
        speed = np.abs(plan.motion.at_times(duration[:, None]).dq[0, 0])
        if (speed > MAX_END_SPEED * self._planner.robot.velocity_limit).any():
            return SwitchOutcome.MOVING, f"up to {speed.max():.3g} rad/s"
        for part in parts if self._judge else ():
            (verdict,) = evaluate_plans(part).verdicts
            if not verdict.valid:
                return SwitchOutcome.INVALID, str(verdict)
        return None

    def _jump(self, motion: SampledMotion, at: float) -> str:
        """Describe the discontinuity at a switch; empty if there is none."""
        robot = self._planner.robot
        before, after = (
            _evaluate(self._timeline, np.array(at)),
            motion.at(np.array([at])),
        )
        limits = (np.ones(robot.n), robot.velocity_limit, robot.acceleration_limit)
        for name, end, begin, limit, share in zip(
            SetPoint._fields, before, after, limits, MAX_SWITCH_GAPS, strict=True
        ):
            gap = np.abs(begin[0] - end)
            if not (gap <= share * limit).all():
                return f"{name} jumps by {gap.max():.3g}"
        return ""


def plan_stop(
    planner: Planner,
    motion: SampledMotion,
    time: float,
    *,
    parameters: ArrayLike | None = None,
) -> Plans | None:
    """Plan the fastest valid stop from a state on a motion.

    The goals are configurations that the motion passes later, which are on the
    constraint manifold. The plans are judged in the order of their durations. The
    result is None if none of them is valid. Models that do not plan from moving states
    raise UsageError.
    """
    q, dq, ddq = (values[0] for values in motion.at(np.array([time])))
    goals = motion.at(time + BRAKING_LOOKAHEADS_S).q
    candidates = planner.plan(
        q, goals, start_dq=dq, start_ddq=ddq, parameters=parameters
    )
    for index in np.argsort(candidates.duration).tolist():
        plan = candidates[index]
        if np.isfinite(plan.duration[0]) and evaluate_plans(plan).valid[0]:
            return plan
    return None


def _checked_parameters(planner: Planner, parameters: ArrayLike | None) -> Array | None:
    """Return the parameters of all plans, shape (width,).

    None if the problem has none.
    """
    ranges = planner.model.problem.parameters
    if parameters is None:
        return planner.robot.nominal_parameters if ranges else None
    rows = ranges.checked(numbers("parameters", parameters))
    if len(rows) != 1:
        raise UsageError(
            f"must have shape ({len(ranges)},), got {np.shape(parameters)}",
            argument="parameters",
        )
    return np.asarray(rows[0])


def _part_at(timeline: tuple[SampledMotion, ...], time: float) -> SampledMotion:
    """Return the motion in execution at a time."""
    return next(
        (part for part in reversed(timeline) if part.start <= time), timeline[0]
    )


def _checked_times(time: ArrayLike) -> Array:
    """Return finite times of shape () or (K,), K > 0."""
    times = numbers("time", time)
    if times.ndim > 1 or not times.size:
        raise UsageError(
            f"must be a number or ascending times of shape (K,), got shape {times.shape}",
            argument="time",
        )
    if not (math.isfinite(times) if times.ndim == 0 else np.isfinite(times).all()):
        raise UsageError(f"must be finite, got {time!r:.100}", argument="time")
    return times


def _evaluate(timeline: tuple[SampledMotion, ...], times: Array) -> SetPoint:
    """Return the states at times of shape () or (K,)."""
    flat = np.atleast_1d(times)
    last = timeline[-1]
    if flat[0] >= last.start:
        states = last.at(flat)
    else:
        rows = [_part_at(timeline, time).at(np.array([time])) for time in flat.tolist()]
        states = SetPoint(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))
    return states if times.ndim else SetPoint(*(values[0] for values in states))
