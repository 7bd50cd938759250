"""Starts on plans: they are where the motions are, exactly on the table; their goals; which planner it must be."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError, UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.make.complete import complete
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.on_plan import (
    GOAL,
    STATES_PER_REFINED_PLAN,
    GoalOfPlan,
    StartOnPlan,
    load_stage_planner,
    model_sha256,
    of_plan,
)
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.completion import Completion
from cnpgen.pipelines.prepared import random_generator
from cnpgen.pipelines.stages.stage import CandidateBatch, load_context
from cnpgen.planner.planner import Planner
from cnpgen.schema.keys import Range
from cnpgen.trajectory.boundary import Boundary
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import Arm, Prepare, run_stages
from tests.refusals import is_refused

MODEL = "airhockey-replan"
OFF = {
    "q": 2e-3,
    "dq": 2e-2,
    "ddq": 2.0,
}  # rad, rad/s, rad/s^2: what a plan may be off the table by, in joints
STILL = StartOnPlan(
    model=MODEL, sha256=model_sha256(MODEL), moved=1.0, times=Range(0.4, 0.4)
)


@pytest.fixture(scope="module")
def first(prepare: Prepare):
    """A few whole draws of airhockey-replan."""
    prepared = prepare(MODEL)
    return prepared, run_stages(prepared, 160, seed=2)


def moved(first, stage: StartOnPlan) -> CandidateBatch:
    """Apply the stage."""
    prepared, candidates = first
    found = CandidateBatch(len(candidates.alive))
    for name, values in candidates.columns.items():
        found[name] = values
    stage.prepare(prepared.context)(found, random_generator(4, "train", 0))
    return found


def boundary_of(candidates: CandidateBatch) -> Boundary:
    return Boundary(*(np.ascontiguousarray(candidates[f"{end}"].T) for end in (
        "start_q", "start_dq", "start_ddq", "goal_q", "goal_dq",
    )))  # fmt: skip


def test_starts_are_where_the_motions_are_and_exactly_on_the_table(first) -> None:
    prepared, candidates = first
    found = moved(first, STILL)
    plans = Planner(MODEL).plan_batch(boundary_of(candidates))
    expected, arm = plans.states_at(0.4 * plans.duration), Arm(prepared.context.robot)
    for name, values, off in zip(
        ("start_q", "start_dq", "start_ddq"), expected, OFF.values(), strict=True
    ):
        assert np.median(np.abs(found[name].T - values).max(axis=1)) < off / 4
        assert (np.abs(found[name].T - values).max(axis=1) < off).mean() > 0.95
    for i in range(40):
        q, dq, ddq = (
            found[name][:, i] for name in ("start_q", "start_dq", "start_ddq")
        )
        position = arm.pose(q).translation
        assert position[2] == pytest.approx(0.16, abs=1e-10)
        np.testing.assert_allclose(position, found["start_xyz"][:, i], atol=1e-10)
        assert arm.velocity(q, dq)[2] == pytest.approx(0.0, abs=1e-10)
        assert arm.acceleration(q, dq, ddq)[2] == pytest.approx(0.0, abs=1e-9)


def test_a_share_of_the_starts_stays(first) -> None:
    candidates, found = first[1], moved(first, replace(STILL, moved=0.3))
    same = (found["start_q"] == candidates["start_q"]).all(axis=0)
    assert same.mean() == pytest.approx(0.7, abs=0.15)
    for name in GOAL[:-1]:
        np.testing.assert_array_equal(found[of_plan(name)], candidates[name])


def test_many_starts_are_on_one_refined_motion_whose_goal_they_may_keep(first) -> None:
    candidates, found = (
        first[1],
        moved(first, replace(STILL, refined=1.0, times=Range(0.05, 0.95))),
    )
    goals = found["planned_goal_q"]
    assert len(np.unique(goals, axis=1).T) == -(
        -goals.shape[1] // STATES_PER_REFINED_PLAN
    )
    np.testing.assert_array_equal(
        goals[:, :STATES_PER_REFINED_PLAN],
        np.repeat(candidates["goal_q"][:, :1], STATES_PER_REFINED_PLAN, axis=1),
    )
    np.testing.assert_array_equal(
        found["planned_home_q"][:, 0], candidates["start_q"][:, 0]
    )
    used = (
        np.abs(found["start_ddq"]).max(axis=1)
        / first[0].context.robot.acceleration_limit
    )
    assert used.max() > 0.98  # refined motions use what there is
    found["home_q"] = candidates["start_q"]
    GoalOfPlan(share=1.0).prepare(first[0].context)(
        found, random_generator(0, "train", 0)
    )
    for name in GOAL:
        np.testing.assert_array_equal(found[name], found[of_plan(name)])


def test_another_file_or_a_model_of_another_problem_is_refused(first) -> None:
    context = first[0].context
    with pytest.raises(RecipeError, match="expected " + "0" * 64):
        load_stage_planner(MODEL, "0" * 64, context)
    with is_refused(RecipeError):
        load_stage_planner("heavy-object", model_sha256("heavy-object"), context)
    with is_refused(UsageError, argument="name_or_path"):
        load_stage_planner("airhockey-hot", "0" * 64, context)


@pytest.mark.slow
def test_the_shipped_dataset_is_what_it_says(tiny) -> None:
    report = validate_dataset(tiny("airhockey-online"), deep=True, workers=1)
    assert report.ok, report.summary()
    assert "hitting configuration" in report.summary()


@pytest.mark.slow
def test_goals_that_many_rows_have_are_not_taken_for_hits_with_reduced_speed() -> None:
    drawn = draw_boundary_problems("airhockey-online", 3000, seed=7)
    _, count = np.unique(drawn.boundary.goal_q, axis=0, return_counts=True)
    assert count.max() > 3


def test_tasks_keep_their_start_and_their_goal() -> None:
    old = draw_boundary_problems(MODEL, 4, seed=1)
    ends = {
        name: getattr(old.boundary, name)
        for name in ("start_q", "start_dq", "start_ddq")
    }
    asked = {
        "goal_xyz": old.columns["goal_xyz"],
        "hit_angle": old.columns["hit_angle"],
        "hit_speed_share": 0.5,
    }
    one, other = (
        complete(name, **ends, **asked) for name in (MODEL, "airhockey-online")
    )
    assert len(other.plans) == 4
    np.testing.assert_array_equal(other.plans.boundary.start_q, old.boundary.start_q)
    same = np.isin(other.plans.sample_id, one.plans.sample_id)
    np.testing.assert_allclose(
        other.plans.boundary.goal_q[same], one.plans.boundary.goal_q, atol=1e-12
    )


def test_of_the_first_hit_tasks_need_nothing() -> None:
    pipeline = load_dataset_recipe("airhockey-online").pipeline
    completion = Completion(
        pipeline,
        load_context(pipeline.problem, *choose_backend(None)),
        ["goal_xyz", "hit_angle"],
    )
    labels = [label for label, _ in completion._stages]
    assert "5. hitting-configuration" not in labels
    assert "7. braking-reach" not in labels
    assert {
        "2. start-ik",
        "3. table-velocity",
        "13. hitting-configuration",
        "16. braking-reach",
    } <= set(labels)
