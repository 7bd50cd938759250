"""The refiner: exact derivatives, plans that the independent verdict calls valid, honest outcomes."""

from functools import cache

import numpy as np
import pytest
from example_plans import PROBLEMS, ROBOTS, Plan, load

from cnpgen.kernels.compiled import find_compiler
from cnpgen.kernels.library import KernelLibrary, default_cache_folder
from cnpgen.refine.refiner import Outcome, Refiner
from cnpgen.refine.sqp import Bounds, Settings, minimise
from cnpgen.refine.transcription import Transcription, make_grid, stage_jacobian, stage_values
from cnpgen.robots.obstacles import obstacle_tops
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from cnpgen.verdict import judge
from cnpgen.verify.world import World

LABELS = ("hit", "replan", "transport")


@cache
def library(name: str) -> KernelLibrary:
    problem, robot = PROBLEMS[name], ROBOTS[name]
    backend = "compiled" if find_compiler() else "numpy"
    return KernelLibrary(backend, default_cache_folder(), problem.digest, {"robot": robot, "problem": problem})


@cache
def refiner(name: str) -> Refiner:
    return Refiner(PROBLEMS[name], ROBOTS[name], kernels=library(name), world=World(PROBLEMS[name], ROBOTS[name]))


def tops(plan: Plan) -> np.ndarray:
    return obstacle_tops(plan.problem, plan.start_xyz, plan.goal_xyz)[0]


def transcription(plan: Plan, points: int, boundary: Boundary | None = None) -> Transcription:
    kernels = library(plan.problem.name)
    return Transcription(
        plan.problem,
        make_grid(plan.problem, points),
        values=kernels.load(stage_values),
        jacobian=kernels.load(stage_jacobian),
        boundary=plan.boundary if boundary is None else boundary,
        tops=tops(plan),
    )


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize("goal_acceleration", [False, True])
def test_gradients_of_residuals_and_objective_are_those_of_finite_differences(
    label: str, goal_acceleration: bool
) -> None:
    plan = load(label)
    b = plan.boundary
    boundary = (
        Boundary(b.start_q, b.start_dq, b.start_ddq, b.goal_q, b.goal_dq, b.goal_dq * 0 + 0.3)
        if goal_acceleration
        else b
    )
    motion = transcription(plan, 24, boundary)
    random = np.random.default_rng(0)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0]) + 0.02 * random.normal(size=motion.nx)
    at = motion.evaluate(x)
    k, which = np.nonzero(np.ones(at.g.shape, bool))
    rows = motion.rows(at, k, which)
    step = 1e-6
    for variable in random.choice(motion.nx, 25, replace=False):
        up, down = (motion.value(x + sign * step * np.eye(motion.nx)[variable]) for sign in (1, -1))
        slope = (up[1] - down[1]).ravel() / (2 * step)
        size = 1 + np.abs(rows[:, variable]).max()
        np.testing.assert_allclose(rows[:, variable], slope, atol=2e-6 * size)
        assert at.gradient[variable] == pytest.approx((up[0] - down[0]) / (2 * step), abs=1e-7)


def test_residuals_are_the_constraints_of_the_problem_in_their_natural_sizes() -> None:
    plan = load("hit")
    motion = transcription(plan, 32)
    _, g = motion.value(motion.pack(plan.motion.path[0], plan.motion.rate[0]))
    states = plan.motion.at(motion.grid.s)
    np.testing.assert_allclose(g[:, 6:12], states.dq[0] / plan.robot.velocity_limit, atol=1e-12)
    np.testing.assert_allclose(g[:, 12:18], states.ddq[0] / plan.robot.acceleration_limit, atol=1e-10)


@pytest.mark.parametrize("label", LABELS)
def test_a_plan_from_nothing_is_valid_by_the_independent_verdict(label: str) -> None:
    plan = load(label)
    found = refiner(plan.problem.name).refine(plan.boundary, tops=tops(plan), start_tip=plan.start_xyz[0])
    assert found.outcome in {Outcome.SOLVED, Outcome.POLISHED, Outcome.RESTARTED}
    (verdict,) = judge(
        plan.problem,
        plan.robot,
        Motion(found.path[None], found.rate[None]),
        plan.boundary,
        plan.start_xyz,
        plan.goal_xyz,
    )
    assert verdict.valid, verdict.reason


@pytest.mark.parametrize("label", LABELS)
def test_a_disturbed_plan_is_repaired_and_not_much_slower(label: str) -> None:
    plan = load(label)
    bent = plan.motion.path[0].copy()
    bent[3:-2] += 0.01 * np.sin(np.arange(bent[3:-2].size)).reshape(bent[3:-2].shape)
    tool = refiner(plan.problem.name)
    found = tool.refine(
        plan.boundary, tops=tops(plan), start_tip=plan.start_xyz[0], path=bent, rate=plan.motion.rate[0] * 1.04
    )
    assert found.excess <= 1
    duration = Motion(found.path[None], found.rate[None]).duration()[0]
    assert duration < 1.02 * plan.motion.duration()[0]


def test_a_plan_that_cannot_be_improved_is_kept_as_it_is() -> None:
    plan = load("hit")
    tool = refiner("airhockey")
    once = tool.refine(plan.boundary, tops=tops(plan), start_tip=plan.start_xyz[0])
    again = tool.refine(plan.boundary, tops=tops(plan), start_tip=plan.start_xyz[0], path=once.path, rate=once.rate)
    before, after = (Motion(each.path[None], each.rate[None]).duration()[0] for each in (once, again))
    assert again.excess <= 1
    assert after <= before * (1 + 1e-6)


def test_an_impossible_problem_ends_with_its_best_plan_and_says_so() -> None:
    plan = load("hit")
    b = plan.boundary
    too_fast = Boundary(
        b.start_q, b.start_dq, b.start_ddq, b.goal_q, b.goal_dq * 3.0
    )  # three times the limit at the goal
    found = refiner("airhockey").refine(too_fast, tops=tops(plan), start_tip=plan.start_xyz[0])
    assert found.outcome is Outcome.UNSOLVED
    assert found.excess > 1
    assert np.isfinite(found.path).all()


def test_the_iteration_never_ends_worse_than_it_began() -> None:
    plan = load("replan")
    motion = transcription(plan, 48)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0])
    _, g = motion.value(x)
    bounds = Bounds(np.full(g.shape, -1.0), np.full(g.shape, 1.0))
    cost, g = motion.value(x)
    result = minimise(motion, bounds, x, Settings(max_iterations=5))
    merit = Settings().penalty
    assert result.cost + merit * result.violation <= cost + merit * bounds.violation(g) + 1e-12
