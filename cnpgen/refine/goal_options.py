"""Tasks with several goal states: the fastest valid motion to any of them.

The rows of a task have the same ``sample_id``, and the column ``goal_option`` numbers
its goal states, the nearest first. No motion is faster than the straight line at the
velocity limits. Goal states that cannot improve on the best motion so far are therefore
not tried. With a time limit the first valid motion ends a task, and the goal that a tree
with all goals as roots reaches first comes first (Kuffner and LaValle 2000).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.plans.format import GOAL_OPTION
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.joint import JointVelocity
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.task import Attempt, RefinementTask

# Called with plans finished and valid since the last call.
Progress = Callable[[int, int], None]


def goal_groups(plans: Plans) -> list[list[int]]:
    """Return the rows of every task, its goal states in their order.

    Raises:
        UsageError: Rows of different tasks have one number, for example after joining
            two files of tasks.
    """
    options = np.asarray(plans.columns[GOAL_OPTION]).tolist()
    groups: dict[int, list[int]] = {}
    for row, task in enumerate(plans.sample_id.tolist()):
        groups.setdefault(task, []).append(row)
    for task, rows in groups.items():
        starts = plans.boundary.start_q[rows]
        if (
            len({options[row] for row in rows}) < len(rows)
            or (starts != starts[0]).any()
        ):
            raise UsageError(
                f"have several tasks with the sample_id {task}: number tasks that are solved together differently",
                argument="plans",
            )
        rows.sort(key=options.__getitem__)
    return list(groups.values())


def refine_to_any(
    tasks: Sequence[RefinementTask],
    refine: Callable[[RefinementTask], Attempt],
    *,
    order: Sequence[int],
    min_durations: Array,
    first_valid: bool = False,
) -> tuple[int, Attempt]:
    """Refine motions to the goal states of one task; return the index of the best one and its result.

    ``order`` are the indices of all goal states, and ``min_durations`` [s] has shape
    (G,). With ``first_valid`` the first valid motion ends the search.
    """
    chosen = order[0]
    best = refine(tasks[order[0]])
    for index in order[1:]:
        # Also goals that are not finite are tried, as long as there is no valid motion.
        if best.valid and (first_valid or not min_durations[index] < best.cost):
            continue
        result = refine(tasks[index])
        if result.valid and not (best.valid and best.cost <= result.cost):
            chosen = index
            best = result
    return chosen, best


def order_by_tree(refiner: Refiner, tasks: Sequence[RefinementTask]) -> list[int]:
    """Return the indices of the goal states of one task: the one that a common tree reaches first, then the others.

    Without compiled hulls, with an input plan, or in scenes that depend on the goal,
    their order is kept.
    """
    first = tasks[0]
    kept = list(range(len(tasks)))
    poses = first.scene.poses
    if (
        not refiner.measures_hulls
        or refiner.input_variables(first) is not None
        or not all(
            task.is_finite and np.array_equal(task.scene.poses, poses) for task in tasks
        )
    ):
        return kept
    goals = np.concatenate([task.boundary.goal_q for task in tasks])
    for path in refiner.tree_search(first, goals).first_paths():
        # A path ends in one of the goals, whose difference is zero.
        reached = int(np.abs(goals - path[-1]).max(axis=1).argmin())
        return [reached, *(index for index in kept if index != reached)]
    return kept


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
