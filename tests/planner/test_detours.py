"""Other lines: what the look at plans finds, which line is taken, and that plans which break nothing stay."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.make.boundary_problems import draw_boundary_problems
from cnpgen.planner.detours import Detours, make_detours
from cnpgen.planner.kit import surroundings
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import load_model
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.trajectory.boundary import Boundary
from cnpgen.world.state import World
from tests.conftest import needs_compiler
from tests.examples.models import quickest
from tests.examples.plans import PROBLEMS, ROBOTS, load

RETRACTED = (-0.3, -0.6, 0.2, -1.9, 0.6, 0.3, 1.2)  # rad: far from both pedestals


@pytest.fixture(scope="module")
def model() -> Model:
    found = load_model("heavy-object-anywhere")
    return replace(found, meaning=replace(found.meaning, middles=(RETRACTED,)))


@pytest.fixture(scope="module")
def problems() -> Boundary:
    return draw_boundary_problems("heavy-object-anywhere", 400, seed=20).boundary


def test_what_is_broken_at_rest_is_what_pinocchio_and_coal_say() -> None:
    problem, robot, plan = PROBLEMS["heavy-object"], ROBOTS["heavy-object"], load("transport")
    world, random = World(robot, problem.obstacle, problem.object_size), np.random.default_rng(0)
    tops = obstacle_tops(problem, plan.start_xyz, plan.goal_xyz)[0]
    on_way = plan.motion.at(np.linspace(0, 1, 6)).q[0]
    states = np.concatenate([random.uniform(robot.position_lower, robot.position_upper, (6, robot.n)), on_way])
    detours = make_detours(problem, quickest("heavy-object").kernels, np.empty((0, robot.n)))
    (found,) = detours.excess(np.ascontiguousarray(states.T), np.repeat(tops[:, None], len(states), axis=1))
    for q, excess in zip(states, found[0], strict=True):
        world.set_state(q, 0 * q, 0 * q, tops)
        worst = max(
            float((np.maximum(each.lower - each.g, each.g - each.upper) / constraint.allowed(each)).max())
            for constraint in problem.constraint
            for each in constraint.measured(world)
        )
        assert excess == pytest.approx(worst, rel=1e-6, abs=1e-4)
    assert (found[0, :6] > 1).all()
    assert (found[0, 6:] <= 1).all()


def test_of_lines_those_that_break_nothing_may_be_taken_or_else_the_one_that_breaks_least() -> None:
    detours = Detours(np.zeros((3, 7)), None, None)  # type: ignore[arg-type]
    broken = np.array([0.5, 2.0, 0.9, 7.0, 3.0, 5.0, np.inf, np.inf, 4.0])
    np.testing.assert_array_equal(detours.worth(broken), [0, 2, 4, 8])


@pytest.mark.slow  # it compiles for a minute
@needs_compiler
def test_other_lines_mend_plans_and_leave_those_that_break_nothing(model: Model, problems: Boundary) -> None:
    straight = Planner(replace(model, meaning=replace(model.meaning, middles=()))).plan_batch(problems)
    planner = Planner(model)
    found, kit = planner.plan_batch(problems), planner._kit
    assert kit.detours is not None
    tops = kit.prepare.tops(found.columns["start_xyz"], found.columns["goal_xyz"])
    before, after = (kit.detours.broken(plans.motion, tops) for plans in (straight, found))
    same = (found.path_control_points == straight.path_control_points).all(axis=(1, 2))
    assert same[before <= 1].all()
    assert (after[~same] < before[~same]).all()
    mended = np.flatnonzero((before > 1) & (after <= 1))
    assert len(mended) >= 3
    assert evaluate_plans(found[mended], workers=1).valid.mean() > 0.5
    assert not evaluate_plans(straight[mended], workers=1).valid.any()


@needs_compiler
@pytest.mark.slow  # likewise
def test_a_line_with_a_corner_passes_near_it_and_keeps_its_ends(model: Model, problems: Boundary) -> None:
    with surroundings(model.problem) as given:
        prepare = Planner(model)._kit.prepare
        lower, upper = given.robot.position_lower, given.robot.position_upper
    some, middle = problems[:20], np.tile(RETRACTED, (20, 1))
    straight, bent = prepare(some), prepare(some, middle)
    assert straight.correction is not None
    assert bent.correction is not None
    half = (some.start_q + some.goal_q) / 2
    before, after = (np.abs(half + each.correction[:, 4:6].mean(axis=1) - middle) for each in (straight, bent))
    assert np.median(after.max(axis=1)) < 0.6 * np.median(before.max(axis=1))
    ends = np.linspace(0, 1, 10)[:, None]
    line = some.start_q[:, None] + (some.goal_q - some.start_q)[:, None] * ends + bent.correction
    assert (line >= lower - 1e-9).all()
    assert (line <= upper + 1e-9).all()
