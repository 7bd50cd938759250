"""Refining whole sets of plans: in as many processes as are wanted, with a journal that survives interruptions."""

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import counted
from cnpgen.machine.engine import Engine, assembled
from cnpgen.machine.threads import one_thread
from cnpgen.machine.times import NO_TIME, Stopwatch, Times
from cnpgen.machine.versions import __version__
from cnpgen.plans.plans import Plans, check_plans_type, screen
from cnpgen.plans.status import PlanStatus
from cnpgen.plans.tips import settle_tips
from cnpgen.refine.engine import prepare, refine_part
from cnpgen.refine.journal import Journal, open_journal
from cnpgen.refine.options import DEFAULT, RefineOptions
from cnpgen.refine.task import Outcome, Refined

FORMAT = "cnpgen-refinement"
FORMAT_VERSION = 1
ALONE = 60  # plans up to which a second process is not worth its start
PART = 4  # plans that one of several processes refines at a time: handing over takes as long as a twentieth of a plan

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]  # called with plans finished and valid since the last call


@dataclass(frozen=True, eq=False)
class Refinement:
    """What came of N plans.

    Attributes:
        given: The plans as they were given, but with the tip's positions where their joints put it.
        plans: The refined plans, in the same order.
        refined: How each of them ended.
        times: Where the time went; plans that a journal held took none.
    """

    given: Plans
    plans: Plans
    refined: tuple[Refined, ...]
    times: Times = NO_TIME

    def __repr__(self) -> str:
        outcomes = _counted(each.outcome.name.lower() for each in self.refined)
        how = ", ".join(f"{count:,} {name}" for name, count in outcomes.items())
        plans = f"{counted(len(self.refined), 'plan')} of {self.plans.problem.name!r}"
        return f"<{plans} refined, {int(self.valid.sum()):,} valid{how and ': '}{how}>"

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether the independent verdict calls each plan valid, shape (N,)."""
        return np.array([each.valid for each in self.refined], bool)

    def summary(self) -> dict[str, Any]:
        """Return for JSON what is said of all plans together."""
        durations = self.plans.duration[self.valid]
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "checksum": self.given.checksum,
            "plans": len(self.refined),
            "valid": int(self.valid.sum()),
            "outcomes": _counted(each.outcome.name.lower() for each in self.refined),
            "reasons": _counted(each.reason for each in self.refined if not each.valid),
            "mean_duration_s": float(durations.mean()) if len(durations) else None,
            "median_iterations": float(np.median([each.iterations for each in self.refined])) if self.refined else None,
            "seconds": self.times.rounded(),
            "not_valid": [
                {"plan": index, "sample_id": int(sample), "reason": str(each.reason), "outcome": each.outcome.text}
                for index, (sample, each) in enumerate(zip(self.plans.sample_id, self.refined, strict=True))
                if not each.valid
            ],
        }


def solve_plans(
    problems: Plans,
    *,
    options: RefineOptions = DEFAULT,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
    journal: str | Path | None = None,
    discard: bool = False,
    begin: Callable[[int, int], None] | None = None,
    progress: Progress | None = None,
) -> Refinement:
    """Make plans for boundary problems from nothing; plans that they have already are not looked at.

    Args:
        problems: The boundary problems, as ``draw_boundary_problems`` and ``load_boundary_problems`` return them.
        options: As of ``refine_plans``, like all that follow.
        workers: Processes.
        engine: Where they run.
        address: Likewise.
        journal: Where finished plans are written down.
        discard: Whether what another run has written there may be thrown away.
        begin: Called once.
        progress: Called now and then.

    Raises:
        UsageError: As ``refine_plans`` does.
        RecipeError: Likewise.
        MachineError: Likewise.
    """
    check_plans_type(problems)
    unmade = replace(
        problems,
        path_control_points=np.full_like(problems.path_control_points, np.nan),
        rate_control_points=np.full_like(problems.rate_control_points, np.nan),
    )
    return refine_plans(
        unmade,
        options=options,
        workers=workers,
        engine=engine,
        address=address,
        journal=journal,
        discard=discard,
        begin=begin,
        progress=progress,
    )


def refine_plans(
    plans: Plans,
    *,
    options: RefineOptions = DEFAULT,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
    journal: str | Path | None = None,
    discard: bool = False,
    begin: Callable[[int, int], None] | None = None,
    progress: Progress | None = None,
) -> Refinement:
    """Refine plans, or make them where their control points are nan.

    Every plan is refined for itself: neither the others nor the number of processes change what comes of it. None
    comes back worse than it was given: one that breaks less, by the independent verdict, or breaks nothing and costs
    less, is taken.

    Args:
        plans: The plans.
        options: How to refine.
        workers: Processes; default one per available core, or one where a second would not pay.
        engine: "loky": processes of this machine; "dask" or "ray": a cluster. By default loky, or the backend that
            ``joblib.parallel_config`` names.
        address: Of the cluster's scheduler or head; by default a cluster on this machine, for this call.
        journal: A file where finished plans are written down, and from which an interrupted run goes on.
        discard: Whether what another run has written there may be thrown away.
        begin: Called once with the number of plans and of those that the journal holds.
        progress: Called with the numbers of plans finished and valid since the last call.

    Raises:
        UsageError: An option makes no sense, there are fewer than one worker, or the journal is another run's.
        RecipeError: The problem needs a plug-in that is not installed.
        MachineError: A worker died, or the journal cannot be written.
    """
    check_plans_type(plans)
    watch, where = Stopwatch(), Engine(engine, address, workers)
    plans = settle_tips(plans)
    notes = None if journal is None else open_journal(Path(journal), _identity(plans, options), discard=discard)
    done: dict[int, Refined] = {} if notes is None else dict(notes.finished)
    if begin is not None:
        begin(len(plans), len(done))
    try:
        waiting = [i for i in range(len(plans)) if i not in done]
        for found in _run(plans, waiting, options, where, journal=notes, watch=watch):
            done |= found
            if progress is not None:
                progress(len(found), sum(each.valid for each in found.values()))
    finally:
        if notes is not None:
            notes.close()
    return replace(_assembled(plans, [done[i] for i in range(len(plans))], options), times=watch.times())


def _run(
    plans: Plans,
    waiting: list[int],
    options: RefineOptions,
    engine: Engine,
    *,
    journal: Journal | None,
    watch: Stopwatch,
) -> Iterator[dict[int, Refined]]:
    if not waiting:
        return
    prepare(plans, options)  # kernels are compiled once, not by every worker
    watch.prepared()
    advice = (
        ""
        if journal is None
        else f": {journal.path} holds what is finished; start again with the same arguments to go on"
    )
    with assembled(engine, -(-len(waiting) // PART), quick=len(waiting) <= ALONE) as team:
        count = team.size
        size = PART if count > 1 else 1
        parts = (waiting[first : first + size] for first in range(0, len(waiting), size))
        tasks = ((part, plans[np.array(part)]) for part in parts)
        with closing(team.share_out(partial(_refine, options=options), tasks, advice=advice)) as results:
            for part, refined, seconds in results:
                watch.computing += seconds / count
                if journal is not None:
                    journal.append(part, refined)
                yield dict(zip(part, refined, strict=True))


def _refine(task: tuple[list[int], Plans], *, options: RefineOptions) -> tuple[list[int], list[Refined], float]:
    """Refine a part; say how much CPU time it took [s]."""
    (part, plans), begun = task, time.thread_time()
    with one_thread():
        return part, refine_part(plans, options), time.thread_time() - begun


def _assembled(given: Plans, refined: list[Refined], options: RefineOptions) -> Refinement:
    """Put the refined plans together; beside them how they ended."""
    if not refined:
        return Refinement(given, given, ())
    plans = replace(
        given,
        path_control_points=np.stack([each.path for each in refined]),
        rate_control_points=np.stack([each.rate for each in refined]),
        columns={**given.columns, **_columns(refined)},
        refined_with=json.dumps({"cnpgen": __version__, **options.said()}),
        sealed=False,
    )
    status = _status(plans, np.array([each.valid for each in refined]))
    return Refinement(given, replace(plans, status=status), tuple(refined))


def _status(plans: Plans, valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    status = np.full(len(plans), PlanStatus.VALID, np.uint8)
    if not valid.all():
        screened = screen(plans[~valid])
        status[~valid] = np.where(screened == PlanStatus.UNKNOWN, PlanStatus.INVALID, screened)
    return status


def _columns(refined: list[Refined]) -> Mapping[str, Array]:
    return {
        "refine_outcome": np.array([each.outcome for each in refined], float),
        "refine_iterations": np.array([each.iterations for each in refined], float),
        "refine_objective": np.array([each.cost for each in refined], float),
    }


def _counted(words: Iterator[str]) -> dict[str, int]:
    return {str(word): count for word, count in Counter(words).most_common()}


def _identity(plans: Plans, options: RefineOptions) -> str:
    """Say what distinguishes a run: version, options and every number of the plans."""
    digest = hashlib.sha256(plans.problem.recipe.encode() + plans.problem.urdf.encode())
    boundary = [values for values in vars(plans.boundary).values() if values is not None]
    ends = [plans.columns["start_xyz"], plans.columns["goal_xyz"]]
    for values in (*boundary, *ends, plans.path_control_points, plans.rate_control_points):
        digest.update(str(values.shape).encode() + np.ascontiguousarray(values).tobytes())
    return json.dumps(
        {"version": __version__, "options": options.said(), "degree": plans.degree, "plans": digest.hexdigest()}
    )


def outcome_text(name: str) -> str:
    """Return an outcome in words, from its lower-case name."""
    return Outcome[name.upper()].text
