"""Inverse kinematics of start and goal, checked with Pinocchio."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.pipelines.stages.ik import IK_TOLERANCE, MAX_IK_STEPS, GoalIK, ik_step
from cnpgen.pipelines.stages.stage import CandidateBatch, TaskBatch
from cnpgen.schema import registry
from cnpgen.schema.catalogue import read_kind
from cnpgen.schema.keys import RecipeLocation
from tests.conftest import Arm, Prepare, run_stages
from tests.refusals import is_refused

EXACT = 1e-9  # m and rad
ENDS = [
    ("airhockey-hit", "start"),
    ("airhockey-replan", "start"),
    ("heavy-object", "start"),
    ("heavy-object", "goal"),
]


@pytest.fixture(scope="module", params=ENDS, ids=" ".join)
def solved(
    request: pytest.FixtureRequest, prepare: Prepare
) -> tuple[PreparedPipeline, str, CandidateBatch]:
    """Enough candidates to include solutions with joints on their limits, which converge slowly."""
    name, end = request.param
    until = {"start": "StartIK", "goal": "GoalIK"}[end]
    candidates = 40_000 if name == "heavy-object" else 4000
    return (
        prepare(name),
        end,
        run_stages(prepare(name), candidates, seed=31, until=until),
    )


def test_the_tip_is_at_its_position_within_a_nanometre(solved):
    prepared, end, candidates = solved
    arm = Arm(prepared.context.robot)
    found = np.array([arm.pose(q).translation.copy() for q in candidates[f"{end}_q"].T])
    assert np.linalg.norm(found - candidates[f"{end}_xyz"].T, axis=1).max() < EXACT


def test_every_joint_is_within_its_limits(solved):
    prepared, end, candidates = solved
    robot = prepared.context.robot
    assert np.all(robot.position_lower[:, None] <= candidates[f"{end}_q"])
    assert np.all(candidates[f"{end}_q"] <= robot.position_upper[:, None])


def test_almost_every_candidate_has_a_solution(solved):
    prepared, _, candidates = solved
    too_close = np.sum(
        candidates.outcome == 1 + candidates.reasons.index("too close together")
    )
    yielded = len(candidates.alive) / (candidates.size - too_close)
    assert yielded > (0.99 if prepared.context.robot.n == 6 else 0.6)


@pytest.mark.parametrize("end", ["start", "goal"])
def test_the_held_object_stands_upright(prepare, end):
    prepared = prepare("heavy-object")
    candidates = run_stages(prepared, 20_000, seed=32, until="GoalIK")
    arm = Arm(prepared.context.robot)
    up = np.array([arm.pose(q).rotation[:, 2].copy() for q in candidates[f"{end}_q"].T])
    assert np.abs(up[:, :2]).max() < EXACT
    assert up[:, 2].min() > 0


def test_an_object_held_upside_down_is_turned_upright(prepare):
    prepared = prepare("heavy-object")
    kernel = prepared.context.kernels.load(
        ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), vertical=True, max_step=0.8
    )
    good = run_stages(prepared, 400, seed=33, until="StartIK")
    arm = Arm(prepared.context.robot)
    q = good["start_q"].copy()
    q[5] = np.clip(q[5] + np.pi * np.where(q[5] > 0, -1, 1), *np.array([[-2.0], [2.0]]))
    tilted = np.array([arm.pose(x).rotation[2, 2] for x in q.T])
    assert np.sum(tilted < -0.5) > 20
    found, error = kernel(q, good["start_xyz"])
    up = np.array(
        [arm.pose(x).rotation[2, 2] for x in found[:, error[0] < IK_TOLERANCE].T]
    )
    assert len(up) > 100
    np.testing.assert_allclose(up, 1.0, atol=1e-12)


def test_positions_out_of_reach_are_rejected(prepare):
    prepared = prepare("airhockey-hit")
    kernel = prepared.context.kernels.load(
        ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), vertical=False, max_step=0.4
    )
    base = np.repeat(prepared.context.robot.home[:, None], 5, axis=1)
    far = np.array(
        [
            [3.0, 0.0, 0.16],
            [1.2, 1.2, 0.16],
            [0.0, 0.0, 2.9],
            [5.0, 5.0, 5.0],
            [0.65, 0.0, 0.16],
        ]
    ).T.copy()
    q, error = kernel(base, far)
    assert np.all(error[0, :4] > 1e-2)
    assert error[0, 4] < IK_TOLERANCE
    assert np.all(np.isfinite(q))


def test_no_joint_step_exceeds_the_maximum(prepare):
    prepared = prepare("airhockey-replan")
    kernel = prepared.context.kernels.load(ik_step, vertical=False, max_step=0.05)
    candidates = run_stages(prepared, 300, seed=34, until="StartIK")
    following, _ = kernel(candidates["guess_q"], candidates["start_xyz"])
    assert np.abs(following - candidates["guess_q"]).max() <= 0.05 + 1e-12


def test_steps_never_leave_the_joint_limits_even_from_a_corner(prepare):
    prepared = prepare("heavy-object")
    robot = prepared.context.robot
    kernel = prepared.context.kernels.load(ik_step, vertical=True, max_step=0.8)
    random = np.random.default_rng(35)
    q = np.where(
        random.random((robot.n, 500)) < 0.5,
        robot.position_lower[:, None],
        robot.position_upper[:, None],
    )
    following, _ = kernel(
        q, random.uniform([0.2, -0.6, 0.2], [0.6, 0.6, 0.5], (500, 3)).T.copy()
    )
    assert np.all(robot.position_lower[:, None] <= following)
    assert np.all(following <= robot.position_upper[:, None])


def test_the_remaining_step_of_a_joint_on_its_limit_is_distributed_over_the_others(
    prepare,
):
    prepared = prepare("airhockey-replan")
    robot, kernels = prepared.context.robot, prepared.context.kernels
    narrow = np.array([np.inf, np.inf, 0.05, np.inf, 0.05, np.inf])
    limits = {
        "position_lower": np.maximum(robot.position_lower, -narrow),
        "position_upper": np.minimum(robot.position_upper, narrow),
    }
    arguments = {**kernels.arguments, "robot": replace(robot, **limits)}
    kernels = replace(
        kernels,
        backend="numpy",
        identity="narrow third and fifth joint",
        arguments=arguments,
    )
    kernel = kernels.load(
        ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), vertical=False, max_step=0.4
    )
    candidates = run_stages(prepared, 400, seed=37, until="StartIK")
    guess = np.clip(
        candidates["guess_q"],
        limits["position_lower"][:, None],
        limits["position_upper"][:, None],
    )
    q, error = kernel(guess, candidates["start_xyz"])
    solved = error[0] < IK_TOLERANCE
    assert solved.mean() > 0.95
    assert np.sum(np.abs(q[[2, 4]][:, solved]).max(0) == 0.05) > 10
    assert np.abs(q[[2, 4]]).max() <= 0.05
    arm = Arm(robot)
    found = np.array([arm.pose(x).translation.copy() for x in q[:, solved].T])
    assert (
        np.linalg.norm(found - candidates["start_xyz"][:, solved].T, axis=1).max()
        < EXACT
    )


def test_solutions_do_not_depend_on_how_sine_and_cosine_are_rounded(
    prepare, kernels_of
):
    """Backends differ in the last bit; a solve with few free joints must not amplify the difference."""
    prepared = prepare("heavy-object")
    options = {"vertical": True, "max_step": 0.8}
    candidates = run_stages(prepared, 6000, seed=38, until="StartIK")
    one, other = (
        kernels_of(prepared, backend).load(
            ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), **options
        )
        for backend in (prepared.context.kernels.backend, "numpy")
    )
    turned = np.nextafter(candidates["guess_q"], np.inf)
    first, second = (
        one(candidates["guess_q"], candidates["start_xyz"]),
        other(turned, candidates["start_xyz"]),
    )
    assert np.mean(np.abs(first[0] - second[0]).max(0) > 1e-9) < 1e-3


def test_the_goal_is_solved_from_the_start(prepare):
    prepared = prepare("heavy-object")
    candidates = run_stages(prepared, 1500, seed=36, until="GoalIK")
    kernel = prepared.context.kernels.load(
        ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), vertical=True, max_step=0.8
    )
    again, _ = kernel(candidates["start_q"], candidates["goal_xyz"])
    np.testing.assert_array_equal(candidates["goal_q"], again)


def test_a_guess_of_the_wrong_length_is_a_mistake_in_the_recipe(prepare):
    prepared = prepare("airhockey-replan")
    stage = prepared.pipeline.stage[1]
    with is_refused(RecipeError):
        replace(stage, guess=stage.guess[:5]).prepare(prepared.context)


def test_stages_are_described_with_their_values(prepare):
    heavy, hit = prepare("heavy-object").pipeline, prepare("airhockey-hit").pipeline
    goal = next(stage for stage in heavy.stage if isinstance(stage, GoalIK))
    assert goal.describe() == (
        "solve the goal configuration with the tip's z axis vertical from the start configuration"
    )
    assert (
        hit.stage[1].describe()
        == "solve the start configuration from the base configuration"
    )


@pytest.fixture(scope="module")
def anywhere(prepare: Prepare) -> tuple[PreparedPipeline, CandidateBatch]:
    """Transports between independent configurations, some on joint limits."""
    return prepare("heavy-object-anywhere"), run_stages(
        prepare("heavy-object-anywhere"), 20_000, seed=39
    )


def test_held_joints_end_exactly_on_their_limits(anywhere):
    prepared, _ = anywhere
    candidates = run_stages(prepared, 20_000, seed=40, until="StartIK")
    robot = prepared.context.robot
    held, limits = (
        candidates["held"].astype(bool),
        (robot.position_lower[:, None], robot.position_upper[:, None]),
    )
    assert set(held.sum(0)) == {0, 1}
    assert held.any(1).all()
    assert np.all(
        ((candidates["start_q"] == limits[0]) | (candidates["start_q"] == limits[1]))[
            held
        ]
    )
    arm = Arm(robot)
    found = np.array([arm.pose(q).translation.copy() for q in candidates["start_q"].T])
    assert np.linalg.norm(found - candidates["start_xyz"].T, axis=1).max() < EXACT


def test_goals_are_the_solutions_of_their_guesses(anywhere):
    prepared, candidates = anywhere
    stage = next(
        stage for stage in prepared.pipeline.stage if isinstance(stage, GoalIK)
    )
    kernel = prepared.context.kernels.load(
        ik_step,
        Loop(IK_TOLERANCE, MAX_IK_STEPS),
        vertical=True,
        max_step=0.8,
        hold=True,
    )
    again, _ = kernel(candidates["guess_q"], candidates["goal_xyz"], candidates["held"])
    np.testing.assert_array_equal(candidates["goal_q"], again)
    from_start = (candidates["guess_q"] == candidates["start_q"]).all(0)
    assert from_start.mean() > stage.from_start
    assert not candidates["held"][:, from_start].any()
    change = np.abs(candidates["goal_q"] - candidates["start_q"]).max(0)
    assert 0.95 * stage.max_change < change.max() <= stage.max_change
    assert np.median(change[~from_start]) > 1.5 * np.median(change[from_start])


def test_goals_of_tasks_are_solved_from_the_start(prepare, anywhere):
    prepared, candidates = anywhere
    stage = next(
        stage for stage in prepared.pipeline.stage if isinstance(stage, GoalIK)
    )
    round_of, tasks = prepare("heavy-object"), TaskBatch(10)
    for name in ("start_q", "goal_xyz"):
        tasks[name] = candidates[name][:, :10].copy()
    stage.complete(prepared.context, ("start_q", "goal_xyz"))(
        tasks, np.random.default_rng(0)
    )
    kernel = round_of.context.kernels.load(
        ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), vertical=True, max_step=0.8
    )
    again, error = kernel(candidates["start_q"][:, :10], candidates["goal_xyz"][:, :10])
    np.testing.assert_array_equal(tasks["goal_q"], again[:, error[0] < IK_TOLERANCE])


@pytest.mark.parametrize("key", ["from_start", "at_limit"])
def test_options_of_guesses_require_guesses(key):
    errors: list[str] = []
    read_kind(
        registry.STAGES, {"use": "goal-ik", key: 0.5}, RecipeLocation("x.toml"), errors
    )
    assert f"{key}: needs random guesses" in errors[0]
