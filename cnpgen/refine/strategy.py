"""Strategy of the refiner: the order of the attempts at a task, and the rule that accepts one of them.

The next attempt is made only if no earlier one was accepted. Attempts in their order (``make_attempts``):

1. Plans with finer knots than their problem: the levels of step 2 with the problem's own control points.
2. Coarse level from the input plan or a straight line, uniform time scaling, fine level, strict level.
3. Other initial guesses, and the best attempt so far after uniform time scaling.
4. Step 2 again, from a straight line at constant rate, then from the best attempt so far.
5. Without a deadline: levels on hulls in place of capsules, and joint-space paths of RRT-Connect. If compiled trees can
   search these paths, they come right after step 2, whose finer levels run only for nearly valid attempts. Without a
   path there are no further attempts.

Acceptance (``RefinementSearch``): the independent verdict decides, never the solver's own residuals. The first valid
plan is returned if it is precise; otherwise one more attempt is judged. A plan whose links touch something within the
tolerance is not precise, and up to ``MAX_CONTACTS`` attempts are judged. If the verdict rejects an attempt for a
shallow collision of hulls, or finds such a contact, the solver continues it with a constraint at the phase that the
verdict names. The result is never worse than the input plan: it replaces it only if the verdict finds a smaller
violation, or none and a lower cost.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.judge import Judge
from cnpgen.judges.plans.verdict import Reason, Verdict
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.link_clearance import ObjectClearance, SelfClearance
from cnpgen.problems.problem import Problem
from cnpgen.refine.grid_levels import MAX_INITIAL_VIOLATION
from cnpgen.refine.obstacle_attempts import along_path, around_obstacles, ends_penetrate, is_deep, path_guesses
from cnpgen.refine.proof.end_violations import end_violations
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.bounds import PRECISE_FRACTION
from cnpgen.refine.solver.hull_feedback import MAX_FED_BACK_M, MIN_FED_BACK_M
from cnpgen.refine.solver.hull_problem import without_contacts
from cnpgen.refine.solver.hulls import Hulls, has_clearance_constraints
from cnpgen.refine.solver.sqp import Deadline, Result
from cnpgen.refine.task import MAX_JUDGED_VIOLATION, Attempt, Outcome, RefinementTask
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.remaining_trajectory import with_fewer_knots, with_finer_knots
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

NEARLY_VALID = 30.0  # tolerances; attempts with larger violations are left for joint-space paths
MAX_VERDICT_FEEDBACKS = 3  # of collisions of one attempt from the verdict to the solver
MAX_CONTACTS = 6  # valid attempts whose links touch something within the tolerance, before the search ends with one
FEEDBACK_GROWTH = 3.0  # of the added distance, from one of them to the next: an edge may pass between grid points
MAX_ROUNDING_ERROR = 1e-12  # rad and 1/s: smaller differences are rounding errors
LINK_REASONS = {RobotClearance.reason, SelfClearance.reason}
COLLISION_REASONS = LINK_REASONS | {ObjectContact.reason, ObjectClearance.reason}
INPUT_OUTCOMES = {Outcome.UNCHANGED, Outcome.ADJUSTED}
VERDICT_TIME_S = 5e-3  # of a verdict, before one was timed


# Refinement of a task


@np.errstate(all="ignore")  # squares of huge boundary conditions overflow
def refine_task(refiner: Refiner, checker: PlanChecker, task: RefinementTask) -> Attempt:
    """Refine the input plan of a task, or plan without one."""
    if not task.is_finite:
        return _invalid_input(refiner, task)
    search, x = RefinementSearch(refiner, checker, task), refiner.input_variables(task)
    for attempt in make_attempts(refiner, task, x):
        if search.add(attempt) or search.found_no_path or search.continue_rejected(attempt):
            break
    if not (search.judged or search.skipped):  # no attempt stays near the input path
        path, rate, outcome = next(_input_plans(refiner, task, x))
        search.judged.append(search.judge(search.input_attempt(path, rate, outcome)))
    best = search.best()
    for path, rate, outcome in () if search.costs_less_than_input(best, x) else _input_plans(refiner, task, x):
        plan = search.input_attempt(path, rate, outcome)
        if search.may_replace(plan, best):
            judged = search.judge(plan)
            best = min(best, judged, key=lambda attempt: attempt.rank)
            if judged.valid:
                break
    if best.outcome is Outcome.UNSOLVED:
        best = replace(best, reason=checker.reason_of_ends(task) or best.reason)
    no_path = search.found_no_path and best.outcome is Outcome.UNSOLVED
    return best.result(search.iterations, Outcome.NO_PATH if no_path else None)


@np.errstate(all="ignore")  # see ``refine_task``
def refine_task_until(refiner: Refiner, checker: PlanChecker, task: RefinementTask, seconds: float) -> Attempt:
    """Refine the input plan of a task until a deadline; the result is never worse than the input.

    The input plan is judged first. Steps and verdicts are not interrupted: one starts only if it is expected to end in
    time. Without a usable input plan one attempt is always made. The deadline is ``seconds`` [s] from now.
    """
    until = time.perf_counter() + seconds
    if not task.is_finite:
        return _invalid_input(refiner, task)
    search, x = RefinementSearch(refiner, checker, task), refiner.input_variables(task)
    verdicts = Deadline(until, max_duration=VERDICT_TIME_S)
    best: Attempt | None = None
    for path, rate, outcome in _input_plans(refiner, task, x):
        begun = time.perf_counter()
        best = _better(best, search.judge(search.input_attempt(path, rate, outcome)))
        verdicts = Deadline(until)
        verdicts.note(begun)
        if best.valid:
            break
    attempts = make_attempts(refiner, replace(task, deadline=Deadline(until - verdicts.max_duration)), x)
    cut = late = best is not None and not verdicts.allows(1)
    while not late and (attempt := next(attempts, None)) is not None:
        cut |= attempt.outcome is Outcome.NOT_CONVERGED
        if best is None or verdicts.allows(1):
            ends = search.add(attempt)
            best = _better(best, search.best())
            if ends:
                break
        late = not verdicts.allows(1)
        cut |= late
    assert best is not None  # without an input plan the first attempt is judged
    return best.result(search.iterations, Outcome.OUT_OF_TIME if cut else None)


def _better(best: Attempt | None, other: Attempt) -> Attempt:
    return other if best is None or other.rank < best.rank else best


def _input_plans(refiner: Refiner, task: RefinementTask, x: Array | None) -> Iterator[tuple[Array, Array, Outcome]]:
    """Yield the input plan if it can be evaluated: with exact ends if that changes it, then unmodified."""
    if x is not None:
        path, rate = refiner.check.transcription(task).unpack(x)
        if not _is_input(task, path, rate):
            yield path, rate, Outcome.ADJUSTED
    if task.path is None or task.rate is None or not np.isfinite(task.path).all():
        return
    if Motion(task.path[None], task.rate[None], refiner.spec.degree).runs_forward()[0]:
        yield task.path, task.rate, Outcome.UNCHANGED


def _is_input(task: RefinementTask, path: Array, rate: Array) -> bool:
    """Return whether a plan is the input plan up to rounding."""
    assert task.path is not None
    assert task.rate is not None
    differences = np.abs(path - task.path).max(), np.abs(rate - task.rate).max()
    return all(bool(difference <= MAX_ROUNDING_ERROR) for difference in differences)


def _invalid_input(refiner: Refiner, task: RefinementTask) -> Attempt:
    """Return the input plan, or nan, for boundary conditions that are not finite."""
    spec, n = refiner.spec, task.boundary.start_q.shape[1]
    path = np.full((spec.path_control_points, n), np.nan) if task.path is None else task.path
    rate = np.full(spec.rate_control_points, np.nan) if task.rate is None else task.rate
    cost = float(Motion(path[None], rate[None], spec.degree).duration()[0])
    return Attempt(path=path, rate=rate, cost=cost, outcome=Outcome.INVALID_INPUT, reason=Reason.NOT_FINITE)


# Acceptance


class PlanChecker:
    """Independent check of the plans of a problem, splines of one degree."""

    def __init__(self, problem: Problem, robot: Robot, *, degree: int) -> None:
        self._problem, self._robot, self._degree = problem, robot, degree

    def verdict(self, task: RefinementTask, path: Array, rate: Array) -> Verdict:
        """Judge path control points (C, n) and rate control points (R,) as a plan of the task, with early exit."""
        return self._judge(*self._arguments(task, path, rate), early_exit=True)[0]

    def strict_verdict(self, task: RefinementTask, path: Array, rate: Array) -> Verdict:
        """Judge such a plan without a tolerance of contacts of the links."""
        return self._strict_judge(*self._arguments(task, path, rate), early_exit=True)[0]

    @cached_property
    def _judge(self) -> Judge:
        return Judge(self._problem, self._robot)

    @cached_property
    def _strict_judge(self) -> Judge:
        return Judge(without_contacts(self._problem), self._robot)

    def reason_of_ends(self, task: RefinementTask) -> str | None:
        """Return the reason of a constraint that an end violates, so that no plan is valid; None without one."""
        for constraint, _ in end_violations(self._problem, self._robot, task.boundary, task.scene):
            return constraint.boundary_reason or constraint.reason
        return None

    def refutes(self, task: RefinementTask, path: Array, rate: Array) -> bool:
        """Return whether a few samples prove that such a plan is not valid."""
        return self._judge.refutes(*self._arguments(task, path, rate))[0]

    def _arguments(self, task: RefinementTask, path: Array, rate: Array) -> tuple[Motion, Boundary, Scene, Array]:
        return Motion(path[None], rate[None], self._degree), task.boundary, task.scene, task.goal_xyz[None]


@dataclass
class RefinementSearch:
    """Attempts at one task with their verdicts.

    Attributes:
        refiner: Refiner of the problem.
        checker: Independent check.
        task: The task.
        iterations: Iterations of all attempts so far.
        judged: Judged attempts.
        skipped: Attempts with violations above ``MAX_JUDGED_VIOLATION``.
        verdict: Last verdict.
        found_no_path: Whether trees searched paths among the obstacles in vain.
        contacts: Number of valid plans whose links touch something within the tolerance.
    """

    refiner: Refiner
    checker: PlanChecker
    task: RefinementTask
    iterations: int = 0
    judged: list[Attempt] = field(default_factory=list)
    skipped: list[Attempt] = field(default_factory=list)
    verdict: Verdict | None = None
    found_no_path: bool = False
    contacts: int = 0

    def add(self, attempt: Attempt) -> bool:
        """Judge an attempt; return whether the search ends: it is valid and precise, or enough others are valid."""
        self.iterations += attempt.iterations
        self.found_no_path |= attempt.outcome is Outcome.NO_PATH
        valid = sum(earlier.valid for earlier in self.judged)
        found_valid = valid >= MAX_CONTACTS or valid > self.contacts
        if attempt.violation > MAX_JUDGED_VIOLATION:
            self.skipped.append(attempt)
            return found_valid
        self.judged.append(self._judge_attempt(attempt))
        self.contacts += self.judged[-1].touches
        return found_valid or (self.judged[-1].valid and self.judged[-1].is_precise)

    def continue_rejected(self, attempt: Attempt) -> bool:
        """Continue an attempt whose verdict names a shallow collision; return whether the search ends.

        The collision becomes a constraint at its phase.
        """
        extra: Array | None = None
        for earlier in range(MAX_VERDICT_FEEDBACKS):
            margin = None if self.verdict is None else self.verdict.worst
            if margin is None or margin.reason not in COLLISION_REASONS or attempt.violation > MAX_JUDGED_VIOLATION:
                break
            if not 0 < margin.violation < MAX_FED_BACK_M:
                break
            depth = margin.violation * FEEDBACK_GROWTH**earlier
            following = self.refiner.fed_back(self.task, attempt, margin.phase, depth, extra)
            if following is None or following[0].violation > MAX_JUDGED_VIOLATION:
                break
            attempt, extra = following
            if self.add(attempt):
                return True
        return False

    def best(self) -> Attempt:
        """Return the best attempt."""
        if not self.judged:
            least = min(self.skipped, key=lambda attempt: (attempt.violation, attempt.cost))
            self.judged.append(self._judge_attempt(least))
        return min(self.judged, key=lambda attempt: (attempt.severity, not attempt.is_precise, attempt.cost))

    def costs_less_than_input(self, best: Attempt, x: Array | None) -> bool:
        """Return whether a valid plan costs less than the duration of the input plan of variables x alone."""
        motion = self.refiner.check.transcription(self.task)
        return best.valid and x is not None and best.cost < motion.duration(np.exp(x[motion.split :]))

    def may_replace(self, plan: Attempt, best: Attempt) -> bool:
        """Return whether a plan may be better than the best one: not more expensive than a valid one, not refuted."""
        if not best.valid:
            return True
        return plan.cost <= best.cost and not self.checker.refutes(self.task, plan.path, plan.rate)

    def input_attempt(self, path: Array, rate: Array, outcome: Outcome) -> Attempt:
        """Return a form of the input plan as an attempt."""
        cost = self.refiner.check.transcription(self.task).objective(path, rate)
        return Attempt(path=path, rate=rate, cost=cost, outcome=outcome)

    def judge(self, plan: Attempt) -> Attempt:
        """Return a plan with its verdict."""
        removable = self.refiner.measures_hulls and not self._ends_touch  # contacts, by the solver
        judge = self.checker.strict_verdict if removable else self.checker.verdict
        verdict = self.verdict = judge(self.task, plan.path, plan.rate)
        touches = not verdict.valid and verdict.reason in LINK_REASONS
        if touches and removable:
            verdict = self.checker.verdict(self.task, plan.path, plan.rate)
        keeps_outcome = verdict.valid or plan.outcome in INPUT_OUTCOMES
        worst = max((margin.severity for margin in verdict.margins.values()), default=np.inf)
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
        return float(self.refiner.accepted_at_ends(self.task).max(initial=0.0)) > MIN_FED_BACK_M

    def _judge_attempt(self, attempt: Attempt) -> Attempt:
        if attempt.outcome is Outcome.ADJUSTED and _is_input(self.task, attempt.path, attempt.rate):
            return self.judge(replace(attempt, outcome=Outcome.UNCHANGED))
        return self.judge(attempt)

    def _is_precise(self, verdict: Verdict) -> bool:
        """Return whether equalities are met within a fraction of their tolerance, beside the errors of the ends."""
        check = self.refiner.check
        equalities = (margin.severity for margin in verdict.margins.values() if margin.name in check.equalities)
        worst = max(equalities, default=0.0)
        return worst <= PRECISE_FRACTION or worst <= PRECISE_FRACTION + check.end_equality_error(self.task)


# Order of the attempts


def make_attempts(refiner: Refiner, task: RefinementTask, x: Array | None) -> Iterator[Attempt]:
    """Yield attempts at a task that stay near its input path, of variables x, if they must; see ``_all_attempts``."""
    task = replace(task, stay_within=None) if x is None else task
    for attempt in _all_attempts(refiner, task, x):
        if task.is_near(attempt.path, refiner.spec.degree):
            yield attempt


def _all_attempts(refiner: Refiner, task: RefinementTask, x: Array | None) -> Iterator[Attempt]:
    """Yield attempts at a task; later ones are more expensive and requested only if the earlier ones were rejected."""
    if refiner.settings.max_iterations == 0:
        guess, outcome = (refiner.line_guess(task), Outcome.SOLVED) if x is None else (x, Outcome.ADJUSTED)
        yield refiner.measured(task, guess, outcome, unlimited=True)
        return
    if x is not None and refiner.coarser is not None:
        yield from _with_fewer_control_points(refiner, refiner.coarser, task, x)
    adjusted = refiner.measured(task, x, Outcome.ADJUSTED) if x is not None and task.at_rest else None
    searches_trees = refiner.measures_hulls and task.deadline is None
    hulls = refiner.hulls if searches_trees else None
    if hulls is None:
        best = yield from run_levels(refiner, task, x, adjusted)
    else:
        best = yield from _before_paths(refiner, task, x, adjusted, hulls)
    if task.stay_within is not None or refiner.check.ends_are_invalid(task):  # the other guesses are other paths
        return
    if hulls is not None:
        best = yield from _best_of(around_obstacles(refiner, task, best, hulls), best)
        if ends_penetrate(task, hulls):
            return
    others = _from_other_guesses(refiner, task, x if adjusted is None else adjusted.variables, best)
    best = yield from _best_of(others, best)
    even_line = refiner.even_line_guess(task)
    # all attempts so far may depend on the input plan or on the rising rate
    if x is not None or not np.array_equal(even_line, refiner.line_guess(task)):
        best = yield from _restart(refiner, task, None, even_line, best)
    best = yield from _restart(refiner, task, best.variables, even_line, best)
    if hulls is not None or task.deadline is not None:
        return
    if has_clearance_constraints(refiner.problem, refiner.robot):
        yield from around_obstacles(refiner, task, best, refiner.hulls)
    elif task.at_rest:
        yield from (along_path(refiner, task, guess) for guess in path_guesses(refiner, task))


def _best_of(attempts: Iterator[Attempt], best: Attempt) -> Generator[Attempt, None, Attempt]:
    """Yield attempts; return the best of them and ``best``."""
    for attempt in attempts:
        yield attempt
        best = attempt if attempt.is_better(best) else best
    return best


def _with_fewer_control_points(refiner: Refiner, coarser: Refiner, task: RefinementTask, x: Array) -> Iterator[Attempt]:
    """Yield the attempts of the levels with the problem's own control points, written with all of the plan's.

    With three times as many control points a step takes ten times as long, for objectives that are 0.3 % lower.
    """
    if coarser.spec.path_control_points < task.boundary.min_control_points(coarser.spec.degree):
        return
    own, fewer, degree = refiner.check.transcription(task), coarser.check.transcription(task), refiner.spec.degree
    path, rate = own.unpack(x)
    fitted = with_fewer_knots(Motion(path[None], rate[None], degree), task.boundary, coarser.spec)
    guess = coarser.input_variables(replace(task, path=fitted.path[0], rate=fitted.rate[0]))
    for attempt in () if guess is None else run_levels(coarser, task, guess, None):
        motion = Motion(attempt.path[None], attempt.rate[None], degree)
        finer = with_finer_knots(motion, refiner.spec)
        variables = own.pack(finer.path[0], finer.rate[0])
        path, rate = own.unpack(variables)
        yield replace(attempt, x=variables, path=path, rate=rate)
    if task.deadline is not None:
        task.deadline.max_duration *= (own.nx / fewer.nx) ** 2  # estimate for steps with all control points


def _before_paths(
    refiner: Refiner, task: RefinementTask, x: Array | None, adjusted: Attempt | None, hulls: Hulls
) -> Generator[Attempt, None, Attempt]:
    """Yield the attempts before joint-space paths; return the best one."""
    if x is None and is_deep(refiner, task, hulls):
        line = refiner.measured(task, refiner.line_guess(task), Outcome.NOT_CONVERGED)
        yield line
        return line
    return (yield from run_levels(refiner, task, x, adjusted, max_violation=NEARLY_VALID))


def run_levels(
    refiner: Refiner,
    task: RefinementTask,
    x: Array | None,
    adjusted: Attempt | None,
    line: Array | None = None,
    *,
    max_violation: float = np.inf,
) -> Generator[Attempt, None, Attempt]:
    """Yield the attempts of the coarse, fine and strict levels; return the best one.

    Args:
        refiner: Refiner of the problem.
        task: The task.
        x: Variables of the initial guess, or None.
        adjusted: Input plan with exact ends, scaled in time, for motions from rest to rest; replaces ``x``.
        line: Initial guess without a plan, or with a plan of large violation; the straight line by default.
        max_violation: Violation of the coarse level, in tolerances, above which the finer levels are left out.
    """
    coarse = run_coarse_level(refiner, task, x if adjusted is None else adjusted.variables, line)
    outcome = Outcome.SOLVED if coarse.converged else Outcome.NOT_CONVERGED
    feasible = coarse.violation <= refiner.settings.violation_tolerance
    if feasible:
        cost = coarse.cost - refiner.check.transcription(task).regularization(coarse.x)
        # most of these are valid, so that their violation is not needed
        yield refiner.attempt(task, coarse.x, cost, outcome, iterations=coarse.iterations, violation=0.0)
    best = refiner.measured(task, coarse.x, outcome, 0 if feasible else coarse.iterations)
    best = refiner.continue_scaled(task, best)
    if not feasible or best.x is not coarse.x:
        yield best
    if best.violation > max_violation:
        return best
    fine = refiner.solve(task, refiner.levels.fine, best.variables, Outcome.SOLVED_FINE)
    yield fine
    if adjusted is not None and adjusted.outcome is Outcome.TIME_SCALED and adjusted.violation <= 1:
        yield adjusted
    best = fine if fine.is_better(best) else best
    strict = refiner.solve(task, refiner.levels.strict, best.variables, Outcome.SOLVED_FINE)
    yield strict
    return strict if strict.is_better(best) else best


def run_coarse_level(refiner: Refiner, task: RefinementTask, x: Array | None, line: Array | None) -> Result:
    """Run the coarse level from variables x, or from a line if there are none or their violation is too large."""
    if x is not None:
        result = refiner.run_level(task, refiner.levels.warm, x)
        if result.violation < MAX_INITIAL_VIOLATION:
            return result
    return refiner.run_level(task, refiner.levels.coarse, refiner.line_guess(task) if line is None else line)


def _from_other_guesses(refiner: Refiner, task: RefinementTask, x: Array | None, best: Attempt) -> Iterator[Attempt]:
    """Yield attempts from the input plan with more iterations, from other guesses, and from the best attempt."""
    for guess in [*([] if x is None else [x]), *refiner.other_guesses(task)]:
        other = refiner.solve(task, refiner.levels.restart, guess, Outcome.RESTARTED)
        yield other
        best = other if other.is_better(best) else best
    last = refiner.time_scaled(task, best, unlimited=True) if task.at_rest else best
    yield refiner.solve(task, refiner.levels.warm, last.variables, Outcome.RESTARTED)
    if task.at_rest:  # its verdict names the limit that no time scaling meets
        yield last


def _restart(
    refiner: Refiner, task: RefinementTask, x: Array | None, line: Array, best: Attempt
) -> Generator[Attempt, None, Attempt]:
    """Yield the attempts of all levels from another initial guess; return the best of these and ``best``."""
    attempts = run_levels(refiner, task, x, None, line)
    return (yield from _best_of((replace(attempt, outcome=Outcome.RESTARTED) for attempt in attempts), best))
