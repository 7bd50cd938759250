"""Tasks with several goal states: the fastest valid motion to any of them.

The rows of a task have the same ``sample_id``, and the column ``goal_option`` numbers
its goal states, the nearest first. No motion is faster than the straight line at the
velocity limits. Goal states that cannot improve on the best motion so far are therefore
not tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.machine.times import NO_TIME
from cnpgen.plans.format import GOAL_OPTION
from cnpgen.plans.join import concatenate
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.joint import JointVelocity
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.refinement import Refinement
from cnpgen.refine.task import Attempt

# Called with plans finished and valid since the last call.
Progress = Callable[[int, int], None]


def refine_goal_options(
    plans: Plans,
    refine: Callable[..., Refinement],
    *,
    journal: str | Path | None,
    begin: Callable[[int, int], None] | None,
    progress: Progress | None,
    first_valid: bool = False,
) -> Refinement:
    """Refine plans to several goal states of each task; return the refinement of the best row of each, in their order.

    With ``first_valid`` a task ends with its first valid motion. The other arguments are
    those of ``refine_plans``, which ``refine`` calls. Later rounds
    have files beside the journal. ``begin`` is called with the number of tasks, and
    tasks count as finished after their first goal state.
    """
    _check_tasks(plans)
    tasks = list(dict.fromkeys(plans.sample_id.tolist()))
    rounds, results = list[Refinement](), list[Attempt]()  # of all rounds
    # By task: index of a result, its cost.
    chosen, lowest, files = dict[int, int](), dict[int, float](), list[Path]()
    if begin is not None:
        begin(len(tasks), 0)
    # With a time limit the first valid goal ends the search of its task: no duration is
    # below infinity.
    bounds = np.full(len(plans), np.inf) if first_valid else min_durations(plans)
    for round_number, rows in enumerate(_rounds(plans, bounds, lowest)):
        file = (
            Path(f"{journal}.{round_number}" if round_number else f"{journal}")
            if journal is not None
            else None
        )
        files += [] if file is None or not round_number else [file]
        refinement = refine(plans[rows], journal=file)
        rounds.append(refinement)
        for task, result in zip(
            refinement.plans.sample_id.tolist(), refinement.results, strict=True
        ):
            first, improves = (
                task not in chosen,
                result.valid and result.cost < lowest.get(task, np.inf),
            )
            if progress is not None and (first or improves):
                progress(int(first), int(improves and task not in lowest))
            if first or improves:
                chosen[task] = len(results)
            # The lowest cost decides which goals are still tried in the next rounds.
            if improves:
                lowest[task] = result.cost
            results.append(result)
    for file in files:
        file.unlink(missing_ok=True)
    rows = np.array([chosen[task] for task in tasks])
    return replace(
        rounds[0],
        input_plans=concatenate([refinement.input_plans for refinement in rounds])[
            rows
        ],
        plans=concatenate([refinement.plans for refinement in rounds])[rows],
        results=tuple(results[row] for row in rows),
        times=sum((refinement.times for refinement in rounds), NO_TIME),
    )


def _check_tasks(plans: Plans) -> None:
    """Raise UsageError if rows of different tasks have one number, for example after joining two files of tasks."""
    rows = zip(
        plans.sample_id.tolist(),
        np.asarray(plans.columns[GOAL_OPTION]).tolist(),
        strict=True,
    )
    starts: dict[int, Array] = {}
    seen = set[tuple[int, float]]()
    for row, key in enumerate(rows):
        start = plans.boundary.start_q[row]
        if key in seen or not np.array_equal(starts.setdefault(key[0], start), start):
            raise UsageError(
                f"have several tasks with the sample_id {key[0]}: number tasks that are solved together differently",
                argument="plans",
            )
        seen.add(key)


def min_durations(plans: Plans) -> Array:
    """Return a lower bound of the duration of every plan [s], shape (N,): its joints at their velocity limits."""
    problem, robot = open_problem(plans.problem)
    velocity = problem.first(JointVelocity)
    if velocity is None:
        return np.zeros(len(plans))
    distance = np.abs(plans.boundary.goal_q - plans.boundary.start_q)
    return np.asarray(
        (distance / (robot.velocity_limit * (1 + velocity.tolerance))).max(axis=1)
    )


def _rounds(
    plans: Plans, min_duration: Array, lowest: dict[int, float]
) -> Iterator[NDArray[np.int64]]:
    """Yield the rows of each round: the next goal state of every task that it may improve."""
    options = np.asarray(plans.columns[GOAL_OPTION])
    for option in np.unique(options):
        rows = np.flatnonzero(options == option)
        bound = np.array(
            [lowest.get(int(task), np.inf) for task in plans.sample_id[rows]]
        )
        # Also goals that are not finite.
        waiting = rows[(min_duration[rows] < bound) | np.isinf(bound)]
        if len(waiting):
            yield waiting
