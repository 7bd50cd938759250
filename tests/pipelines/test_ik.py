"""Inverse kinematics of start and goal: what Pinocchio says of the solutions."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.pipelines.stages.ik import MAX_STEPS, TOLERANCE, GoalIK, ik_step
from cnpgen.pipelines.stages.stage import Round, TaskRound
from cnpgen.schema import registry
from cnpgen.schema.catalogue import read_kind
from cnpgen.schema.keys import Place
from tests.conftest import Arm, Prepare, run_stages

EXACT = 1e-9  # m and rad
ENDS = [("airhockey-hit", "start"), ("airhockey-replan", "start"), ("heavy-object", "start"), ("heavy-object", "goal")]


@pytest.fixture(scope="module", params=ENDS, ids=" ".join)
def solved(request: pytest.FixtureRequest, prepare: Prepare) -> tuple[PreparedPipeline, str, Round]:
    """Enough draws for some that end with joints on their limits, where convergence is slow."""
    name, end = request.param
    until = {"start": "StartIK", "goal": "GoalIK"}[end]
    draws = 40_000 if name == "heavy-object" else 4000
    return prepare(name), end, run_stages(prepare(name), draws, seed=31, until=until)


def test_the_tip_is_at_its_position_within_a_nanometre(solved):
    prepared, end, draws = solved
    arm = Arm(prepared.context.robot)
    found = np.array([arm.pose(q).translation.copy() for q in draws[f"{end}_q"].T])
    assert np.linalg.norm(found - draws[f"{end}_xyz"].T, axis=1).max() < EXACT


def test_every_joint_is_within_its_limits(solved):
    prepared, end, draws = solved
    robot = prepared.context.robot
    assert np.all(robot.position_lower[:, None] <= draws[f"{end}_q"])
    assert np.all(draws[f"{end}_q"] <= robot.position_upper[:, None])


def test_almost_every_draw_has_a_solution(solved):
    prepared, _, draws = solved
    apart = np.sum(draws.fate == 1 + draws.reasons.index("too close together"))
    yielded = len(draws.alive) / (draws.size - apart)
    assert yielded > (0.99 if prepared.context.robot.n == 6 else 0.6)


@pytest.mark.parametrize("end", ["start", "goal"])
def test_the_held_object_stands_upright(prepare, end):
    prepared = prepare("heavy-object")
    draws = run_stages(prepared, 20_000, seed=32, until="GoalIK")
    arm = Arm(prepared.context.robot)
    up = np.array([arm.pose(q).rotation[:, 2].copy() for q in draws[f"{end}_q"].T])
    assert np.abs(up[:, :2]).max() < EXACT
    assert up[:, 2].min() > 0


def test_an_object_held_upside_down_is_turned_round(prepare):
    prepared = prepare("heavy-object")
    kernel = prepared.context.kernels.load(ik_step, Loop(TOLERANCE, MAX_STEPS), vertical=True, max_step=0.8)
    good = run_stages(prepared, 400, seed=33, until="StartIK")
    arm = Arm(prepared.context.robot)
    q = good["start_q"].copy()
    q[5] = np.clip(q[5] + np.pi * np.where(q[5] > 0, -1, 1), *np.array([[-2.0], [2.0]]))
    tilted = np.array([arm.pose(x).rotation[2, 2] for x in q.T])
    assert np.sum(tilted < -0.5) > 20
    found, error = kernel(q, good["start_xyz"])
    up = np.array([arm.pose(x).rotation[2, 2] for x in found[:, error[0] < TOLERANCE].T])
    assert len(up) > 100
    np.testing.assert_allclose(up, 1.0, atol=1e-12)


def test_positions_out_of_reach_are_rejected_and_not_approximated(prepare):
    prepared = prepare("airhockey-hit")
    kernel = prepared.context.kernels.load(ik_step, Loop(TOLERANCE, MAX_STEPS), vertical=False, max_step=0.4)
    base = np.repeat(prepared.context.robot.base[:, None], 5, axis=1)
    far = np.array([[3.0, 0.0, 0.16], [1.2, 1.2, 0.16], [0.0, 0.0, 2.9], [5.0, 5.0, 5.0], [0.65, 0.0, 0.16]]).T.copy()
    q, error = kernel(base, far)
    assert np.all(error[0, :4] > 1e-2)
    assert error[0, 4] < TOLERANCE
    assert np.all(np.isfinite(q))


def test_no_step_of_a_joint_is_longer_than_asked(prepare):
    prepared = prepare("airhockey-replan")
    kernel = prepared.context.kernels.load(ik_step, vertical=False, max_step=0.05)
    draws = run_stages(prepared, 300, seed=34, until="StartIK")
    following, _ = kernel(draws["guess_q"], draws["start_xyz"])
    assert np.abs(following - draws["guess_q"]).max() <= 0.05 + 1e-12


def test_steps_never_leave_the_joint_limits_even_from_a_corner(prepare):
    prepared = prepare("heavy-object")
    robot = prepared.context.robot
    kernel = prepared.context.kernels.load(ik_step, vertical=True, max_step=0.8)
    random = np.random.default_rng(35)
    q = np.where(random.random((robot.n, 500)) < 0.5, robot.position_lower[:, None], robot.position_upper[:, None])
    following, _ = kernel(q, random.uniform([0.2, -0.6, 0.2], [0.6, 0.6, 0.5], (500, 3)).T.copy())
    assert np.all(robot.position_lower[:, None] <= following)
    assert np.all(following <= robot.position_upper[:, None])


def test_a_joint_on_its_limit_leaves_the_way_to_the_others(prepare):
    prepared = prepare("airhockey-replan")
    robot, kernels = prepared.context.robot, prepared.context.kernels
    narrow = np.array([np.inf, np.inf, 0.05, np.inf, 0.05, np.inf])
    limits = {
        "position_lower": np.maximum(robot.position_lower, -narrow),
        "position_upper": np.minimum(robot.position_upper, narrow),
    }
    arguments = {**kernels.arguments, "robot": replace(robot, **limits)}
    kernels = replace(kernels, backend="numpy", identity="narrow third and fifth joint", arguments=arguments)
    kernel = kernels.load(ik_step, Loop(TOLERANCE, MAX_STEPS), vertical=False, max_step=0.4)
    draws = run_stages(prepared, 400, seed=37, until="StartIK")
    guess = np.clip(draws["guess_q"], limits["position_lower"][:, None], limits["position_upper"][:, None])
    q, error = kernel(guess, draws["start_xyz"])
    solved = error[0] < TOLERANCE
    assert solved.mean() > 0.95
    assert np.sum(np.abs(q[[2, 4]][:, solved]).max(0) == 0.05) > 10
    assert np.abs(q[[2, 4]]).max() <= 0.05
    arm = Arm(robot)
    found = np.array([arm.pose(x).translation.copy() for x in q[:, solved].T])
    assert np.linalg.norm(found - draws["start_xyz"][:, solved].T, axis=1).max() < EXACT


def test_solutions_do_not_depend_on_how_sine_and_cosine_are_rounded(prepare, kernels_of):
    """The backends' differ in the last bit; few joints left by the limits must not blow that up."""
    prepared = prepare("heavy-object")
    options = {"vertical": True, "max_step": 0.8}
    draws = run_stages(prepared, 6000, seed=38, until="StartIK")
    one, other = (
        kernels_of(prepared, backend).load(ik_step, Loop(TOLERANCE, MAX_STEPS), **options)
        for backend in (prepared.context.kernels.backend, "numpy")
    )
    turned = np.nextafter(draws["guess_q"], np.inf)
    first, second = one(draws["guess_q"], draws["start_xyz"]), other(turned, draws["start_xyz"])
    assert np.mean(np.abs(first[0] - second[0]).max(0) > 1e-9) < 1e-3


def test_the_goal_is_solved_from_the_start(prepare):
    prepared = prepare("heavy-object")
    draws = run_stages(prepared, 1500, seed=36, until="GoalIK")
    kernel = prepared.context.kernels.load(ik_step, Loop(TOLERANCE, MAX_STEPS), vertical=True, max_step=0.8)
    again, _ = kernel(draws["start_q"], draws["goal_xyz"])
    np.testing.assert_array_equal(draws["goal_q"], again)


def test_a_guess_of_the_wrong_length_is_a_mistake_in_the_recipe(prepare):
    prepared = prepare("airhockey-replan")
    stage = prepared.pipeline.stage[1]
    with pytest.raises(RecipeError, match="guess: needs 6 ranges, one per planned joint, got 5"):
        replace(stage, guess=stage.guess[:5]).prepare(prepared.context)


def test_stages_say_what_they_do_with_their_numbers(prepare):
    heavy, hit = prepare("heavy-object").pipeline, prepare("airhockey-hit").pipeline
    goal = next(stage for stage in heavy.stage if isinstance(stage, GoalIK))
    assert goal.describe() == (
        "solve the goal configuration with the tip's z axis vertical from the start configuration"
    )
    assert hit.stage[1].describe() == "solve the start configuration from the base configuration"


@pytest.fixture(scope="module")
def anywhere(prepare: Prepare) -> tuple[PreparedPipeline, Round]:
    """Transports between configurations that were chosen independently of each other, some on joint limits."""
    return prepare("heavy-object-anywhere"), run_stages(prepare("heavy-object-anywhere"), 20_000, seed=39)


def test_joints_that_are_held_end_on_their_limits_to_the_bit(anywhere):
    prepared, _ = anywhere
    draws = run_stages(prepared, 20_000, seed=40, until="StartIK")
    robot = prepared.context.robot
    held, limits = draws["held"].astype(bool), (robot.position_lower[:, None], robot.position_upper[:, None])
    assert set(held.sum(0)) == {0, 1}
    assert held.any(1).all()
    assert np.all(((draws["start_q"] == limits[0]) | (draws["start_q"] == limits[1]))[held])
    arm = Arm(robot)
    found = np.array([arm.pose(q).translation.copy() for q in draws["start_q"].T])
    assert np.linalg.norm(found - draws["start_xyz"].T, axis=1).max() < EXACT


def test_goals_from_guesses_are_those_that_their_guesses_lead_to(anywhere):
    prepared, draws = anywhere
    stage = next(stage for stage in prepared.pipeline.stage if isinstance(stage, GoalIK))
    kernel = prepared.context.kernels.load(ik_step, Loop(TOLERANCE, MAX_STEPS), vertical=True, max_step=0.8, hold=True)
    again, _ = kernel(draws["guess_q"], draws["goal_xyz"], draws["held"])
    np.testing.assert_array_equal(draws["goal_q"], again)
    from_start = (draws["guess_q"] == draws["start_q"]).all(0)
    assert from_start.mean() > stage.from_start
    assert not draws["held"][:, from_start].any()
    change = np.abs(draws["goal_q"] - draws["start_q"]).max(0)
    assert 0.95 * stage.max_change < change.max() <= stage.max_change
    assert np.median(change[~from_start]) > 1.5 * np.median(change[from_start])


def test_tasks_have_goals_that_are_found_from_the_start(prepare, anywhere):
    prepared, draws = anywhere
    stage = next(stage for stage in prepared.pipeline.stage if isinstance(stage, GoalIK))
    round_of, tasks = prepare("heavy-object"), TaskRound(10)
    for name in ("start_q", "goal_xyz"):
        tasks[name] = draws[name][:, :10].copy()
    stage.complete(prepared.context, ("start_q", "goal_xyz"))(tasks, np.random.default_rng(0))
    kernel = round_of.context.kernels.load(ik_step, Loop(TOLERANCE, MAX_STEPS), vertical=True, max_step=0.8)
    again, error = kernel(draws["start_q"][:, :10], draws["goal_xyz"][:, :10])
    np.testing.assert_array_equal(tasks["goal_q"], again[:, error[0] < TOLERANCE])


@pytest.mark.parametrize("key", ["from_start", "at_limit"])
def test_goals_from_the_start_alone_have_no_guesses_to_choose_from(key):
    mistakes: list[str] = []
    read_kind(registry.STAGES, {"use": "goal-ik", key: 0.5}, Place("x.toml"), mistakes)
    assert f"{key}: needs random guesses" in mistakes[0]
