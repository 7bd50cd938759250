"""Judging whole sets of plans: every plan by the independent verdict, in as many processes as are wanted."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import counted
from cnpgen.judges.plans import Reason, Verdict, judge, summarise
from cnpgen.judges.plans.judge import check_step
from cnpgen.machine.workers import share_out, worker_count
from cnpgen.plans.plans import Plans, check_plans_type
from cnpgen.plans.status import PlanStatus
from cnpgen.plans.tips import settle_tips
from cnpgen.problems.record import open_problem
from cnpgen.schema.arguments import number

FORMAT = "cnpgen-evaluation"
FORMAT_VERSION = 1
STEP = 1e-3  # s
ALONE = 1000  # plans up to which a second process is not worth its start
PART = 50  # plans that a process judges before it is given others

_STATUS: dict[str, PlanStatus] = {
    Reason.OK: PlanStatus.VALID,
    Reason.NOT_FINITE: PlanStatus.NOT_FINITE,
    Reason.RATE: PlanStatus.NOT_FORWARD,
}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What the verdict says of N plans.

    Attributes:
        plans: The plans, with tip positions where the joints put the tip.
        verdicts: Their verdicts, in the same order.
        step: Moments that were looked at are no further apart than this [s].
    """

    plans: Plans
    verdicts: tuple[Verdict, ...]
    step: float

    def __repr__(self) -> str:
        plans = f"{counted(len(self.verdicts), 'plan')} of {self.plans.problem.name!r}"
        return f"<{plans} judged, {int(self.valid.sum()):,} valid>"

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether each plan is valid, shape (N,)."""
        return np.array([verdict.valid for verdict in self.verdicts], bool)

    @property
    def status(self) -> NDArray[np.uint8]:
        """What is known of each plan now, values of ``PlanStatus``, shape (N,)."""
        return np.array([_STATUS.get(verdict.reason, PlanStatus.INVALID) for verdict in self.verdicts], np.uint8)

    def summary(self) -> dict[str, Any]:
        """Return for JSON what is said of all plans together (docs/verdict.md)."""
        record = self.plans.problem
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "problem": record.name,
            "problem_sha256": record.comparable_sha256,
            "checksum": self.plans.checksum,
            "step_s": self.step,
            **summarise(self.verdicts),
        }

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield for JSON what is said of each plan (docs/verdict.md)."""
        for index, (sample, verdict) in enumerate(zip(self.plans.sample_id.tolist(), self.verdicts, strict=True)):
            yield {"plan": index, "sample_id": sample, **verdict.to_dict()}


def evaluate_plans(
    plans: Plans, *, step: float = STEP, workers: int | None = None, progress: Callable[[int], None] | None = None
) -> Evaluation:
    """Judge plans with Pinocchio and Coal, on a fine time grid and between its moments.

    Every plan is judged for itself: neither the others nor the number of processes change its verdict. Plans that
    cannot be evaluated get a verdict that says so. Where a column ``start_xyz`` or ``goal_xyz`` is not where the joints
    put the tip, the joints count, after a warning.

    Args:
        plans: The plans.
        step: Largest time between two moments that are looked at [s].
        workers: Processes; default one per available core, or one where a second would not pay.
        progress: Called with the number of plans that were judged since the last call.

    Raises:
        UsageError: There are no plans, the step is not positive, or there are fewer than one worker.
        RecipeError: The problem needs a plug-in that is not installed.
        MachineError: A worker died.
    """
    check_plans_type(plans)
    check_step(step := number("step", step))
    plans = settle_tips(plans)
    parts = [plans[first : first + PART] for first in range(0, len(plans), PART)]
    count = worker_count(1 if workers is None and len(plans) <= ALONE else workers, len(parts))
    verdicts: list[list[Verdict]] = []
    with closing(share_out(partial(_judge, step=step), parts, count, ordered=True)) as results:
        for found in results:
            verdicts.append(found)
            if progress is not None:
                progress(len(found))
    return Evaluation(plans, tuple(chain.from_iterable(verdicts)), step)


def _judge(plans: Plans, *, step: float) -> list[Verdict]:
    problem, robot = open_problem(plans.problem)
    ends = (plans.columns["start_xyz"], plans.columns["goal_xyz"])
    return judge(problem, robot, plans.motion, plans.boundary, *ends, step=step)
