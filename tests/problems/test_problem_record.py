"""Problems, their records, and the names and files that identify them."""

import json
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import CnpgenError, RecipeError, UsageError
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.plans import make_plans, record_problem
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import (
    ProblemRecord,
    as_problem,
    as_record,
    open_problem,
)
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import some
from tests.examples.shaped_robot import write_problem
from tests.examples.shipped import PROBLEMS
from tests.refusals import is_refused

ROOT = Path(__file__).parents[2]


@cache
def record() -> ProblemRecord:
    return record_problem(PROBLEMS["heavy-object"])


def test_a_record_is_rebuilt_once_and_its_urdf_stays() -> None:
    problem = as_problem(record())
    assert problem is as_problem(record())
    assert problem.urdf_path.read_text() == record().urdf
    assert (problem.name, problem.constraint, problem.obstacle) == (
        PROBLEMS["heavy-object"].name,
        PROBLEMS["heavy-object"].constraint,
        PROBLEMS["heavy-object"].obstacle,
    )
    assert as_record(problem).comparable_sha256 == record().comparable_sha256
    assert as_record(record()) is record()


@pytest.mark.parametrize("name", ["", " ", "joint-position 2"])
def test_the_digest_of_a_record_with_an_unknown_constraint_exists_and_the_record_is_refused(
    name: str,
) -> None:
    content = json.loads(record().recipe)
    content["constraint"][1]["use"] = name
    changed = replace(record(), recipe=json.dumps(content))
    assert changed.comparable_sha256 != record().comparable_sha256
    with is_refused(CnpgenError):
        as_problem(changed)


def test_a_problem_in_an_untrusted_file_reads_no_mesh_from_the_disk(
    tmp_path: Path,
) -> None:
    problem = load_problem(write_problem(tmp_path))
    assert open_problem(record_problem(problem))[1].shape.convex_parts
    outside = problem.urdf_path.read_text()
    with is_refused(RecipeError):
        open_problem(replace(record_problem(problem), urdf=outside))


def test_the_urdf_of_a_rebuilt_problem_is_gone_when_the_process_ends() -> None:
    code = "from cnpgen.problems.problem_record import *; print(as_problem(as_record('airhockey')).urdf_path)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert not Path(done.stdout.strip()).parent.exists()


@pytest.mark.parametrize(
    "name",
    ["heavy-object", "datasets/heavy-object.toml", "pipelines/heavy-object.toml"],
)
def test_a_name_or_a_file_leads_to_the_problem(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    assert as_problem(name) == PROBLEMS["heavy-object"]
    assert as_problem(Path(name) if "/" in name else name) == PROBLEMS["heavy-object"]


@pytest.mark.parametrize("name", ["airhockey-hit", "airhockey-replan", "airhockey"])
def test_the_name_of_a_dataset_gives_its_problem(name: str) -> None:
    assert as_problem(name) == load_problem("airhockey")


def test_what_leads_to_no_problem_is_named(tmp_path: Path) -> None:
    for folder in ("pipelines", "datasets"):
        (tmp_path / folder).mkdir()
    pipeline, dataset = (
        tmp_path / "pipelines" / "hit.toml",
        tmp_path / "datasets" / "hit.toml",
    )
    shutil.copy(ROOT / "pipelines" / "airhockey-hit.toml", pipeline)
    dataset.write_text('name = "hit"\npipeline = "../pipelines/hit.toml"\n')
    assert as_problem(dataset).name == "airhockey"
    pipeline.write_text('problem = "airhokey"\n')
    with is_refused(RecipeError):
        as_problem(dataset)
    dataset.write_text("pipeline = 3\n")
    with is_refused(RecipeError):
        as_problem(dataset)
    with is_refused(RecipeError, argument="problem"):
        as_problem("airhokey-hit")
    with is_refused(RecipeError, argument="name_or_path"):
        load_problem("airhockey-hit")


@pytest.mark.parametrize(
    "wrong", [None, 3, b"airhockey", ["record"] * 50, {"problem": "x" * 5000}]
)
def test_what_is_no_problem_is_refused_in_few_words(wrong: object) -> None:
    if isinstance(wrong, list):
        wrong = [record()] * len(wrong)
    for use in (PlanLoss, BoundaryLayer, as_record):
        with is_refused(UsageError, argument="problem") as caught:
            use(wrong)  # type: ignore[operator]
        assert len(str(caught.value)) < 200


@pytest.mark.parametrize("form", some(["record", "problem", "name"], 1, "slow"))
def test_everything_that_takes_a_problem_takes_what_plans_have_of_it(
    form: str,
) -> None:
    given: ProblemRecord | Problem | str = "heavy-object"
    if form != "name":
        given = record() if form == "record" else PROBLEMS["heavy-object"]
    loss, omega = (
        PlanLoss(given, backend="numpy"),
        BoundaryLayer(given, projection_steps=0, backend="numpy"),
    )  # for two plans
    q = np.tile(PROBLEMS["heavy-object"].robot.base, (2, 1))
    zero = np.zeros_like(q)
    tasks = omega.tasks(Boundary(q, zero, zero, q + 0.1, zero))
    phi, log_rate = np.zeros((2, omega.path_outputs)), np.zeros((2, omega.rate_outputs))
    plans = omega.plans(tasks, phi, log_rate)
    obstacle_poses = scene_of(
        as_problem(given), plans.columns["start_xyz"], plans.columns["goal_xyz"]
    ).poses
    np.testing.assert_array_equal(obstacle_poses, tasks.scene.poses)
    arrays = plans.path_control_points, plans.rate_control_points
    found = loss(*arrays, weights=loss.weights0, obstacle_poses=obstacle_poses)
    expected = PlanLoss(PROBLEMS["heavy-object"], backend="numpy")(
        *arrays, weights=loss.weights0, obstacle_poses=obstacle_poses
    )
    np.testing.assert_array_equal(found.total, expected.total)
    again = make_plans(
        given,
        plans.boundary,
        path_control_points=arrays[0],
        rate_control_points=arrays[1],
    )
    assert (
        again.problem.comparable_sha256
        == plans.problem.comparable_sha256
        == record().comparable_sha256
    )


def test_a_loss_of_a_record_can_be_sent_to_other_processes() -> None:
    assert (
        pickle.loads(pickle.dumps(PlanLoss(record()))).terms
        == PlanLoss(PROBLEMS["heavy-object"]).terms
    )


def test_a_record_is_written_in_few_words() -> None:
    assert repr(record()) == "<ProblemRecord of 'heavy-object': 7 joints>"
