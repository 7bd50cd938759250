"""Refining some plans in one process: the refiner of their problem is built once and kept."""

from functools import lru_cache
from threading import get_ident
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.plans.plans import Plans
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.record import ProblemRecord, open_problem
from cnpgen.refine.jury import Jury
from cnpgen.refine.options import DEFAULT, RefineOptions
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Passes, Refiner
from cnpgen.refine.solver.criterion import choose_criterion
from cnpgen.refine.solver.sqp import Settings
from cnpgen.refine.task import Refined, Task
from cnpgen.trajectory.spec import TrajectorySpec

if TYPE_CHECKING:
    from cnpgen.problems.problem import Problem
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


def refine_part(plans: Plans, options: RefineOptions) -> list[Refined]:
    """Refine plans, each for itself: neither the others nor their order change what comes of it.

    Args:
        plans: The plans; where control points are not finite or rates not positive, one is made from nothing.
        options: How to.
    """
    refiner = prepare(plans, options)
    jury = _jury(plans.problem, plans.degree, options.step, get_ident())
    return [refine_task(refiner, jury, task) for task in tasks_of(plans)]


def prepare(plans: Plans, options: RefineOptions) -> Refiner:
    """Return the refiner for plans; kernels that are not in the cache are compiled."""
    spec = TrajectorySpec(
        degree=plans.degree,
        path_control_points=plans.path_control_points.shape[1],
        rate_control_points=plans.rate_control_points.shape[1],
    )
    return _refiner(plans.problem, spec, options)


def tasks_of(plans: Plans) -> list[Task]:
    """Return the boundary problem of every plan, with its control points as a start."""
    problem, _ = open_problem(plans.problem)
    starts, goals = plans.columns["start_xyz"], plans.columns["goal_xyz"]
    tops = obstacle_tops(problem, starts, goals)
    return [
        Task(plans.boundary[i : i + 1], tops[i], starts[i], goals[i], path, rate)
        for i, (path, rate) in enumerate(zip(plans.path_control_points, plans.rate_control_points, strict=True))
    ]


@lru_cache(maxsize=8)
def _jury(record: ProblemRecord, degree: int, step: float, _thread: int) -> Jury:
    """Return the jury of a thread: Pinocchio's and Coal's memory is not to be shared."""
    return Jury(*open_problem(record), degree=degree, step=step)


@lru_cache(maxsize=2)
def _refiner(record: ProblemRecord, spec: TrajectorySpec, options: RefineOptions) -> Refiner:
    problem, robot = open_problem(record)
    return load_refiner(problem, robot, spec=spec, options=options)


def load_refiner(
    problem: "Problem",
    robot: "Robot",
    *,
    spec: TrajectorySpec | None = None,
    options: RefineOptions = DEFAULT,
    passes: Passes | None = None,
) -> Refiner:
    """Build the refiner of a problem with the fastest kernels that this machine can run.

    Args:
        problem: The problem.
        robot: Its robot.
        spec: Degree and numbers of control points; the problem's by default.
        options: How to refine.
        passes: Grids and tightening; the usual ones by default.
    """
    from cnpgen.world.state import World

    backend, cache_folder = choose_backend(None)
    settings = Settings(cost_tolerance=options.tolerance, max_iterations=options.max_iterations)
    return Refiner(
        problem,
        robot,
        kernels=problem_kernels(problem, robot, backend, cache_folder),
        world=World(robot, problem.obstacle, problem.object_size),
        spec=spec,
        criterion=choose_criterion(problem, options.objective, options.weight),
        settings=settings,
        passes=passes,
        solver=options.solver,
    )
