"""Refiners of the shipped problems, and of problems that differ from them only in their bounds."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from cnpgen.judges.plans import Verdict, judge
from cnpgen.kernels.library import KernelLibrary, choose_backend, problem_kernels
from cnpgen.problems.objectives import ObjectiveTerm, read_objective
from cnpgen.problems.problem import Problem
from cnpgen.refine.grid_levels import GridLevels
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.compiled_backend import load_step_library
from cnpgen.refine.solver.grid import make_grid
from cnpgen.refine.solver.residuals import (
    CostTerm,
    cost_term_residuals,
    residual_counts,
    stage_jacobian,
    stage_values,
)
from cnpgen.refine.solver.transcription import ResidualKernels, Transcription
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Attempt, RefinementTask
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.examples.plans import PROBLEMS, ROBOTS, Plan


def cost_term_of(name: str, weight: float) -> CostTerm:
    """Return a cost term of one registered kind."""
    terms = read_objective(f"{name}={weight}")
    assert terms is not None
    return CostTerm(terms)


def transcription_of(
    plan: Plan, points: int, terms: tuple[ObjectiveTerm, ...]
) -> Transcription:
    """Return the transcription of a plan's problem with an objective, interpreted: faster than compiling."""
    kernels, spec = library(plan.problem.name), plan.problem.trajectory
    stages = [kernels.load(builder) for builder in (stage_values, stage_jacobian)]
    parts: tuple[Any, ...] = ()
    if terms:
        cost_term = CostTerm(terms)
        residuals = replace(kernels, backend="numpy").load(
            cost_term_residuals, terms=cost_term.tables
        )
        parts = cost_term, residuals, residual_counts(plan.robot, cost_term)
    grid = make_grid(spec, points)
    return Transcription(
        ResidualKernels(spec, *stages, load_step_library(kernels), *parts),
        grid,
        boundary=plan.boundary,
        obstacle_poses=obstacle_poses(plan),
    )


@cache
def library(name: str) -> KernelLibrary:
    problem, robot = PROBLEMS[name], ROBOTS[name]
    return problem_kernels(problem, robot, *choose_backend(None))


@cache
def refiner(name: str, **options: Any) -> Refiner:
    return refiner_of(PROBLEMS[name], **options)


def refiner_of(
    problem: Problem,
    *,
    spec: TrajectorySpec | None = None,
    levels: GridLevels | None = None,
    **options: Any,
) -> Refiner:
    """Return the refiner of a problem with the residuals of the shipped one, by default without a cost term."""
    robot, kernels = ROBOTS[problem.name], library(problem.name)
    return Refiner(
        problem,
        robot,
        kernels=kernels,
        spec=spec,
        levels=levels,
        options=RefineOptions(**{"weight": 0.0, **options}),
    )


def obstacle_poses(plan: Plan) -> np.ndarray:
    return np.asarray(plan.scene.poses[0])


def task(
    plan: Plan, boundary: Boundary | None = None, **input_plan: np.ndarray
) -> RefinementTask:
    return RefinementTask(
        boundary or plan.boundary,
        plan.scene,
        plan.start_xyz[0],
        plan.goal_xyz[0],
        **input_plan,
    )


def verdict(
    plan: Plan, boundary: Boundary, path: np.ndarray, rate: np.ndarray
) -> Verdict:
    return judge(
        plan.problem,
        plan.robot,
        Motion(path[None], rate[None]),
        boundary,
        plan.scene,
        plan.goal_xyz,
    )[0]


def refine(
    plan: Plan, boundary: Boundary | None = None, **input_plan: np.ndarray
) -> Attempt:
    checker = PlanChecker(
        plan.problem, plan.robot, degree=plan.problem.trajectory.degree
    )
    shipped = plan.problem is PROBLEMS[plan.problem.name]
    tool = refiner(plan.problem.name) if shipped else refiner_of(plan.problem)
    return refine_task(tool, checker, task(plan, boundary, **input_plan))
