"""The refiner for the tests: of the shipped problems, and of ones that differ from them in their bounds only."""

from functools import cache

import numpy as np
import pytest

from cnpgen.judges.plans import Verdict, judge
from cnpgen.kernels.compiler import find_compiler
from cnpgen.kernels.library import KernelLibrary, default_cache_folder, problem_kernels
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.refine.jury import Jury
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.criterion import Criterion
from cnpgen.refine.task import Refined, Task
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from cnpgen.world.state import World
from tests.examples.plans import PROBLEMS, ROBOTS, Plan

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")


@cache
def library(name: str) -> KernelLibrary:
    problem, robot = PROBLEMS[name], ROBOTS[name]
    backend = "compiled" if find_compiler() else "numpy"
    return problem_kernels(problem, robot, backend, default_cache_folder())


@cache
def refiner(name: str, criterion: Criterion | None = None) -> Refiner:
    return refiner_of(PROBLEMS[name], criterion)


def refiner_of(problem: Problem, criterion: Criterion | None = None, **options: object) -> Refiner:
    """The refiner of a problem whose residuals are those of the shipped one."""
    robot, kernels = ROBOTS[problem.name], library(problem.name)
    return Refiner(
        problem,
        robot,
        kernels=kernels,
        world=World(robot, problem.obstacle, problem.object_size),
        criterion=criterion,
        **options,
    )


def tops(plan: Plan) -> np.ndarray:
    return obstacle_tops(plan.problem, plan.start_xyz, plan.goal_xyz)[0]


def task(plan: Plan, boundary: Boundary | None = None, **given: np.ndarray) -> Task:
    return Task(boundary or plan.boundary, tops(plan), plan.start_xyz[0], plan.goal_xyz[0], **given)


def verdict(plan: Plan, boundary: Boundary, path: np.ndarray, rate: np.ndarray) -> Verdict:
    return judge(plan.problem, plan.robot, Motion(path[None], rate[None]), boundary, plan.start_xyz, plan.goal_xyz)[0]


def refine(plan: Plan, boundary: Boundary | None = None, **given: np.ndarray) -> Refined:
    jury = Jury(plan.problem, plan.robot, degree=plan.problem.trajectory.degree)
    shipped = plan.problem is PROBLEMS[plan.problem.name]
    tool = refiner(plan.problem.name) if shipped else refiner_of(plan.problem)
    return refine_task(tool, jury, task(plan, boundary, **given))
