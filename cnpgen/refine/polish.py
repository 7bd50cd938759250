"""From attempts to a plan: the verdict of Pinocchio and Coal decides, and none comes back worse than it was given."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.refiner import Refiner
from cnpgen.refine.task import Attempt, Outcome, Refined, Task
from cnpgen.trajectory.motion import Motion
from cnpgen.verdict.verdict import Reason, Verdict

Array = NDArray[np.float64]
Judge = Callable[[Task, Array, Array], Verdict]  # of a task, path control points (C, n) and rate control points (R,)


@dataclass
class _Search:
    """What was tried for one task.

    Attributes:
        task: The task.
        given: The plan that it came with, or None.
        tried: Attempts, in order.
    """

    task: Task
    given: Attempt | None
    tried: list[Attempt] = field(default_factory=list)

    @property
    def iterations(self) -> int:
        return sum(attempt.iterations for attempt in self.tried)


def refine_task(refiner: Refiner, judge: Judge, task: Task) -> Refined:
    """Refine the plan of a task, or make one.

    Args:
        refiner: What makes attempts.
        judge: Who decides whether one is valid.
        task: The boundary problem.
    """
    if not task.is_finite:
        return _unusable(refiner, task)
    motion, search = refiner.check.transcription(task), _Search(task, refiner.given(task))
    for attempt in refiner.attempts(task, search.given):
        search.tried.append(attempt)
        if attempt.excess <= 1 and judge(task, *motion.unpack(attempt.x)).valid:
            break
    else:
        return _best(refiner, judge, search)
    given = search.given
    if given is not None and given.excess <= 1 and given.cost <= attempt.cost:
        path, rate = motion.unpack(given.x)
        if judge(task, path, rate).valid:
            return Refined(path, rate, Outcome.KEPT, Reason.OK, search.iterations, given.cost)
    path, rate = motion.unpack(attempt.x)
    return Refined(path, rate, attempt.outcome, Reason.OK, search.iterations, attempt.cost)


def _best(refiner: Refiner, judge: Judge, search: _Search) -> Refined:
    """Return the best of what is not valid: what the verdict finds least wrong with, the given plan among it."""
    task, motion = search.task, refiner.check.transcription(search.task)
    attempt = min(search.tried, key=lambda each: (max(each.excess, 1.0), each.cost))
    candidates = [(*motion.unpack(attempt.x), Outcome.UNSOLVED, attempt.cost)]
    if search.given is not None:
        assert task.path is not None
        assert task.rate is not None
        exact = motion.unpack(search.given.x)
        candidates += [(*plan, Outcome.KEPT, search.given.cost) for plan in (exact, (task.path, task.rate))]
    verdicts = [judge(task, path, rate) for path, rate, *_ in candidates]
    order = [(_severity(verdict), cost) for verdict, (*_, cost) in zip(verdicts, candidates, strict=True)]
    chosen = order.index(min(order))
    path, rate, outcome, cost = candidates[chosen]
    return Refined(path, rate, outcome, verdicts[chosen].reason, search.iterations, cost)


def _severity(verdict: Verdict) -> float:
    """How wrong a plan is: 1 for a valid one, more for others, inf for those that could not be evaluated."""
    if verdict.valid:
        return 1.0
    return max((margin.severity for margin in verdict.margins.values()), default=np.inf)


def _unusable(refiner: Refiner, task: Task) -> Refined:
    """Return the given plan, or nothing but nan, for boundary conditions that are no numbers."""
    spec, n = refiner.spec, task.boundary.start_q.shape[1]
    path = np.full((spec.path_control_points, n), np.nan) if task.path is None else task.path
    rate = np.full(spec.rate_control_points, np.nan) if task.rate is None else task.rate
    cost = float(Motion(path[None], rate[None], spec.degree).duration()[0])
    return Refined(path, rate, Outcome.UNUSABLE, Reason.NOT_FINITE, 0, cost)
