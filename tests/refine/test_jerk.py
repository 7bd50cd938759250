"""Limited jerks in the refiner: exact derivatives, and plans whose jerks are within their limits from the start on."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cnpgen.kernels.compiler import find_compiler
from cnpgen.kernels.library import default_cache_folder, problem_kernels
from cnpgen.refine.fine import FineCheck
from cnpgen.refine.jury import Jury
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.grid import BEGINNING, make_grid
from cnpgen.refine.solver.transcription import Transcription
from cnpgen.refine.task import Outcome
from cnpgen.trajectory.motion import Motion
from cnpgen.world.state import World
from tests.examples.jerky import jerky, jerky_plan
from tests.examples.plans import course, load
from tests.examples.refiner import refine, task, tops, verdict


@cache
def jerky_refiner(name: str) -> Refiner:
    problem, robot = jerky(name)
    backend = "compiled" if find_compiler() and name == "airhockey" else "numpy"  # of the other one little is asked
    kernels = problem_kernels(problem, robot, backend, default_cache_folder())
    return Refiner(problem, robot, kernels=kernels, world=World(robot, problem.obstacle, problem.object_size))


@pytest.mark.slow
def test_gradients_of_residuals_with_jerks_are_those_of_finite_differences() -> None:
    plan, tool = jerky_plan("hit"), jerky_refiner("airhockey")
    grid = make_grid(tool.spec, 24, plan.problem.path_orders)
    for goal_ddq in (None, plan.boundary.goal_dq * 0 + 0.3):
        motion = Transcription(tool.stage, grid, boundary=replace(plan.boundary, goal_ddq=goal_ddq), tops=tops(plan))
        random = np.random.default_rng(0)
        x = motion.pack(plan.motion.path[0], plan.motion.rate[0]) + 0.02 * random.normal(size=motion.nx)
        at = motion.evaluate(x)
        k, which = np.nonzero(np.ones(at.g.shape, bool))
        rows = motion.rows(at, k, which)
        for column in random.integers(0, motion.nx, 12):
            step = 1e-6 * np.eye(motion.nx)[column]
            expected = ((motion.value(x + step)[1] - motion.value(x - step)[1]) / 2e-6)[k, which]
            np.testing.assert_allclose(rows[:, column], expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max() + 1e-7)


@pytest.mark.slow
def test_the_residuals_of_jerks_are_those_of_scipys_splines_from_the_start_on() -> None:
    plan, tool = jerky_plan("hit"), jerky_refiner("airhockey")
    motion = tool.transcription(task(plan), tool.passes.first)
    assert motion.grid.s[0] == BEGINNING
    _, g = motion.value(motion.pack(plan.motion.path[0], plan.motion.rate[0]))
    exact = plan.motion.at(motion.grid.s).jerk[0] / plan.robot.jerk_limit
    np.testing.assert_allclose(g[:, -plan.robot.n :], exact, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("label", ["hit", pytest.param("transport", marks=pytest.mark.extended)])
def test_a_plan_from_nothing_keeps_the_limits_of_jerks_that_the_plan_without_them_breaks(label: str) -> None:
    plan = jerky_plan(label)
    jury = Jury(plan.problem, plan.robot, degree=7)
    found = refine_task(jerky_refiner(plan.problem.name), jury, task(plan))
    assert found.valid, found
    assert found.outcome in {Outcome.SOLVED, Outcome.POLISHED}
    limit = plan.robot.jerk_limit * (1 + 0.01)
    smooth = course(plan.changed(path=found.path[None], rate=found.rate[None]), 20_001)
    assert (np.abs(smooth.jerk) <= limit * (1 + 1e-6)).all()
    assert (np.abs(smooth.jerk) / limit).max() > 0.9  # the limits cost time: some are used to the full
    free = refine(load(label))
    rough = course(plan.changed(path=free.path[None], rate=free.rate[None]), 20_001)
    assert (np.abs(rough.jerk) > 2 * limit).any()
    assert not verdict(plan, plan.boundary, free.path, free.rate).valid


@pytest.mark.slow
def test_the_fine_check_slows_motions_down_by_the_cube_root_of_what_their_jerks_need() -> None:
    plan, tool = jerky_plan("transport"), jerky_refiner("heavy-object")
    check: FineCheck = tool.check
    x = check.transcription(task(plan)).pack(plan.motion.path[0], plan.motion.rate[0])
    _, excess = check.measure(task(plan), x)
    s = check.transcription(task(plan)).grid.s
    worst = np.abs(plan.motion.at(s).jerk[0] / plan.robot.jerk_limit).max()
    assert excess.slower == pytest.approx(np.cbrt(worst), rel=1e-6)
    slowed, _, after = check.slow_down(task(plan), check.transcription(task(plan)), x, at_any_cost=True)
    assert after.worst <= 1
    path, rate = check.transcription(task(plan)).unpack(slowed)
    jerk = Motion(path[None], rate[None]).at(s).jerk[0]
    assert (np.abs(jerk) <= 1.011 * plan.robot.jerk_limit).all()
