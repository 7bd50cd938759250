"""Homes: frequencies of their configurations; goals sampled alone, near a home or along the line from it."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import RecipeError
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.prepared import random_generator
from cnpgen.pipelines.stages.draw import DrawGoal
from cnpgen.pipelines.stages.hit_angle import HitAngleInCone
from cnpgen.pipelines.stages.ik import Home
from cnpgen.pipelines.stages.stage import CandidateBatch, TaskBatch
from cnpgen.schema import registry
from cnpgen.schema.catalogue import read_kind
from cnpgen.schema.keys import Range, RecipeLocation
from tests.conftest import Arm, Prepare, run_stages
from tests.refusals import is_refused

BOX = (Range(0.6, 1.3), Range(-0.45, 0.45), Range(0.16, 0.16))
COUNT = 4000


@pytest.fixture(scope="module")
def started(prepare: Prepare) -> tuple[Pipeline, CandidateBatch]:
    """Candidates of airhockey-replan with start configurations."""
    prepared = prepare("airhockey-replan")
    return prepared, run_stages(prepared, COUNT, seed=3, until="StartIK")


def after(prepared, candidates: CandidateBatch, stage) -> CandidateBatch:
    """Run a stage on a copy of the candidates."""
    found = CandidateBatch(len(candidates.alive))
    for name, values in candidates.columns.items():
        found[name] = values
    stage.prepare(prepared.context)(found, random_generator(5, "train", 0))
    return found


def test_a_home_is_the_start_the_base_or_a_configuration_at_a_random_position(
    started,
) -> None:
    prepared, candidates = started
    guess = next(
        stage for stage in prepared.pipeline.stage if type(stage).__name__ == "StartIK"
    ).guess
    found = after(
        prepared, candidates, Home(at_start=0.5, at_base=0.2, position=BOX, guess=guess)
    )
    start = (found["home_q"] == found["start_q"]).all(axis=0)
    base = (found["home_q"] == prepared.context.robot.home[:, None]).all(axis=0)
    assert start.mean() == pytest.approx(0.5, abs=0.04)
    assert base.mean() == pytest.approx(0.2, abs=0.04)
    arm = Arm(prepared.context.robot)
    for i in (
        np.flatnonzero(~(start | base))[:50].tolist()
        + np.flatnonzero(base)[:3].tolist()
    ):
        np.testing.assert_allclose(
            arm.pose(found["home_q"][:, i]).translation,
            found["home_xyz"][:, i],
            atol=1e-9,
        )
    elsewhere = found["home_xyz"][:, ~(start | base)]
    np.testing.assert_allclose(elsewhere[2], 0.16, atol=1e-9)
    assert elsewhere[0].min() < 0.65
    assert elsewhere[0].max() > 1.2


def test_the_home_of_a_task_is_its_start(started) -> None:
    prepared, candidates = started
    tasks = TaskBatch(len(candidates.alive))
    for name in ("start_q", "start_xyz"):
        tasks[name] = candidates[name]
    Home(at_start=0.0, position=BOX).complete(prepared.context, ["start_q"])(
        tasks, random_generator(0, "train", 0)
    )
    np.testing.assert_array_equal(tasks["home_q"], candidates["start_q"])
    np.testing.assert_array_equal(tasks["home_xyz"], candidates["start_xyz"])


def test_fractions_with_a_sum_above_one_are_a_mistake() -> None:
    errors: list[str] = []
    table = {
        "use": "home",
        "at_start": 0.7,
        "at_base": 0.4,
        "position": ["[0.6, 1.3] m", "[-0.4, 0.4] m", "0.16 m"],
    }
    read_kind(registry.STAGES, table, RecipeLocation("x.toml"), errors)
    assert "must not be more than 1 together, got 1.1" in errors[0]


def test_a_goal_sampled_alone_has_the_minimum_distance_from_the_start(started) -> None:
    prepared, candidates = started
    found = after(prepared, candidates, DrawGoal(goal=BOX, min_distance=0.3))
    assert 0 < len(found.alive) < len(candidates.alive)
    difference = found["goal_xyz"] - found["start_xyz"]
    assert np.hypot(difference[0], difference[1]).min() >= 0.3
    far = (Range(9.0, 10.0), *BOX[1:])
    with is_refused(RecipeError):
        DrawGoal(goal=far).prepare(prepared.context)


def test_a_cone_may_be_about_the_line_from_home(started) -> None:
    prepared, candidates = started
    candidates = after(prepared, candidates, DrawGoal(goal=BOX))
    candidates["home_xyz"] = candidates["start_xyz"][:, ::-1]
    stage = HitAngleInCone(half_angle=0.0)
    line = candidates["goal_xyz"] - candidates["home_xyz"]
    found = after(prepared, candidates, replace(stage, origin="home"))["hit_angle"][0]
    np.testing.assert_allclose(
        np.cos(found - np.arctan2(line[1], line[0])), 1.0, atol=1e-12
    )
    assert (
        np.abs(found - after(prepared, candidates, stage)["hit_angle"][0]).max() > 0.1
    )
