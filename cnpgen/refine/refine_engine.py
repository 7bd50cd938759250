"""Refiners of problems with their kernels, and the refinement of plans in one process."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from threading import get_ident

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.kernels.library import KernelLibrary
from cnpgen.plans.plans import Plans
from cnpgen.problems.obstacles import goal_velocities, scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.refine.first_plan import refine_task_within
from cnpgen.refine.goal_options import min_durations, order_by_tree, refine_to_any
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.strategy import PlanChecker, refine_task, refine_task_until
from cnpgen.refine.task import Attempt, RefinementTask
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.remaining_trajectory import is_finer
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

Solver = Callable[..., tuple[Motion, Mask]]  # of ``load_solver``


def refine_serially(plans: Plans, options: RefineOptions) -> list[Attempt]:
    """Refine plans one by one; results do not depend on the other plans or their order.

    Where control points are not finite or rates not positive, the input plan is not
    used.
    """
    rows = ([row] for row in range(len(plans)))
    return [result for _, result in refine_groups(plans, rows, options)]


def refine_groups(
    plans: Plans, groups: Iterable[list[int]], options: RefineOptions
) -> list[tuple[int, Attempt]]:
    """Refine groups of rows, each to the goal states of one task; return the row of the best result of each, and it."""
    refiner = prepare(plans, options)
    tasks = [replace(task, stay_within=options.stay_within) for task in tasks_of(plans)]
    checker = _checker(plans.problem, plans.degree, get_ident())

    def refine(task: RefinementTask) -> Attempt:
        if options.deadline is not None:
            return refine_task_until(refiner, checker, task, options.deadline)
        if options.time_limit is not None:
            return refine_task_within(refiner, checker, task, options.time_limit)
        return refine_task(refiner, checker, task)

    results = list[tuple[int, Attempt]]()
    for rows in groups:
        goals = [tasks[row] for row in rows]
        first_valid = options.time_limit is not None
        index, result = refine_to_any(
            goals,
            refine,
            order=order_by_tree(refiner, goals)
            if first_valid and len(rows) > 1
            else range(len(rows)),
            min_durations=min_durations(plans[rows]) if len(rows) > 1 else np.zeros(1),
            first_valid=first_valid,
        )
        results.append((rows[index], result))
    return results


def prepare(plans: Plans, options: RefineOptions) -> Refiner:
    """Return the refiner for plans; kernels that are not in the cache are compiled."""
    return _refiner(
        plans.problem,
        plans.motion.spec,
        # These options belong to tasks: refiners that differ in them only are shared.
        replace(options, deadline=None, stay_within=None, time_limit=None),
    )


def tasks_of(plans: Plans) -> list[RefinementTask]:
    """Return the boundary problem of every plan, with the plan as input plan."""
    ends = plans.columns["start_xyz"], plans.columns["goal_xyz"]
    return _tasks(plans.boundary, plans.scene, *ends, plans.motion)


def load_solver(problem: Problem, robot: Robot, kernels: KernelLibrary) -> Solver:
    """Load a function that plans rows of a dataset with the problem's own objective, in one thread.

    Returns:
        A function of the columns of N rows, shape (N, width) each, among them
        ``obstacle_poses`` of scenes, and of N motions as initial guesses, or None. It
        returns N motions and the mask of those that the verdict accepts, (N,).
    """
    refiner = Refiner(problem, robot, kernels=kernels)
    checker = PlanChecker(problem, robot, degree=refiner.spec.degree)
    spec = refiner.spec

    def solve(
        columns: Mapping[str, Array], initial_guess: Motion | None = None
    ) -> tuple[Motion, Mask]:
        ends = columns["start_xyz"], columns["goal_xyz"]
        boundary = Boundary.from_batch(columns, None)
        velocity = goal_velocities(problem, robot, boundary.goal_q, boundary.goal_dq)
        poses = columns.get(OBSTACLE_POSES)
        scene = scene_of(
            problem, *ends, velocity, boundary.parameters, obstacle_poses=poses
        )
        tasks = _tasks(boundary, scene, *ends, initial_guess)
        results = [refine_task(refiner, checker, task) for task in tasks]
        path = np.array([result.path for result in results]).reshape(
            -1, spec.path_control_points, robot.n
        )
        rate = np.array([result.rate for result in results]).reshape(
            -1, spec.rate_control_points
        )
        return Motion(path, rate, spec.degree), np.array(
            [result.valid for result in results], bool
        )

    return solve


def _tasks(
    boundary: Boundary,
    scene: Scene,
    start_xyz: Array,
    goal_xyz: Array,
    plan: Motion | None,
) -> list[RefinementTask]:
    tasks = [
        RefinementTask(boundary[i : i + 1], scene[i], start_xyz[i], goal_xyz[i])
        for i in range(len(boundary))
    ]
    if plan is None:
        return tasks
    return [
        replace(task, path=plan.path[i], rate=plan.rate[i])
        for i, task in enumerate(tasks)
    ]


@lru_cache(maxsize=8)
def _checker(record: ProblemRecord, degree: int, _thread: int) -> PlanChecker:
    """Return the plan checker of a thread: Pinocchio's and Coal's memory must not be shared."""
    return PlanChecker(*open_problem(record), degree=degree)


@lru_cache(maxsize=8)
def _refiner(
    record: ProblemRecord, spec: TrajectorySpec, options: RefineOptions
) -> Refiner:
    problem, robot = open_problem(record)
    coarser = (
        _refiner(record, problem.trajectory, options)
        if is_finer(spec, problem.trajectory)
        else None
    )
    return Refiner(problem, robot, spec=spec, options=options, coarser=coarser)
