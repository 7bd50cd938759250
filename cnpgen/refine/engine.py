"""Building the refiner of a problem with all that it needs, and refining plans with it in one process."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from threading import get_ident
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.library import KernelLibrary, choose_backend, problem_kernels
from cnpgen.plans.plans import Plans
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.record import ProblemRecord, open_problem
from cnpgen.refine.deadline import refine_until
from cnpgen.refine.jury import Jury
from cnpgen.refine.options import DEFAULT, RefineOptions
from cnpgen.refine.passes import Passes
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.criterion import choose_criterion
from cnpgen.refine.solver.sqp import Settings
from cnpgen.refine.task import Refined, Task
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.rest import is_finer
from cnpgen.trajectory.spec import TrajectorySpec

if TYPE_CHECKING:
    from cnpgen.problems.problem import Problem
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


class Solver(Protocol):
    """What ``load_solver`` returns."""

    def __call__(self, columns: Mapping[str, Array], given: Motion | None = None) -> tuple[Motion, NDArray[np.bool_]]:
        """Make N motions; say which are valid."""


def refine_part(plans: Plans, options: RefineOptions) -> list[Refined]:
    """Refine plans, each for itself: neither the others nor their order change what comes of it.

    Args:
        plans: The plans; where control points are not finite or rates not positive, one is made from nothing.
        options: How to.
    """
    refiner = prepare(plans, options)
    jury = _jury(plans.problem, plans.degree, get_ident())
    if options.deadline is not None:
        return [refine_until(refiner, jury, task, options.deadline) for task in tasks_of(plans)]
    return [refine_task(refiner, jury, task) for task in tasks_of(plans)]


def prepare(plans: Plans, options: RefineOptions) -> Refiner:
    """Return the refiner for plans; kernels that are not in the cache are compiled."""
    spec = TrajectorySpec(
        degree=plans.degree,
        path_control_points=plans.path_control_points.shape[1],
        rate_control_points=plans.rate_control_points.shape[1],
    )
    return _refiner(plans.problem, spec, replace(options, deadline=None))


def tasks_of(plans: Plans) -> list[Task]:
    """Return the boundary problem of every plan, with its control points as a start."""
    problem, _ = open_problem(plans.problem)
    tasks = _tasks(problem, plans.boundary, plans.columns["start_xyz"], plans.columns["goal_xyz"])
    control_points = zip(plans.path_control_points, plans.rate_control_points, strict=True)
    return [replace(task, path=path, rate=rate) for task, (path, rate) in zip(tasks, control_points, strict=True)]


def load_solver(problem: "Problem", robot: "Robot", kernels: KernelLibrary) -> Solver:
    """Load what makes plans for rows of a dataset with the problem's own objective, in one thread.

    Args:
        problem: The problem.
        robot: Its robot.
        kernels: Where kernels are loaded from.

    Returns:
        A function of the columns of N rows, shape (N, width) each, and of N motions to begin with, from nothing by
        default, that returns N motions and which of them the verdict calls valid, shape (N,).
    """
    refiner = load_refiner(problem, robot, kernels=kernels)
    jury, spec = Jury(problem, robot, degree=refiner.spec.degree), refiner.spec

    def solve(columns: Mapping[str, Array], given: Motion | None = None) -> tuple[Motion, NDArray[np.bool_]]:
        tasks = _tasks(problem, Boundary.from_batch(columns, None), columns["start_xyz"], columns["goal_xyz"])
        if given is not None:
            tasks = [replace(each, path=given.path[i], rate=given.rate[i]) for i, each in enumerate(tasks)]
        found = [refine_task(refiner, jury, task) for task in tasks]
        path = np.array([each.path for each in found]).reshape(len(found), spec.path_control_points, robot.n)
        rate = np.array([each.rate for each in found]).reshape(len(found), spec.rate_control_points)
        return Motion(path, rate, spec.degree), np.array([each.valid for each in found], bool)

    return solve


def _tasks(problem: "Problem", boundary: Boundary, start_xyz: Array, goal_xyz: Array) -> list[Task]:
    tops = obstacle_tops(problem, start_xyz, goal_xyz)
    return [Task(boundary[i : i + 1], tops[i], start_xyz[i], goal_xyz[i]) for i in range(len(boundary))]


@lru_cache(maxsize=8)
def _jury(record: ProblemRecord, degree: int, _thread: int) -> Jury:
    """Return the jury of a thread: Pinocchio's and Coal's memory is not to be shared."""
    return Jury(*open_problem(record), degree=degree)


@lru_cache(maxsize=8)
def _refiner(record: ProblemRecord, spec: TrajectorySpec, options: RefineOptions) -> Refiner:
    problem, robot = open_problem(record)
    coarser = _refiner(record, problem.trajectory, options) if is_finer(spec, problem.trajectory) else None
    return load_refiner(problem, robot, spec=spec, options=options, coarser=coarser)


def load_refiner(
    problem: "Problem",
    robot: "Robot",
    *,
    spec: TrajectorySpec | None = None,
    options: RefineOptions = DEFAULT,
    kernels: KernelLibrary | None = None,
    passes: Passes | None = None,
    coarser: Refiner | None = None,
) -> Refiner:
    """Build the refiner of a problem.

    Args:
        problem: The problem.
        robot: Its robot.
        spec: Degree and numbers of control points; the problem's by default.
        options: How to refine.
        kernels: Where kernels are loaded from; by default the fastest that this machine can run.
        passes: Grids and tightening; the usual ones by default.
        coarser: A refiner for the problem's own control points, where ``spec`` has several spans for each of theirs.
    """
    from cnpgen.world.state import World

    if kernels is None:
        kernels = problem_kernels(problem, robot, *choose_backend(None))
    settings = Settings(cost_tolerance=options.tolerance, max_iterations=options.max_iterations)
    return Refiner(
        problem,
        robot,
        kernels=kernels,
        world=World(robot, problem.obstacle, problem.object_size),
        spec=spec,
        criterion=choose_criterion(problem, options.objective, options.weight),
        settings=settings,
        passes=passes,
        coarser=coarser,
    )
