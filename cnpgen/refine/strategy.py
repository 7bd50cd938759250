"""Strategy of the refiner: attempts at a task in their order (``attempts``), and the rule that accepts one of them.

The independent verdict decides, never the solver's own residuals. The first valid plan
is returned if it is precise; otherwise one more attempt is judged. A plan whose links
touch something within the tolerance is not precise, and up to ``MAX_CONTACTS`` attempts
are judged. If the verdict rejects an attempt for a shallow collision of hulls, or finds
such a contact, the solver continues it with a constraint at the phase that the verdict
names. The result is never worse than the input plan: it replaces it only if the verdict
finds a smaller violation, or none and a lower cost.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cnpgen.arrays import Array
from cnpgen.judges.plans.judge import Judge
from cnpgen.judges.plans.verdict import Reason, Verdict
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.link_clearance import ObjectClearance, SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.refine.attempts import make_attempts
from cnpgen.refine.proof.end_check import EndCheck
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.bounds import PRECISE_FRACTION
from cnpgen.refine.solver.hull_levels import (
    MAX_FED_BACK_M,
    MIN_FED_BACK_M,
    without_contacts,
)
from cnpgen.refine.solver.sqp import Deadline
from cnpgen.refine.task import MAX_JUDGED_VIOLATION, Attempt, Outcome, RefinementTask
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion

MAX_VERDICT_FEEDBACKS = 3  # of collisions of one attempt from the verdict to the solver
# Valid attempts whose links touch something within the tolerance, before the search
# ends with one.
MAX_CONTACTS = 6
# Of the added distance, from one of them to the next: an edge may pass between grid
# points.
FEEDBACK_GROWTH = 3.0
MAX_ROUNDING_ERROR = 1e-12  # rad and 1/s: smaller differences are rounding errors
LINK_REASONS = {RobotClearance.reason, SelfClearance.reason}
COLLISION_REASONS = LINK_REASONS | {ObjectContact.reason, ObjectClearance.reason}
INPUT_OUTCOMES = {Outcome.UNCHANGED, Outcome.ADJUSTED}
VERDICT_TIME_S = 5e-3  # of a verdict, before one was timed


# Refinement of a task


@np.errstate(all="ignore")  # squares of huge boundary conditions overflow
def refine_task(
    refiner: Refiner,
    checker: PlanChecker,
    task: RefinementTask,
    is_over: Callable[[bool], bool] = lambda _: False,
) -> Attempt:
    """Refine the input plan of a task, or plan without one.

    ``is_over``, called with whether an attempt is valid, ends the search after an attempt.
    """
    if not task.is_finite:
        return _invalid_input(refiner, task)
    search = RefinementSearch(refiner, checker, task)
    x = refiner.input_variables(task)
    for attempt in make_attempts(refiner, task, x):
        if (
            search.add(attempt)
            or search.found_no_path
            or search.ends_are_invalid()
            or is_over(search.has_valid)
            or search.continue_rejected(attempt)
        ):
            break
    if not (search.judged or search.skipped):
        # No attempt stays near the input path.
        search.judged.append(search.judge(next(_input_plans(refiner, task, x))))
    best = search.best()
    for plan in (
        () if search.costs_less_than_input(best, x) else _input_plans(refiner, task, x)
    ):
        # The input plan is judged only if it may be better: without a valid plan, or at
        # most as expensive and not refuted.
        if not best.valid or (
            plan.cost <= best.cost and not checker.refutes(task, plan.path, plan.rate)
        ):
            judged = search.judge(plan)
            best = min(best, judged, key=lambda attempt: attempt.rank)
            if judged.valid:
                break
    best = search.explained(best)
    no_path = search.found_no_path and best.outcome is Outcome.UNSOLVED
    return best.result(search.iterations, Outcome.NO_PATH if no_path else None)


@np.errstate(all="ignore")  # see ``refine_task``
def refine_task_until(
    refiner: Refiner, checker: PlanChecker, task: RefinementTask, seconds: float
) -> Attempt:
    """Refine the input plan of a task until a deadline; the result is never worse than the input.

    The input plan is judged first. Steps and verdicts are not interrupted: one starts
    only if it is expected to end in time. Without a usable input plan one attempt is
    always made. The deadline is ``seconds`` [s] from now.
    """
    until = time.perf_counter() + seconds
    if not task.is_finite:
        return _invalid_input(refiner, task)
    search = RefinementSearch(refiner, checker, task)
    x = refiner.input_variables(task)
    # The last verdict must fit before the deadline, so that its time is reserved.
    verdicts = Deadline(until, max_duration=VERDICT_TIME_S)
    best: Attempt | None = None
    for plan in _input_plans(refiner, task, x):
        begun = time.perf_counter()
        best = _better(best, search.judge(plan))
        verdicts = Deadline(until)
        verdicts.note(begun)
        if best.valid:
            break
    attempts = make_attempts(
        refiner, replace(task, deadline=Deadline(until - verdicts.max_duration)), x
    )
    cut = late = best is not None and not verdicts.allows(1)
    while not late and (attempt := next(attempts, None)) is not None:
        # The solver ended at its deadline.
        cut |= attempt.outcome is Outcome.NOT_CONVERGED
        if best is None or verdicts.allows(1):
            ends = search.add(attempt) or search.ends_are_invalid()
            best = _better(best, search.best())
            if ends:
                break
        late = not verdicts.allows(1)
        cut |= late
    # Without an input plan the first attempt is judged.
    assert best is not None
    best = search.explained(best)
    return best.result(search.iterations, Outcome.OUT_OF_TIME if cut else None)


def _better(best: Attempt | None, other: Attempt) -> Attempt:
    return other if best is None or other.rank < best.rank else best


def _input_plans(
    refiner: Refiner, task: RefinementTask, x: Array | None
) -> Iterator[Attempt]:
    """Yield the input plan if it can be evaluated: with exact ends if that changes it, then unmodified."""
    motion = refiner.check.transcription(task)
    if x is not None:
        path, rate = motion.unpack(x)
        if not _is_input(task, path, rate):
            yield Attempt(
                path=path,
                rate=rate,
                cost=motion.objective(path, rate),
                outcome=Outcome.ADJUSTED,
            )
    if task.path is None or task.rate is None or not np.isfinite(task.path).all():
        return
    if Motion(task.path[None], task.rate[None], refiner.spec.degree).runs_forward()[0]:
        cost = motion.objective(task.path, task.rate)
        yield Attempt(
            path=task.path, rate=task.rate, cost=cost, outcome=Outcome.UNCHANGED
        )


def _is_input(task: RefinementTask, path: Array, rate: Array) -> bool:
    """Return whether a plan is the input plan up to rounding."""
    pairs = (path, task.path), (rate, task.rate)
    return all(
        before is not None
        and np.allclose(now, before, rtol=0.0, atol=MAX_ROUNDING_ERROR)
        for now, before in pairs
    )


def _invalid_input(refiner: Refiner, task: RefinementTask) -> Attempt:
    """Return the input plan, or nan, for boundary conditions that are not finite."""
    spec = refiner.spec
    n = task.boundary.start_q.shape[1]
    path = (
        np.full((spec.path_control_points, n), np.nan)
        if task.path is None
        else task.path
    )
    rate = np.full(spec.rate_control_points, np.nan) if task.rate is None else task.rate
    cost = float(Motion(path[None], rate[None], spec.degree).duration()[0])
    return Attempt(
        path=path,
        rate=rate,
        cost=cost,
        outcome=Outcome.INVALID_INPUT,
        reason=Reason.NOT_FINITE,
    )


# Acceptance


class PlanChecker:
    """Independent check of the plans of a problem, splines of one degree."""

    def __init__(self, problem: Problem, robot: Robot, *, degree: int) -> None:
        self._problem = problem
        self._robot = robot
        self._degree = degree

    def verdict(self, task: RefinementTask, path: Array, rate: Array) -> Verdict:
        """Judge path control points (C, n) and rate control points (R,) as a plan of the task, with early exit."""
        return self._judge(*self._arguments(task, path, rate), early_exit=True)[0]

    def strict_verdict(self, task: RefinementTask, path: Array, rate: Array) -> Verdict:
        """Judge such a plan without a tolerance of contacts of the links."""
        return self._strict_judge(*self._arguments(task, path, rate), early_exit=True)[
            0
        ]

    @cached_property
    def _judge(self) -> Judge:
        return Judge(self._problem, self._robot)

    @cached_property
    def _strict_judge(self) -> Judge:
        return Judge(without_contacts(self._problem), self._robot)

    @cached_property
    def _ends(self) -> EndCheck:
        return EndCheck(self._problem, self._robot)

    def reason_of_ends(self, task: RefinementTask) -> str | None:
        """Return the reason of a constraint that an end violates, so that no plan is valid; None without one."""
        for constraint, _ in self._ends.violations(task.boundary, task.scene):
            return constraint.boundary_reason or constraint.reason
        return None

    def refutes(self, task: RefinementTask, path: Array, rate: Array) -> bool:
        """Return whether a few samples prove that such a plan is not valid."""
        return self._judge.refutes(*self._arguments(task, path, rate))[0]

    def _arguments(
        self, task: RefinementTask, path: Array, rate: Array
    ) -> tuple[Motion, Boundary, Scene, Array]:
        return (
            Motion(path[None], rate[None], self._degree),
            task.boundary,
            task.scene,
            task.goal_xyz[None],
        )


@dataclass
class RefinementSearch:
    """Attempts at one task with their verdicts."""

    refiner: Refiner
    checker: PlanChecker
    task: RefinementTask
    iterations: int = 0  # of all attempts so far
    judged: list[Attempt] = field(default_factory=list)
    # With violations above ``MAX_JUDGED_VIOLATION``.
    skipped: list[Attempt] = field(default_factory=list)
    verdict: Verdict | None = None  # the last one
    # Whether trees searched paths among the obstacles in vain.
    found_no_path: bool = False
    contacts: int = 0  # valid plans whose links touch something within the tolerance

    def add(self, attempt: Attempt) -> bool:
        """Judge an attempt; return whether the search ends: it is valid and precise, or enough others are valid."""
        self.iterations += attempt.iterations
        self.found_no_path |= attempt.outcome is Outcome.NO_PATH
        valid = sum(earlier.valid for earlier in self.judged)
        # A valid plan without contacts ends the search at the next attempt; plans with
        # contacts only after several.
        found_valid = valid >= MAX_CONTACTS or valid > self.contacts
        if attempt.violation > MAX_JUDGED_VIOLATION:
            self.skipped.append(attempt)
            return found_valid
        self.judged.append(self._judge_attempt(attempt))
        self.contacts += self.judged[-1].touches
        return found_valid or (self.judged[-1].valid and self.judged[-1].is_precise)

    def ends_are_invalid(self) -> bool:
        """Return whether no attempt is valid because an end is not, so that no other attempt helps.

        The ends are measured once, after the first attempt that was not accepted: most
        tasks are solved by their first attempt and pay nothing.
        """
        return not self.has_valid and self._reason_of_ends is not None

    @property
    def has_valid(self) -> bool:
        """Whether an attempt is valid."""
        return any(attempt.valid for attempt in self.judged)

    def explained(self, best: Attempt) -> Attempt:
        """Return the best attempt; without a valid one, with the reason of an invalid end if there is one."""
        if best.outcome is not Outcome.UNSOLVED:
            return best
        return replace(best, reason=self._reason_of_ends or best.reason)

    @cached_property
    def _reason_of_ends(self) -> str | None:
        return self.checker.reason_of_ends(self.task)

    def continue_rejected(self, attempt: Attempt) -> bool:
        """Continue an attempt whose verdict names a shallow collision; return whether the search ends.

        The collision becomes a constraint at its phase.
        """
        extra: Array | None = None
        for earlier in range(MAX_VERDICT_FEEDBACKS):
            margin = None if self.verdict is None else self.verdict.worst
            if (
                margin is None
                or margin.reason not in COLLISION_REASONS
                or attempt.violation > MAX_JUDGED_VIOLATION
            ):
                break
            # Deep collisions need another path, not a larger distance.
            if not 0 < margin.violation < MAX_FED_BACK_M:
                break
            # Each further feedback of one attempt demands more, until the edge is
            # resolved by the grid.
            depth = margin.violation * FEEDBACK_GROWTH**earlier
            following = self.refiner.fed_back(
                self.task, attempt, margin.phase, depth, extra
            )
            if following is None or following[0].violation > MAX_JUDGED_VIOLATION:
                break
            attempt, extra = following
            if self.add(attempt):
                return True
        return False

    def best(self) -> Attempt:
        """Return the best attempt."""
        if not self.judged:
            least = min(
                self.skipped, key=lambda attempt: (attempt.violation, attempt.cost)
            )
            self.judged.append(self._judge_attempt(least))
        return min(
            self.judged,
            key=lambda attempt: (
                attempt.severity,
                not attempt.is_precise,
                attempt.cost,
            ),
        )

    def costs_less_than_input(self, best: Attempt, x: Array | None) -> bool:
        """Return whether a valid plan costs less than the duration of the input plan of variables x alone."""
        motion = self.refiner.check.transcription(self.task)
        return (
            best.valid
            and x is not None
            and best.cost < motion.duration(np.exp(x[motion.split :]))
        )

    def judge(self, plan: Attempt) -> Attempt:
        """Return a plan with its verdict."""
        # Contacts, by the solver.
        removable = self.refiner.measures_hulls and not self._ends_touch
        judge = self.checker.strict_verdict if removable else self.checker.verdict
        verdict = self.verdict = judge(self.task, plan.path, plan.rate)
        touches = not verdict.valid and verdict.reason in LINK_REASONS
        # Invalid only without the tolerance of contacts: the usual verdict decides on
        # validity.
        if touches and removable:
            verdict = self.checker.verdict(self.task, plan.path, plan.rate)
        keeps_outcome = verdict.valid or plan.outcome in INPUT_OUTCOMES
        worst = max(
            (margin.severity for margin in verdict.margins.values()), default=np.inf
        )
        return replace(
            plan,
            outcome=plan.outcome if keeps_outcome else Outcome.UNSOLVED,
            reason=verdict.reason,
            severity=1.0 if verdict.valid else worst,
            is_precise=self._is_precise(verdict) and not touches,
            touches=touches and verdict.valid,
        )

    @cached_property
    def _ends_touch(self) -> bool:
        """Whether an end has a contact within the tolerance, which every motion has."""
        return (
            float(self.refiner.accepted_at_ends(self.task).max(initial=0.0))
            > MIN_FED_BACK_M
        )

    def _judge_attempt(self, attempt: Attempt) -> Attempt:
        if attempt.outcome is Outcome.ADJUSTED and _is_input(
            self.task, attempt.path, attempt.rate
        ):
            return self.judge(replace(attempt, outcome=Outcome.UNCHANGED))
        return self.judge(attempt)

    def _is_precise(self, verdict: Verdict) -> bool:
        """Return whether equalities are met within a fraction of their tolerance, beside the errors of the ends."""
        check = self.refiner.check
        equalities = (
            margin.severity
            for margin in verdict.margins.values()
            if margin.name in check.equalities
        )
        worst = max(equalities, default=0.0)
        return (
            worst <= PRECISE_FRACTION
            or worst <= PRECISE_FRACTION + check.end_equality_error(self.task)
        )
