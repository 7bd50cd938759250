"""Boundary velocities and accelerations: on the table manifold and within every limit, according to Pinocchio."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.boundary_motion import (
    AtRest,
    TableAcceleration,
    TableVelocity,
    table_acceleration,
    table_velocity,
)
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.problems.problem import resolved
from tests.conftest import Arm, Prepare, run_stages
from tests.refusals import is_refused

EXACT = 1e-9  # m/s and m/s^2
DRAWS = 2000


@pytest.fixture(scope="module")
def moving(prepare: Prepare) -> tuple[PreparedPipeline, CandidateBatch]:
    prepared = prepare("airhockey-replan")
    return prepared, run_stages(prepared, DRAWS, seed=61)


def test_start_velocities_are_horizontal_and_within_their_limits(moving):
    prepared, candidates = moving
    arm, limit = Arm(prepared.context.robot), prepared.context.robot.velocity_limit
    for q, dq, tip in zip(
        candidates["start_q"].T,
        candidates["start_dq"].T,
        candidates["start_tip_velocity"].T,
        strict=True,
    ):
        velocity = arm.velocity(q, dq)
        assert abs(velocity[2]) < EXACT
        np.testing.assert_allclose(velocity, tip, atol=1e-12)
        assert np.all(np.abs(dq) <= limit * (1 + 1e-15))


def test_start_accelerations_keep_the_tip_on_the_table_and_every_limit(moving):
    prepared, candidates = moving
    robot = prepared.context.robot
    arm = Arm(robot)
    for q, dq, ddq in zip(
        candidates["start_q"].T,
        candidates["start_dq"].T,
        candidates["start_ddq"].T,
        strict=True,
    ):
        assert abs(arm.acceleration(q, dq, ddq)[2]) < EXACT
        assert np.all(np.abs(ddq) <= robot.acceleration_limit * (1 + 1e-12))
        assert np.all(
            np.abs(arm.torque(q, dq, ddq)) <= robot.torque_limit * (1 + 1e-12)
        )


def test_no_candidate_is_rejected_for_its_acceleration(moving):
    _, candidates = moving
    for reason in (
        "no acceleration within the limits at the start",
        "no velocity on the manifold",
    ):
        assert np.sum(candidates.outcome == 1 + candidates.reasons.index(reason)) == 0


def test_the_ends_of_the_acceleration_interval_are_on_a_limit_and_values_outside_violate_it(
    moving,
):
    prepared, candidates = moving
    robot, arm = prepared.context.robot, Arm(prepared.context.robot)
    kernel = prepared.context.kernels.load(table_acceleration)
    q, dq = (
        candidates["start_q"][:, :300].copy(),
        candidates["start_dq"][:, :300].copy(),
    )
    direction = np.random.default_rng(62).uniform(-1, 1, q.shape)

    def load(length: float) -> np.ndarray:
        """Return the maximum ratio of an acceleration or torque to its limit."""
        ddq, _ = kernel(q, dq, direction, np.full((1, q.shape[1]), length))
        torque = np.array(
            [arm.torque(*state) for state in zip(q.T, dq.T, ddq.T, strict=True)]
        )
        return np.maximum(
            np.abs(ddq.T) / robot.acceleration_limit,
            np.abs(torque) / robot.torque_limit,
        ).max(1)

    for end, outside in ((0.0, -1e-3), (1.0, 1.001)):
        np.testing.assert_allclose(load(end), 1.0, rtol=1e-9)
        assert np.all(load(outside) > 1.0)
    assert np.all(load(0.5) < 1.0)


def with_torque_scale(pipeline: Pipeline, scale: float) -> Pipeline:
    problem = pipeline.problem
    return replace(
        pipeline,
        problem=replace(problem, limits=replace(problem.limits, torque_scale=scale)),
    )


@pytest.fixture(scope="module")
def weak(prepare: Prepare) -> tuple[PreparedPipeline, CandidateBatch]:
    """The same arm with a fifth of its torque, slightly more than the holding torque."""
    prepared = prepare(
        with_torque_scale(prepare("airhockey-replan").pipeline, 0.2), "numpy"
    )
    return prepared, run_stages(prepared, DRAWS, seed=61)


@pytest.mark.slow
def test_small_torque_limits_are_met_exactly(weak):
    prepared, candidates = weak
    robot, arm = prepared.context.robot, Arm(prepared.context.robot)
    states = zip(
        candidates["start_q"].T,
        candidates["start_dq"].T,
        candidates["start_ddq"].T,
        strict=True,
    )
    ratio = np.array(
        [np.abs(arm.torque(*state)) / robot.torque_limit for state in states]
    ).max(1)
    assert len(ratio) > 500
    assert ratio.max() <= 1 + 1e-12


def test_small_torque_limits_bound_the_acceleration(weak, moving):
    prepared, candidates = weak
    robot, arm = prepared.context.robot, Arm(prepared.context.robot)
    kernel = prepared.context.kernels.load(table_acceleration)
    q, dq = candidates["start_q"], candidates["start_dq"]
    direction = np.random.default_rng(63).uniform(-1, 1, q.shape)
    ddq, interval_length = kernel(q, dq, direction, np.ones((1, q.shape[1])))
    fine = interval_length[0] >= 0
    states = list(zip(q.T[fine], dq.T[fine], ddq.T[fine], strict=True))
    torque = np.array(
        [np.abs(arm.torque(*state)) / robot.torque_limit for state in states]
    ).max(1)
    acceleration = (np.abs(ddq.T[fine]) / robot.acceleration_limit).max(1)
    assert np.mean(np.abs(torque - 1) < 1e-9) > 0.2
    np.testing.assert_allclose(np.maximum(torque, acceleration), 1.0, rtol=1e-9)
    strong, _ = moving[0].context.kernels.load(table_acceleration)(
        q, dq, direction, np.ones((1, q.shape[1]))
    )
    assert np.mean(np.abs(strong - ddq).max(0) > 1e-6) > 0.2


@pytest.mark.slow
def test_candidates_without_acceleration_within_tiny_torque_limits_are_rejected_and_counted(
    prepare: Prepare,
):
    """The holding torque exceeds these limits, so no acceleration is feasible."""
    prepared = prepare(
        with_torque_scale(prepare("airhockey-replan").pipeline, 0.02), "numpy"
    )
    candidates = run_stages(prepared, 500, seed=61)
    reason = candidates.reasons.index("no acceleration within the limits at the start")
    assert np.sum(candidates.outcome == 1 + reason) > 300
    robot, arm = prepared.context.robot, Arm(prepared.context.robot)
    for state in zip(
        candidates["start_q"].T,
        candidates["start_dq"].T,
        candidates["start_ddq"].T,
        strict=True,
    ):
        assert np.all(np.abs(arm.torque(*state)) <= robot.torque_limit * (1 + 1e-12))


@pytest.mark.slow
def test_accelerations_at_the_goal_are_sampled_like_those_at_the_start(
    prepare: Prepare,
):
    pipeline = prepare("airhockey-replan").pipeline
    prepared = prepare(
        replace(pipeline, stage=(*pipeline.stage, TableAcceleration(end="goal"))),
        "numpy",
    )
    block = prepared.block(1, "train", 0, stop=200)
    robot, arm = prepared.context.robot, Arm(prepared.context.robot)
    assert "goal_ddq" in [field.name for field in prepared.fields]
    columns = block.columns
    for q, dq, ddq in zip(
        columns["goal_q"].T, columns["goal_dq"].T, columns["goal_ddq"].T, strict=True
    ):
        assert abs(arm.acceleration(q, dq, ddq)[2]) < EXACT
        assert np.all(np.abs(ddq) <= robot.acceleration_limit * (1 + 1e-12))
        assert np.all(
            np.abs(arm.torque(q, dq, ddq)) <= robot.torque_limit * (1 + 1e-12)
        )


def test_velocities_in_a_singular_pose_stay_within_their_limits_and_on_the_table(
    prepare: Prepare,
):
    prepared = prepare("airhockey-replan")
    robot, arm = prepared.context.robot, Arm(prepared.context.robot)
    kernel = prepared.context.kernels.load(table_velocity)
    q = np.repeat(
        np.where(np.arange(6) % 2 == 0, 0.0, robot.home)[:, None], 200, axis=1
    )
    random = np.random.default_rng(64)
    dq, _ = kernel(q, random.uniform(-1, 1, q.shape), random.random((1, 200)))
    assert np.all(np.abs(dq) <= robot.velocity_limit[:, None])
    assert (
        max(abs(arm.velocity(*state)[2]) for state in zip(q.T, dq.T, strict=True))
        < EXACT
    )


@pytest.mark.parametrize("stage", [TableVelocity(at_rest=0.2), TableAcceleration()])
def test_problems_without_a_table_have_no_table_velocity(prepare: Prepare, stage):
    with is_refused(RecipeError):
        stage.prepare(prepare("heavy-object").context)


def test_all_starts_may_be_at_rest(prepare: Prepare):
    prepared = prepare("airhockey-replan")
    candidates = run_stages(prepared, 100, until="StartIK")
    TableVelocity(at_rest=1.0).prepare(prepared.context)(
        candidates, random_generator(1, "train", 0)
    )
    np.testing.assert_array_equal(candidates["start_dq"], 0.0)


@pytest.mark.parametrize(
    ("end", "acceleration", "stored"), [("goal", "free", False), ("goal", "zero", True)]
)
def test_a_goal_at_rest_may_prescribe_an_acceleration_of_zero(
    prepare: Prepare, end, acceleration, stored
):
    prepared = prepare("heavy-object")
    stage = AtRest(end=end, acceleration=acceleration)
    assert [field.name for field in stage.outputs(prepared.context)] == ["goal_dq"] + [
        "goal_ddq"
    ] * stored
    candidates = CandidateBatch(5)
    stage.prepare(prepared.context)(candidates, random_generator(1, "train", 0))
    np.testing.assert_array_equal(candidates["goal_ddq"], np.zeros((7, 5)))
    assert ("must end with" in stage.describe()) == stored


def test_recipes_with_free_acceleration_are_written_as_before():
    assert "acceleration" not in resolved(AtRest(end="goal"))
    assert resolved(AtRest(end="goal", acceleration="zero"))["acceleration"] == "zero"
