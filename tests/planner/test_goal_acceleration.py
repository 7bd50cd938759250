"""Models with given goal accelerations: training, planning and errors."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from cnpgen.addons.online.hit_tasks import boundary_of_tasks
from cnpgen.errors import UsageError
from cnpgen.make.make_dataset import make_dataset
from cnpgen.pipelines.stages.boundary_motion import TableAcceleration
from cnpgen.pipelines.stages.stage import TaskBatch
from cnpgen.planner.model import is_rest_to_rest
from cnpgen.planner.model_file import load_model
from cnpgen.planner.plan_requests import read_file, read_rows
from cnpgen.planner.planner import Planner, reuse_previous_plan
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.training.train import train_model
from tests.conftest import columns_of, tiny_recipe
from tests.examples.models import (
    SMALL,
    accelerated,
    boundary_of_columns,
    untrained_model,
)
from tests.refusals import is_refused

pytestmark = pytest.mark.slow  # rows, training and kernels that no other test needs

Tiny = Callable[[str], Path]


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rows with random accelerations on the table at the goal."""
    recipe, folder = (
        tiny_recipe("airhockey-replan"),
        tmp_path_factory.mktemp("given") / "rows",
    )
    stages = (*recipe.pipeline.stage, TableAcceleration(end="goal"))
    make_dataset(
        replace(recipe, pipeline=replace(recipe.pipeline, stage=stages)),
        folder,
        workers=1,
    )
    return folder


@pytest.fixture(scope="module")
def planner(rows: Path, tmp_path_factory: pytest.TempPathFactory) -> Planner:
    """A planner trained on these rows for a few steps; without projection, whose kernels take long to compile."""
    out, plain = (
        tmp_path_factory.mktemp("models") / "model.h5",
        replace(SMALL, line_projection_steps=0, projection_steps=0),
    )
    train_model(rows, out, steps=10, settings=plain, check_rows=1, workers=1)
    return Planner(load_model(out))


def test_plans_end_with_the_goal_acceleration_of_the_rows(
    planner: Planner, rows: Path
) -> None:
    assert planner.model.fixed_at_goal == 3
    assert planner.model.features.blocks[-1] == "goal_ddq"
    assert planner.model.zero_conditions == ()
    asked = read_rows(rows, planner.model, n=20).boundary
    plans = planner.plan_batch(asked)
    np.testing.assert_array_equal(plans.boundary.goal_ddq, asked.goal_ddq)
    arrived = plans.states_at(plans.duration)
    for found, wanted, exact in zip(
        arrived,
        (asked.goal_q, asked.goal_dq, asked.goal_ddq),
        (1e-9, 1e-8, 1e-5),
        strict=True,
    ):
        np.testing.assert_allclose(found, wanted, atol=exact)
    for verdict in evaluate_plans(plans, workers=1).verdicts:
        assert verdict.margins["boundary acceleration"].violation < 1e-9


def test_a_missing_goal_acceleration_is_zero(
    planner: Planner, rows: Path, tmp_path: Path
) -> None:
    q = read_rows(rows, planner.model, n=2).boundary
    np.testing.assert_array_equal(
        planner.plan(q.start_q, q.goal_q).boundary.goal_ddq, 0
    )
    given = planner.plan(q.start_q, q.goal_q, goal_ddq=q.goal_ddq)
    np.testing.assert_array_equal(given.boundary.goal_ddq, q.goal_ddq)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["start_q"], file["goal_q"], file["goal_ddq"] = (
            q.start_q,
            q.goal_q,
            q.goal_ddq,
        )
    np.testing.assert_array_equal(
        read_file(tmp_path / "a.h5", planner.model).boundary.goal_ddq, q.goal_ddq
    )


def test_a_rest_to_rest_model_rejects_other_goal_accelerations(tiny: Tiny) -> None:
    boundary = boundary_of_columns(columns_of(tiny("airhockey-hit")), 20)
    still = accelerated(replace(boundary, goal_dq=0 * boundary.goal_dq), 0.0)
    model = untrained_model("airhockey", still)
    assert model.zero_conditions == ("start_dq", "start_ddq", "goal_dq", "goal_ddq")
    assert model.is_rest_to_rest
    moving = replace(still, goal_ddq=np.full_like(still.goal_q, 0.1))
    assert not untrained_model("airhockey", moving).is_rest_to_rest
    with is_refused(UsageError, argument="goal_ddq"):
        Planner(model, backend="numpy").plan_batch(moving)


def test_motions_with_given_goal_acceleration_are_scaled_in_time_only_if_it_is_zero() -> (
    None
):
    names = ("start_dq", "start_ddq", "goal_dq")
    assert is_rest_to_rest(names, 2)
    assert not is_rest_to_rest(names, 3)
    assert is_rest_to_rest((*names, "goal_ddq"), 3)
    assert not is_rest_to_rest(("goal_ddq",), 3)


def test_a_remaining_trajectory_is_reused_only_if_it_ends_with_the_requested_acceleration(
    planner: Planner, rows: Path
) -> None:
    asked = read_rows(rows, planner.model, n=6).boundary
    old = planner.plan_batch(asked)
    when, limit = 0.9 * old.duration, planner.robot.acceleration_limit
    goal = {"goal_q": asked.goal_q, "goal_dq": asked.goal_dq}
    same = planner.replan(old, when, **goal, goal_ddq=asked.goal_ddq)
    np.testing.assert_allclose(same.duration, 0.1 * old.duration)
    np.testing.assert_allclose(
        same.states_at(same.duration)[2], asked.goal_ddq, atol=1e-4
    )
    other = planner.replan(old, when, **goal, goal_ddq=asked.goal_ddq + 1e-3)
    assert (other.duration > 0.11 * old.duration).all()
    free = replace(old, boundary=replace(old.boundary, goal_ddq=None))
    new = planner.plan_batch(same.boundary)
    assert reuse_previous_plan(free, when, new, acceleration_limit=limit) is new


def test_boundary_conditions_of_hit_tasks_include_the_acceleration_if_the_model_fixes_it() -> (
    None
):
    tasks = TaskBatch(2)
    for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "goal_ddq"):
        tasks[name] = np.full((3, 2), len(name))
    assert boundary_of_tasks(tasks, 2).goal_ddq is None
    np.testing.assert_array_equal(boundary_of_tasks(tasks, 3).goal_ddq, 8)
