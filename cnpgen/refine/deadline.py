"""Refining until a deadline: the given plan is judged first, and what is better by then takes its place."""

import time
from dataclasses import replace

import numpy as np

from cnpgen.refine.jury import Jury
from cnpgen.refine.polish import Candidate, Search, as_given, unusable
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.deadline import Deadline
from cnpgen.refine.task import Outcome, Refined, Task

VERDICT = 5e-3  # s: what a verdict takes, until one was timed
MARGIN = 1.3  # times what the last verdict took is left for the next


@np.errstate(all="ignore")  # as of ``refine_task``
def refine_until(refiner: Refiner, jury: Jury, task: Task, seconds: float) -> Refined:
    """Refine the plan of a task for some time; the best plan until then is never worse than the given one.

    Steps and verdicts are not interrupted: none is begun that would end too late, as far as those before tell. Where
    there is no usable plan to begin with, one attempt is made, however short.

    Args:
        refiner: What makes attempts.
        jury: Who decides whether one is valid.
        task: The boundary problem.
        seconds: How long, from now on.
    """
    until = time.perf_counter() + seconds
    if not task.is_finite:
        return unusable(refiner, task)
    search, given, reserve = Search(refiner, jury, task), refiner.given(task), VERDICT
    best: Candidate | None = None
    for path, rate, outcome in as_given(refiner, task, given):
        begun = time.perf_counter()
        cost = refiner.check.transcription(task).objective(path, rate)
        best = _better(best, search.weigh(path, rate, cost, outcome))
        reserve = MARGIN * (time.perf_counter() - begun)
        if best.refined.valid:
            break
    attempts = refiner.attempts(replace(task, deadline=Deadline(until - reserve)), given)
    cut = late = best is not None and time.perf_counter() + reserve > until
    while not late and (attempt := next(attempts, None)) is not None:
        cut |= attempt.outcome is Outcome.UNSETTLED
        if best is None or time.perf_counter() + reserve <= until:
            enough = search.offer(attempt)
            best = _better(best, search.best())
            if enough:
                break
        late = time.perf_counter() + reserve > until
        cut |= late
    assert best is not None  # the first attempt is looked at where there is no plan
    outcome = Outcome.OUT_OF_TIME if cut else best.refined.outcome
    return replace(best.refined, outcome=outcome, iterations=search.iterations)


def _better(one: Candidate | None, other: Candidate) -> Candidate:
    return other if one is None or other.rank < one.rank else one
