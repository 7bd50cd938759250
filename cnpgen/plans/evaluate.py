"""Evaluation of sets of plans by the independent verdict, in several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Mask
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError, counted
from cnpgen.judges.plans import Reason, Verdict, judge, summarize_verdicts
from cnpgen.judges.plans.judge import check_step
from cnpgen.machine.workers import distribute, worker_count
from cnpgen.plans.format import PlanStatus
from cnpgen.plans.plans import Plans
from cnpgen.plans.tips import correct_tips
from cnpgen.problems.limit_sources import JudgedLimits
from cnpgen.problems.problem_record import open_problem
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import number, numbers
from cnpgen.schema.html_table import html_table

T = TypeVar("T")

FORMAT = "cnpgen-evaluation"
EVALUATION_VERSION = 2
MAX_VERDICT_STEP_S = 1e-3  # s
MAX_PLANS_OF_ONE_PROCESS = 1000  # a second process takes longer to start than it saves
PLANS_PER_VERDICT_TASK = 50  # plans that a process judges at a time

_STATUS: dict[str, PlanStatus] = {
    Reason.OK: PlanStatus.VALID,
    Reason.NOT_FINITE: PlanStatus.NOT_FINITE,
    Reason.RATE: PlanStatus.NOT_FORWARD,
}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Verdicts of N plans.

    Attributes:
        plans: Plans, with tip positions consistent with the joints.
        verdicts: Verdicts, in the same order.
        step: Maximum distance of checked times [s].
        tracking_error: Largest tracking error of every joint [rad], or one for all;
            empty for exact tracking.
    """

    plans: Plans
    verdicts: tuple[Verdict, ...]
    step: float
    tracking_error: tuple[float, ...] = ()

    def __repr__(self) -> str:
        plans = f"{counted(len(self.verdicts), 'plan')} of {self.plans.problem.name!r}"
        return f"<{plans} judged, {int(self.valid.sum()):,} valid>"

    def _repr_html_(self) -> str:
        rows = (
            (
                index,
                verdict.reason,
                f"{verdict.metrics.duration:.4g}",
                verdict.worst or "",
            )
            for index, verdict in enumerate(self.verdicts)
        )
        head = ("plan", "verdict", "T [s]", "smallest margin, or largest violation")
        return html_table(repr(self), head, rows)

    @property
    def valid(self) -> Mask:
        """Whether each plan is valid, shape (N,)."""
        return np.array([verdict.valid for verdict in self.verdicts], bool)

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status of each plan after the verdict, values of ``PlanStatus``, shape (N,)."""
        return np.array(
            [
                _STATUS.get(verdict.reason, PlanStatus.INVALID)
                for verdict in self.verdicts
            ],
            np.uint8,
        )

    @cached_property
    def judged_limits(self) -> JudgedLimits:
        """Limits that were judged, with who states them."""
        return JudgedLimits.of(*open_problem(self.plans.problem))

    def summary(self) -> JsonObject:
        """Return the summary of all plans for JSON ('cnpgen docs verdict')."""
        record = self.plans.problem
        return {
            "format": FORMAT,
            "format_version": EVALUATION_VERSION,
            "problem": record.name,
            "problem_sha256": record.comparable_sha256,
            "checksum": self.plans.checksum,
            **self.judged_limits.to_dict(),
            "step_s": self.step,
            **(
                {"tracking_error_rad": list(self.tracking_error)}
                if self.tracking_error
                else {}
            ),
            **summarize_verdicts(self.verdicts),
        }

    def rows(self) -> Iterator[JsonObject]:
        """Yield the result of each plan for JSON ('cnpgen docs verdict')."""
        for index, (sample, verdict) in enumerate(
            zip(self.plans.sample_id.tolist(), self.verdicts, strict=True)
        ):
            yield {"plan": index, "sample_id": sample, **verdict.to_dict()}


@checked_arguments
def evaluate_plans(
    plans: Plans,
    *,
    step: float = MAX_VERDICT_STEP_S,
    tracking_error: float | Sequence[float] | None = None,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """Judge plans with Pinocchio and Coal, on a fine time grid and between its times.

    Every verdict is independent of the other plans and of the number of processes.
    Plans that cannot be evaluated get a verdict with that status. If ``start_xyz`` or
    ``goal_xyz`` differ from the tip positions of the joints, the joints are used, after
    a warning.

    Args:
        plans: Plans to judge.
        step: Maximum distance of checked times [s].
        tracking_error: Largest tracking error of the joints [rad], one number or one
            per joint. Limits of positions, clearances and the manifold must then hold
            for every state within it.
        workers: Number of processes; default one per available core, or one for few
            plans.
        progress: Called with the number of plans that were judged since the last call.

    Raises:
        UsageError: There are no plans, the step is not positive, there is less than one
            worker, or a tracking error is negative.
        RecipeError: A required plug-in is not installed.
        MachineError: A worker died.
    """
    check_step(step := number("step", step))
    if isinstance(tracking_error, bool | np.bool_):
        raise UsageError(
            f"must be angles [rad], got {tracking_error}", argument="tracking_error"
        )
    error = (
        ()
        if tracking_error is None
        else tuple(np.atleast_1d(numbers("tracking_error", tracking_error)).tolist())
    )
    # Obstacles may stand below the tip positions in the columns, which must fit the
    # joints.
    plans = correct_tips(plans)
    workers = (
        1 if workers is None and len(plans) <= MAX_PLANS_OF_ONE_PROCESS else workers
    )
    task = partial(_judge, step=step, error=error)
    verdicts = judged_in_parts(
        task, plans, size=PLANS_PER_VERDICT_TASK, workers=workers, progress=progress
    )
    return Evaluation(plans, tuple(verdicts), step, error)


def judged_in_parts(
    judge_part: Callable[[Any], list[T]],
    items: Any,
    *,
    size: int,
    workers: int | None,
    progress: Callable[[int], None] | None,
) -> list[T]:
    """Judge a sequence in parts of a size in several processes.

    Return the results in order.
    """
    # A part is judged in one batch, and progress is reported part by part.
    parts = [items[first : first + size] for first in range(0, len(items), size)]
    results: list[T] = []
    with closing(
        distribute(judge_part, parts, worker_count(workers, len(parts)), ordered=True)
    ) as judged:
        for found in judged:
            results += found
            if progress is not None:
                progress(len(found))
    return results


def _judge(plans: Plans, *, step: float, error: tuple[float, ...]) -> list[Verdict]:
    problem, robot = open_problem(plans.problem)
    # One number holds for all joints.
    tracking_error = (error if len(error) > 1 else error[0]) if error else None
    return judge(
        problem,
        robot,
        plans.motion,
        plans.boundary,
        plans.scene,
        plans.columns["goal_xyz"],
        step=step,
        tracking_error=tracking_error,
    )
