"""Refinement of sets of plans in several processes, with a journal for interrupted runs."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from cnpgen.documents import JsonObject
from cnpgen.machine.engine import Engine, assembled
from cnpgen.machine.threads import one_thread
from cnpgen.machine.times import Stopwatch
from cnpgen.machine.versions import __version__
from cnpgen.plans.format import GOAL_OPTION, PlanStatus
from cnpgen.plans.plans import Plans, screen
from cnpgen.plans.tips import correct_tips
from cnpgen.refine.goal_options import Progress, goal_groups
from cnpgen.refine.options import DEFAULT_OPTIONS, RefineOptions
from cnpgen.refine.refine_engine import prepare, refine_groups
from cnpgen.refine.refinement import Refinement
from cnpgen.refine.refinement_journal import Journal, open_journal
from cnpgen.refine.task import Attempt
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.scene_table import OBSTACLE_POSES

# Up to which the start of a second process takes longer than the plans.

MAX_SERIAL_PLANS = 60
# Of one of several processes: the transfer of a task takes a twentieth of a plan's
# time.
PLANS_PER_TASK = 4


@checked_arguments
def solve_plans(
    problems: Plans,
    *,
    options: RefineOptions = DEFAULT_OPTIONS,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
    journal: str | Path | None = None,
    discard: bool = False,
    begin: Callable[[int, int], None] | None = None,
    progress: Progress | None = None,
) -> Refinement:
    """Plan boundary problems without initial guesses; existing plans are ignored.

    Problems with the column ``goal_option`` are goal states of tasks: rows with the
    same ``sample_id`` belong to one task, and the result has the best valid motion to
    any of its goal states, one row for each task; with a time limit, the first valid one.

    ``problems`` come from ``draw_boundary_problems`` or ``load_boundary_problems``. The
    other arguments, and the errors, are those of ``refine_plans``.
    """
    without_plans = replace(
        problems,
        path_control_points=np.full_like(problems.path_control_points, np.nan),
        rate_control_points=np.full_like(problems.rate_control_points, np.nan),
    )
    return refine_tasks(
        without_plans,
        options,
        Engine(engine, address, workers),
        journal=journal,
        discard=discard,
        begin=begin,
        progress=progress,
    )


@checked_arguments
def refine_plans(
    plans: Plans,
    *,
    options: RefineOptions = DEFAULT_OPTIONS,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
    journal: str | Path | None = None,
    discard: bool = False,
    begin: Callable[[int, int], None] | None = None,
    progress: Progress | None = None,
) -> Refinement:
    """Refine plans, or plan where their control points are nan.

    Results do not depend on the other plans or the number of processes. The result is
    never worse than the input: it replaces the input only if the independent verdict
    finds a smaller violation, or none and a lower cost.

    Args:
        plans: The plans.
        options: Options of the refiner.
        workers: Number of processes; default one per available core, or one for few
            plans.
        engine: "loky": processes of this machine; "dask" or "ray": a cluster. By
            default loky, or the backend that ``joblib.parallel_config`` names.
        address: Address of the cluster's scheduler or head; by default a cluster on
            this machine, for this call.
        journal: File for finished plans, from which an interrupted run resumes.
        discard: Whether to discard finished plans of another run in the journal.
        begin: Function that is called once with the number of plans and of those in the
            journal.
        progress: Function that is called with the numbers of plans finished and valid
            since the last call.

    Raises:
        UsageError: An option is invalid, there is less than one worker, or the journal
            is another run's.
        RecipeError: The problem needs a plug-in that is not installed.
        MachineError: A worker died, or the journal cannot be written.
    """
    return refine_tasks(
        plans,
        options,
        Engine(engine, address, workers),
        journal=journal,
        discard=discard,
        begin=begin,
        progress=progress,
        to_any_goal=False,
    )


def refine_tasks(
    plans: Plans,
    options: RefineOptions,
    engine: Engine,
    *,
    journal: str | Path | None,
    discard: bool,
    begin: Callable[[int, int], None] | None,
    progress: Progress | None,
    to_any_goal: bool = True,
) -> Refinement:
    """Refine plans as ``refine_plans`` does, and ``to_any_goal`` of a task as ``solve_plans`` does."""
    watch = Stopwatch()
    plans = correct_tips(plans)
    several = to_any_goal and GOAL_OPTION in plans.columns
    groups = goal_groups(plans) if several else [[row] for row in range(len(plans))]
    identity = identity_of_run(plans, options, tasks=len(groups))
    file = None
    finished = dict[int, Attempt]()
    if journal is not None:
        file = open_journal(Path(journal), identity, discard=discard)
        finished |= file.finished
    waiting = [rows for rows in groups if finished.keys().isdisjoint(rows)]
    if begin is not None:
        begin(len(groups), len(groups) - len(waiting))
    try:
        for results in _run(plans, waiting, options, engine, journal=file, watch=watch):
            finished |= results
            if progress is not None:
                progress(len(results), sum(result.valid for result in results.values()))
    finally:
        if file is not None:
            file.file.close()
    # One row of every group has a result.
    chosen = [row for rows in groups for row in rows if row in finished]
    kept = plans if len(groups) == len(plans) else plans[chosen]
    refinement = _refinement(kept, [finished[row] for row in chosen], options)
    return replace(refinement, times=watch.times())


def _run(
    plans: Plans,
    waiting: list[list[int]],
    options: RefineOptions,
    engine: Engine,
    *,
    journal: Journal | None,
    watch: Stopwatch,
) -> Iterator[dict[int, Attempt]]:
    if not waiting:
        return
    # Kernels are compiled once, not by every worker.
    prepare(plans, options)
    watch.prepared()
    hint = (
        ""
        if journal is None
        else f": {journal.file.path} has the finished plans; the same call with the same arguments resumes"
    )
    with assembled(
        engine,
        -(-len(waiting) // PLANS_PER_TASK),
        quick=len(waiting) <= MAX_SERIAL_PLANS,
    ) as pool:
        count = pool.size
        size = PLANS_PER_TASK if count > 1 else 1
        parts = (
            waiting[first : first + size] for first in range(0, len(waiting), size)
        )
        tasks = ((part, plans[np.concatenate(part)]) for part in parts)
        with closing(
            pool.distribute(partial(_refine, options=options), tasks, hint=hint)
        ) as results:
            for rows, attempts, seconds in results:
                # CPU time of all workers, shared among them.
                watch.computing += seconds / count
                if journal is not None:
                    # Recorded before use: a crash afterwards does not lose it.
                    journal.append(rows, attempts)
                yield dict(zip(rows, attempts, strict=True))


def _refine(
    task: tuple[list[list[int]], Plans], *, options: RefineOptions
) -> tuple[list[int], list[Attempt], float]:
    """Refine some groups of the plans.

    Return the row of each result, the results and the CPU time [s].
    """
    part, plans = task
    begun = time.thread_time()
    rows = np.concatenate(part)
    places = iter(range(len(plans)))
    # Their places among the plans that were sent.
    groups = [[next(places) for _ in group] for group in part]
    with one_thread():
        results = refine_groups(plans, groups, options)
    chosen = [int(rows[place]) for place, _ in results]
    return chosen, [result for _, result in results], time.thread_time() - begun


def _refinement(
    plans: Plans, results: list[Attempt], options: RefineOptions
) -> Refinement:
    """Return the refined plans with the columns of their results."""
    if not results:
        return Refinement(plans, plans, ())
    refined = replace(
        plans,
        path_control_points=np.stack([result.path for result in results]),
        rate_control_points=np.stack([result.rate for result in results]),
        columns={
            **plans.columns,
            "refine_outcome": np.array([result.outcome for result in results], float),
            "refine_iterations": np.array(
                [result.iterations for result in results], float
            ),
            "refine_objective": np.array([result.cost for result in results], float),
        },
        refined_with=json.dumps({"cnpgen": __version__, **options.document()}),
        has_checksum=False,
    )
    invalid = np.array([not result.valid for result in results])
    status = np.full(len(plans), PlanStatus.VALID, np.uint8)
    if invalid.any():
        screened = screen(refined[invalid])
        status[invalid] = np.where(
            screened == PlanStatus.UNKNOWN, PlanStatus.INVALID, screened
        )
    return Refinement(plans, replace(refined, status=status), tuple(results))


def identity_of_run(
    plans: Plans, options: RefineOptions, *, tasks: int | None = None
) -> JsonObject:
    """Return what identifies a run, JSON-able: version, options, number of tasks and a checksum of the plans."""
    digest = hashlib.sha256(plans.problem.recipe.encode() + plans.problem.urdf.encode())
    boundary = [
        values for values in vars(plans.boundary).values() if values is not None
    ]
    ends = [
        plans.columns[name]
        for name in ("start_xyz", "goal_xyz", OBSTACLE_POSES)
        if name in plans.columns
    ]
    for values in (
        *boundary,
        *ends,
        plans.path_control_points,
        plans.rate_control_points,
    ):
        # Shapes are part of the digest: equal bytes of other shapes are other plans.
        digest.update(
            str(values.shape).encode() + np.ascontiguousarray(values).tobytes()
        )
    return {
        "version": __version__,
        "options": options.document(),
        "degree": plans.degree,
        "tasks": len(plans) if tasks is None else tasks,
        "plans": digest.hexdigest(),
    }
