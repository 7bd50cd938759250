"""Admission of plans: a plan is executed only if it is valid and ends at rest without an acceleration."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.addons.online.motion_check import MotionChecker
from cnpgen.addons.online.plan_hits import PlannedHits
from cnpgen.addons.online.set_points import (
    MAX_GRID_STEP_S,
    PlanOrSequence,
    SampledMotion,
    SetPoint,
    sample_motion,
)
from cnpgen.addons.online.stops import with_smooth_end
from cnpgen.addons.online.switches import SwitchOutcome
from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.judges.plans import Verdict
from cnpgen.judges.plans.judge import Judge
from cnpgen.plans.join import JoinedPlans
from cnpgen.plans.plans import Plans
from cnpgen.plans.tips import correct_tips
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.robots.robot import Robot
from cnpgen.schema.arguments import numbers

Executable = PlanOrSequence | PlannedHits

# Of q [rad]; of dq and ddq as fractions of the limits.
MAX_SWITCH_GAPS = (
    1e-6,
    1e-5,
    1e-3,
)
MAX_END_SPEED = 1e-6  # fraction of the velocity limits: a plan ends at rest
MAX_END_ACCELERATION = 1e-3  # fraction of the limits: larger ones are reduced to zero


class Admission:
    """Rules by which a runtime accepts the plans of one robot.

    Args:
        record: Problem that defines the limits.
        parameters: Parameters of the problem, shape (width,); nominal by default.
        judge: Whether plans are judged.
        checker: Memory of measurements.
        grid_step: Largest step of the grid on which motions are sampled [s].
    """

    def __init__(
        self,
        record: ProblemRecord,
        parameters: ArrayLike | None,
        *,
        judge: bool,
        checker: MotionChecker,
        grid_step: float = MAX_GRID_STEP_S,
    ) -> None:
        self._record = record
        self._robot = open_problem(record)[1]
        self._judge = judge
        self._checker = checker
        self._step = grid_step
        self._parameters = _checked_parameters(record, self._robot, parameters)
        self._judges: dict[ProblemRecord, Judge] = {}
        # The memory of a judge is that of one thread.
        self._lock = threading.Lock()

    def refusal_or_motion(
        self, plan: PlanOrSequence, at: float
    ) -> tuple[SwitchOutcome | SampledMotion, str]:
        """Return the motion of a plan that starts at a time [s], or the reason to refuse it, each with a text.

        Raises:
            UsageError: There are several plans, or they are of another robot.
        """
        self._check_plan(plan)
        end = _end_of(plan)
        return self._find_reason(plan, end) or self._with_smooth_end(plan, end, at)

    def _with_smooth_end(
        self, plan: PlanOrSequence, end: SetPoint, at: float
    ) -> tuple[SwitchOutcome | SampledMotion, str]:
        """Return the motion of a plan, slower at its end if it would end with an acceleration, and a text about it."""
        motion = sample_motion(plan, at, step=self._step)
        share = np.abs(end.ddq / self._robot.acceleration_limit).max()
        if share <= MAX_END_ACCELERATION:
            return motion, ""
        text = f"it ends with {share:.3g} of the acceleration limit"
        slower = with_smooth_end(self._checker, motion, measured=self._judge)
        if slower is None:
            return SwitchOutcome.ACCELERATING if self._judge else motion, text
        added = slower.end_time - motion.end_time
        return slower, f"{text}, which falls to 0 in {added:.3g} s more"

    def _check_plan(self, plan: PlanOrSequence) -> None:
        """Raise an error for several plans and for plans of another robot."""
        if len(plan) != 1:
            raise UsageError(
                f"must be one plan or one sequence, got {len(plan)}", argument="plan"
            )
        names = self._record.joint_names
        if plan.problem.joint_names != names:
            raise UsageError(
                f"the plan is of {plan.problem.name!r} with other joints than {names}",
                concerns="plan",
            )

    def _find_reason(
        self, plan: PlanOrSequence, end: SetPoint
    ) -> tuple[SwitchOutcome, str] | None:
        """Return the reason why a plan must not be executed at any time.

        None if there is none.
        """
        parts: tuple[Any, ...] = (
            plan.parts if isinstance(plan, JoinedPlans) else (plan,)
        )
        # A sequence carries one load, which is that of the runtime.
        for part in parts:
            own = part.boundary.parameters
            expected = self._parameters
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
        # An endless motion cannot be sampled on a grid.
        if not np.isfinite(duration).all():
            return SwitchOutcome.INVALID, "its duration is not finite"
        speed = np.abs(end.dq)
        if (speed > MAX_END_SPEED * self._robot.velocity_limit).any():
            return SwitchOutcome.MOVING, f"up to {speed.max():.3g} rad/s"
        for part in parts if self._judge else ():
            if not (verdict := self._verdict(part)).valid:
                return SwitchOutcome.INVALID, str(verdict)
        return None

    def _verdict(self, part: Plans) -> Verdict:
        """Judge a plan; the memory of Pinocchio and Coal is reused between calls."""
        part = correct_tips(part)
        with self._lock:
            if (judge := self._judges.get(part.problem)) is None:
                judge = self._judges[part.problem] = Judge(*open_problem(part.problem))
            goal = part.columns["goal_xyz"]
            return judge(part.motion, part.boundary, part.scene, goal, early_exit=True)[
                0
            ]

    def jump(self, before: SetPoint, motion: SampledMotion) -> str:
        """Describe the discontinuity between a state and the start of a motion; empty if there is none."""
        robot = self._robot
        after = motion.at(np.array([motion.start]))
        limits = (np.ones(robot.n), robot.velocity_limit, robot.acceleration_limit)
        for name, end, begin, limit, share in zip(
            SetPoint._fields, before, after, limits, MAX_SWITCH_GAPS, strict=True
        ):
            gap = np.abs(begin[0] - end)
            # The negation refuses nan, too.
            if not (gap <= share * limit).all():
                return f"{name} jumps by {gap.max():.3g}"
        return ""


def _end_of(plan: PlanOrSequence) -> SetPoint:
    """Return the state at the end of one plan or sequence."""
    last = plan.parts[-1] if isinstance(plan, JoinedPlans) else plan
    # Phases of each motion: Horner's rule is faster here than the basis functions.
    states = last.motion.at(np.ones((1, 1)))
    return SetPoint(states.q[0, 0], states.dq[0, 0], states.ddq[0, 0])


def plan_of_request(
    plan: Executable | None,
) -> tuple[PlanOrSequence | None, str]:
    """Return the plan or sequence of a request, or None and the reason why there is none."""
    if not isinstance(plan, PlannedHits):
        return (plan, "") if plan is None or len(plan) else (None, "it has 0 plans")
    hits = plan
    if len(hits.reasons) != 1:
        raise UsageError(f"must be one hit, got {len(hits.reasons)}", argument="plan")
    if not len(hits.plans):
        return None, hits.reasons[0]
    return hits.plans if hits.return_plans is None else hits.sequences, ""


def _checked_parameters(
    record: ProblemRecord, robot: Robot, parameters: ArrayLike | None
) -> Array | None:
    """Return the parameters of all plans, shape (width,).

    None if the problem has none.
    """
    ranges = record.parameters
    if parameters is None:
        return robot.nominal_parameters if ranges else None
    rows = ranges.checked(numbers("parameters", parameters))
    if len(rows) != 1:
        raise UsageError(
            f"must have shape ({len(ranges)},), got {np.shape(parameters)}",
            argument="parameters",
        )
    return np.asarray(rows[0])
