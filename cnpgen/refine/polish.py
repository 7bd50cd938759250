"""From attempts to a plan: the verdict of Pinocchio and Coal decides, and none comes back worse than it was given."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.verdict import Reason, Verdict
from cnpgen.refine.jury import Jury
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.bounds import PRECISE
from cnpgen.refine.task import Attempt, Outcome, Refined, Task
from cnpgen.trajectory.motion import Motion

Array = NDArray[np.float64]

SAME = 1e-12  # rad and 1/s: control points that differ by less are the same but for rounding
GIVEN = {Outcome.KEPT, Outcome.ADJUSTED}
HOPELESS = 3.0  # excess above which an attempt is not worth a verdict, unless there is no better one


@dataclass(frozen=True)
class Candidate:
    """A plan with its verdict.

    Attributes:
        refined: The plan.
        severity: 1 if it is valid; else how wrong it is, inf if it could not be evaluated.
        precise: Whether equalities are met much better than they must be.
    """

    refined: Refined
    severity: float
    precise: bool

    @property
    def rank(self) -> tuple[float, float]:
        """Violations first, then the objective."""
        return self.severity, self.refined.cost


@dataclass
class Search:
    """What was tried for one task.

    Attributes:
        refiner: What makes attempts.
        jury: Who decides.
        task: The task.
        iterations: Steps of all attempts so far.
        judged: Attempts with their verdicts.
        hopeless: The others.
    """

    refiner: Refiner
    jury: Jury
    task: Task
    iterations: int = 0
    judged: list[Candidate] = field(default_factory=list)
    hopeless: list[Attempt] = field(default_factory=list)

    def offer(self, attempt: Attempt) -> bool:
        """Take an attempt in; return whether that will do: it is valid and precise, or one before it was valid."""
        self.iterations += attempt.iterations
        enough = any(each.refined.valid for each in self.judged)
        if attempt.excess > HOPELESS:
            self.hopeless.append(attempt)
            return enough
        self.judged.append(self._candidate(attempt))
        return enough or (self.judged[-1].refined.valid and self.judged[-1].precise)

    def best(self) -> Candidate:
        """Return the best attempt."""
        if not self.judged:
            self.judged.append(self._candidate(min(self.hopeless, key=lambda each: (each.excess, each.cost))))
        return min(self.judged, key=lambda each: (each.severity, not each.precise, each.refined.cost))

    def is_shorter(self, best: Refined, given: Array | None) -> bool:
        """Whether a valid plan costs less than the time that the given one takes, of variables ``given``, or None."""
        motion = self.refiner.check.transcription(self.task)
        return best.valid and given is not None and best.cost < motion.duration(np.exp(given[motion.split :]))

    def may_be_better(self, path: Array, rate: Array, cost: float, best: Refined) -> bool:
        """Whether a plan is worth a verdict: beside a valid one it is if it costs no more and is not refuted."""
        return not best.valid or (cost <= best.cost and not self.jury.refutes(self.task, path, rate))

    def weigh(self, path: Array, rate: Array, cost: float, outcome: Outcome) -> Candidate:
        """Judge a plan whose objective is ``cost``."""
        verdict = self.jury.verdict(self.task, path, rate)
        reached = outcome if verdict.valid or outcome in GIVEN else Outcome.UNSOLVED
        refined = Refined(path, rate, reached, verdict.reason, 0, cost)
        return Candidate(refined, _severity(verdict), self._is_precise(verdict))

    def _is_precise(self, verdict: Verdict) -> bool:
        check = self.refiner.check
        worst = max((each.severity for each in verdict.margins.values() if each.name in check.equalities), default=0.0)
        return worst <= PRECISE or worst <= PRECISE + check.imprecision_of_ends(self.task)

    def _candidate(self, attempt: Attempt) -> Candidate:
        path, rate = self.refiner.check.transcription(self.task).unpack(attempt.x)
        if attempt.outcome is Outcome.ADJUSTED and _is_given(self.task, path, rate):
            return self.weigh(path, rate, attempt.cost, Outcome.KEPT)
        return self.weigh(path, rate, attempt.cost, attempt.outcome)


@np.errstate(all="ignore")  # boundary conditions may be so large that squares of them are no numbers
def refine_task(refiner: Refiner, jury: Jury, task: Task) -> Refined:
    """Refine the plan of a task, or make one.

    Args:
        refiner: What makes attempts.
        jury: Who decides whether one is valid.
        task: The boundary problem.
    """
    if not task.is_finite:
        return unusable(refiner, task)
    search, given = Search(refiner, jury, task), refiner.given(task)
    for attempt in refiner.attempts(task, given):
        if search.offer(attempt):
            break
    best, motion = search.best(), refiner.check.transcription(task)
    for path, rate, outcome in () if search.is_shorter(best.refined, given) else as_given(refiner, task, given):
        cost = motion.objective(path, rate)
        if search.may_be_better(path, rate, cost, best.refined):
            kept = search.weigh(path, rate, cost, outcome)
            best = min(best, kept, key=lambda each: each.rank)
            if kept.refined.valid:
                break
    return Refined(**{**vars(best.refined), "iterations": search.iterations})


def as_given(refiner: Refiner, task: Task, given: Array | None) -> Iterator[tuple[Array, Array, Outcome]]:
    """Yield the plan as it was given, where it can be evaluated: with exact ends if it had others, and as it is."""
    if given is not None:
        path, rate = refiner.check.transcription(task).unpack(given)
        if not _is_given(task, path, rate):
            yield path, rate, Outcome.ADJUSTED
    if task.path is None or task.rate is None or not np.isfinite(task.path).all():
        return
    if Motion(task.path[None], task.rate[None], refiner.spec.degree).runs_forward()[0]:
        yield task.path, task.rate, Outcome.KEPT


def _is_given(task: Task, path: Array, rate: Array) -> bool:
    """Whether a plan is the one that was given, but for rounding."""
    assert task.path is not None
    assert task.rate is not None
    return bool(np.abs(path - task.path).max() <= SAME and np.abs(rate - task.rate).max() <= SAME)


def _severity(verdict: Verdict) -> float:
    """How wrong a plan is: 1 for a valid one, more for others, inf for those that could not be evaluated."""
    if verdict.valid:
        return 1.0
    return max((margin.severity for margin in verdict.margins.values()), default=np.inf)


def unusable(refiner: Refiner, task: Task) -> Refined:
    """Return the given plan, or nothing but nan, for boundary conditions that are no numbers."""
    spec, n = refiner.spec, task.boundary.start_q.shape[1]
    path = np.full((spec.path_control_points, n), np.nan) if task.path is None else task.path
    rate = np.full(spec.rate_control_points, np.nan) if task.rate is None else task.rate
    cost = float(Motion(path[None], rate[None], spec.degree).duration()[0])
    return Refined(path, rate, Outcome.UNUSABLE, Reason.NOT_FINITE, 0, cost)
