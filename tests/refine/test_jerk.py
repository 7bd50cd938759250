"""Jerk limits in the refiner: exact derivatives, and plans whose jerks are within their limits from the start."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy_transcription import evaluate, regularized_values, residual_gradients

from cnpgen.kernels.library import default_cache_folder, problem_kernels
from cnpgen.refine.fine_check import FineCheck
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.grid import FIRST_JERK_PHASE, make_grid
from cnpgen.refine.solver.transcription import Transcription
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Outcome
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.jerk_limits import jerk_limited, jerk_limited_plan
from tests.examples.plans import load, reference_trajectory
from tests.examples.refiner import obstacle_poses, refine, task, verdict


@cache
def jerk_limited_refiner(name: str) -> Refiner:
    problem, robot = jerk_limited(name)
    # The other problem needs few evaluations.
    backend = "compiled" if name == "airhockey" else "numpy"
    kernels = problem_kernels(problem, robot, backend, default_cache_folder())
    return Refiner(problem, robot, kernels=kernels, options=RefineOptions(weight=0.0))


@pytest.mark.slow
def test_gradients_of_residuals_with_jerks_are_those_of_finite_differences() -> None:
    plan, tool = jerk_limited_plan("hit"), jerk_limited_refiner("airhockey")
    grid = make_grid(tool.spec, 24, plan.problem.path_orders)
    for goal_ddq in (None, plan.boundary.goal_dq * 0 + 0.3):
        motion = Transcription(
            tool.residual_kernels,
            grid,
            boundary=replace(plan.boundary, goal_ddq=goal_ddq),
            obstacle_poses=obstacle_poses(plan),
        )
        random = np.random.default_rng(0)
        x = motion.pack(
            plan.motion.path[0], plan.motion.rate[0]
        ) + 0.02 * random.normal(size=motion.nx)
        at = evaluate(motion, x)
        k, residual = np.nonzero(np.ones(at.g.shape, bool))
        rows = residual_gradients(motion, at, k, residual)
        for column in random.integers(0, motion.nx, 12):
            step = 1e-6 * np.eye(motion.nx)[column]
            expected = (
                (
                    regularized_values(motion, x + step)[1]
                    - regularized_values(motion, x - step)[1]
                )
                / 2e-6
            )[k, residual]
            np.testing.assert_allclose(
                rows[:, column],
                expected,
                rtol=1e-4,
                atol=1e-5 * np.abs(expected).max() + 1e-7,
            )


@pytest.mark.slow
def test_the_residuals_of_jerks_are_those_of_scipy_splines_from_the_start() -> None:
    plan, tool = jerk_limited_plan("hit"), jerk_limited_refiner("airhockey")
    motion = tool.transcription(task(plan), tool.levels.coarse)
    assert motion.grid.s[0] == FIRST_JERK_PHASE
    _, g = regularized_values(
        motion, motion.pack(plan.motion.path[0], plan.motion.rate[0])
    )
    exact = plan.motion.at(motion.grid.s).jerk[0] / plan.robot.jerk_limit
    np.testing.assert_allclose(g[:, -plan.robot.n :], exact, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "label", ["hit", pytest.param("transport", marks=pytest.mark.extended)]
)
def test_a_plan_meets_jerk_limits_that_the_plan_without_them_violates(
    label: str,
) -> None:
    plan = jerk_limited_plan(label)
    checker = PlanChecker(plan.problem, plan.robot, degree=7)
    found = refine_task(jerk_limited_refiner(plan.problem.name), checker, task(plan))
    assert found.valid, found
    assert found.outcome in {Outcome.SOLVED, Outcome.SOLVED_FINE}
    limit = plan.robot.jerk_limit * (1 + 0.01)
    smooth = reference_trajectory(
        plan.changed(path=found.path[None], rate=found.rate[None]), 20_001
    )
    assert (np.abs(smooth.jerk) <= limit * (1 + 1e-6)).all()
    assert (np.abs(smooth.jerk) / limit).max() > 0.9  # the limits are active
    free = refine(load(label))
    rough = reference_trajectory(
        plan.changed(path=free.path[None], rate=free.rate[None]), 20_001
    )
    assert (np.abs(rough.jerk) > 2 * limit).any()
    assert not verdict(plan, plan.boundary, free.path, free.rate).valid


@pytest.mark.slow
def test_the_fine_check_scales_time_by_the_cube_root_of_the_jerk_ratio() -> None:
    plan, tool = jerk_limited_plan("transport"), jerk_limited_refiner("heavy-object")
    check: FineCheck = tool.check
    x = check.transcription(task(plan)).pack(plan.motion.path[0], plan.motion.rate[0])
    _, violation = check.measure(task(plan), x)
    s = check.transcription(task(plan)).grid.s
    worst = np.abs(plan.motion.at(s).jerk[0] / plan.robot.jerk_limit).max()
    assert violation.time_scale == pytest.approx(np.cbrt(worst), rel=1e-6)
    time_scaled, _, after = check.scale_time(task(plan), x, unlimited=True)
    assert after.worst <= 1
    path, rate = check.transcription(task(plan)).unpack(time_scaled)
    jerk = Motion(path[None], rate[None]).at(s).jerk[0]
    assert (np.abs(jerk) <= 1.011 * plan.robot.jerk_limit).all()
