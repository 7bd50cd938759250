"""Certified datasets: every row comes with a plan that holds, in the same shards, resumable and provable like all."""

import itertools
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import RecipeError, UsageError
from cnpgen.judges.rows.verify import PlanCheck, check_plans
from cnpgen.make.certify import NO_PLAN, CertifiedPlan, certified
from cnpgen.make.generation_options import GenerationOptions
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.merge import _shipped_notes
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.planner.model_file import shipped_models
from cnpgen.plans import load_plans, save_plans
from cnpgen.plans.boundary_problems import load_boundary_problems, plans_of_rows
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import resolved
from cnpgen.problems.problem_record import record_problem
from cnpgen.refine import refine_engine as engine
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.refine.task import Attempt
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.reader import open_dataset
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import Prepare, run_stages
from tests.refusals import is_refused

ROWS = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("certified") / "hits"
    return make_dataset(
        "airhockey-hit", out, n=ROWS, certify=True, workers=1, shard_size=8
    ).folder


def test_every_row_holds_a_plan_that_deep_validation_judges(folder: Path) -> None:
    report = validate_dataset(folder, deep=True, regenerate=1, workers=1)
    assert report.ok
    assert report.to_dict()["plans"] == {"judged": ROWS, "valid": ROWS}
    assert f"judged at all times: {ROWS} plans, {ROWS} valid" in report.summary()
    rows = open_dataset(folder).read("train")
    assert rows["path_control_points"].shape == (11, 15 * 6)
    assert rows["rate_control_points"].shape == (11, 20)
    assert (rows["duration"] > 0.05).all()
    with h5py.File(folder / "train" / "shard-00000.h5") as file:
        assert file["path_control_points"].attrs["role"] == "target"
        assert "(15, 6)" in file["path_control_points"].attrs["long_name"]


def test_the_plans_are_those_that_solve_finds(folder: Path) -> None:
    problem = load_dataset_recipe("airhockey-hit").pipeline.problem
    rows = open_dataset(folder).read("validation")
    unsolved = {
        name: values
        for name, values in rows.items()
        if not name.endswith("control_points")
    }
    found = refine_plans(plans_of_rows(record_problem(problem), unsolved)).plans
    np.testing.assert_array_equal(
        found.path_control_points.reshape(len(found), -1), rows["path_control_points"]
    )


def test_rows_are_read_with_their_plans_and_these_are_as_good_as_refined(
    folder: Path, tmp_path: Path
) -> None:
    plans = load_boundary_problems(folder)
    assert evaluate_plans(plans, workers=1).valid.all()
    np.testing.assert_allclose(
        plans.duration, open_dataset(folder).read("train")["duration"], rtol=1e-12
    )
    found = refine_plans(plans, workers=1)
    assert found.valid.all()
    assert (found.plans.duration <= plans.duration * (1 + 2e-3)).all()
    save_plans(tmp_path / "stored.h5", plans)
    assert (
        load_plans(tmp_path / "stored.h5").source
        == "dataset airhockey-hit-certified, seed 20261121, split train"
    )


@pytest.mark.parametrize("model", [None, "airhockey-hit"])
def test_a_round_whose_draws_are_all_rejected_needs_no_plans(
    model: str | None, prepare: Prepare
) -> None:
    prepared = prepare(
        certified(load_dataset_recipe("airhockey-hit"), model=model).pipeline
    )
    (*_, (_, plan)), candidates = prepared._stages, run_stages(prepared, 4)
    candidates.reject(np.zeros(len(candidates.alive), bool), "all of them")
    plan(candidates, np.random.default_rng(0))
    assert [candidates[name].shape for name in ("path_control_points", "rate_control_points", "duration")] == [
        (90, 0), (20, 0), (1, 0)
    ]  # fmt: skip


@pytest.mark.slow
def test_workers_and_interruptions_change_no_byte(folder: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    make_dataset(
        "airhockey-hit",
        again,
        n=ROWS,
        certify=True,
        shard_size=8,
        options=GenerationOptions(part=(1, 2)),
    )
    make_dataset("airhockey-hit", again, n=ROWS, certify=True, workers=2, shard_size=8)
    shards = sorted(path.relative_to(folder) for path in folder.rglob("*.h5"))
    assert [file_sha256(folder / name) for name in shards] == [
        file_sha256(again / name) for name in shards
    ]


@pytest.mark.slow
def test_samples_without_a_plan_are_counted_under_their_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve, count = engine.refine_task, itertools.count()

    def fail_at_every_third(*arguments: Any) -> Attempt:
        found = solve(*arguments)
        return replace(found, reason="off the table") if next(count) % 3 == 0 else found

    monkeypatch.setattr(engine, "refine_task", fail_at_every_third)
    made = make_dataset("airhockey-hit", tmp_path / "out", n=8, certify=True, workers=1)
    outcome = open_dataset(made.folder).manifest["yield"]
    solved = next(count)
    assert outcome["rejections"][NO_PLAN] > 0
    assert solved >= outcome["rejections"][NO_PLAN] + 8
    assert outcome["tried"] == outcome["accepted"] + sum(outcome["rejections"].values())


def test_a_plan_that_does_not_hold_is_found(folder: Path, tmp_path: Path) -> None:
    problem = load_dataset_recipe("airhockey-hit").pipeline.problem
    robot, rows = load_robot(problem), dict(open_dataset(folder).read("train"))
    assert check_plans(problem, robot, rows) == PlanCheck(judged=11, valid=11)
    path = rows["path_control_points"].copy()
    path[3, 40] += 0.1
    found = check_plans(problem, robot, rows | {"path_control_points": path})
    assert (found.judged, found.valid) == (11, 10)
    assert (
        "1 of 11 plans are not valid, the first one is that of row 3"
        in found.problems[0]
    )
    wrong = check_plans(problem, robot, rows | {"duration": 2 * rows["duration"]})
    assert wrong.problems == ("stored durations differ from those of the plans",)
    assert check_plans(problem, robot, {"start_q": rows["start_q"]}) == PlanCheck()


def test_float32_is_refused_since_plans_would_miss_their_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            [
                "make-dataset",
                "airhockey-hit",
                "-o",
                str(tmp_path / "out"),
                "--certify",
                "--dtype",
                "float32",
            ]
        )
        == 2
    )
    assert capsys.readouterr().err == (
        "cnpgen: error: --certify stores plans, which are exact in float64 only: leave out --dtype float32\n"
    )
    with is_refused(RecipeError):
        make_dataset(
            "airhockey-hit",
            tmp_path / "out",
            n=4,
            certify=True,
            options=GenerationOptions(dtype="float32"),
        )


def test_certifying_adds_one_stage_and_a_name_and_only_once() -> None:
    plain = load_dataset_recipe("airhockey-hit")
    once = certified(plain)
    assert once.name == "airhockey-hit-certified"
    assert isinstance(once.pipeline.stage[-1], CertifiedPlan)
    assert certified(once) is once


@pytest.mark.slow
def test_the_command_makes_a_certified_dataset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert (
        main(
            [
                "make-dataset",
                "heavy-object",
                "--n",
                "2",
                "--certify",
                "--out",
                str(out),
                "--workers",
                "1",
            ]
        )
        == 0
    )
    assert main(["show", "airhockey-hit"]) == 0
    assert main(["validate", str(out), "--deep"]) == 0
    shutil.rmtree(out)
    assert "0 rows out" in capsys.readouterr().out


@pytest.fixture(scope="module")
def from_planner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("planned") / "hits"
    return make_dataset(
        "airhockey-hit",
        out,
        n=ROWS,
        certify=True,
        workers=1,
        shard_size=8,
        options=GenerationOptions(model="airhockey-hit"),
    ).folder


@pytest.mark.slow
def test_plans_that_begin_with_a_planners_are_judged_alike_and_made_again_alike(
    folder: Path, from_planner: Path
) -> None:
    report = validate_dataset(from_planner, deep=True, regenerate=1, workers=1)
    assert report.ok, report.summary()
    assert report.to_dict()["plans"] == {"judged": ROWS, "valid": ROWS}
    stage = open_dataset(from_planner).spec.stages[-1]
    assert (stage["use"], stage["model"], stage["sha256"]) == (
        "certified-plan", "airhockey-hit", file_sha256(shipped_models()["airhockey-hit"]),
    )  # fmt: skip
    assert _shipped_notes(open_dataset(from_planner).spec).startswith("Hits from rest")
    one, other = (open_dataset(each).read("train") for each in (folder, from_planner))
    np.testing.assert_array_equal(one["start_q"], other["start_q"])
    assert (one["path_control_points"] != other["path_control_points"]).any()
    np.testing.assert_allclose(one["duration"], other["duration"], rtol=0.03)


@pytest.mark.slow
def test_transports_begin_with_a_planners_plans_too(tmp_path: Path) -> None:
    made = make_dataset(
        "heavy-object",
        tmp_path / "out",
        n=3,
        certify=True,
        workers=1,
        options=GenerationOptions(model="heavy-object"),
    )
    assert len(open_dataset(made.folder).read("train")["duration"]) == 3


def test_recipes_without_a_planner_are_written_as_before() -> None:
    recipe = load_dataset_recipe("airhockey-hit")
    assert resolved(certified(recipe))["pipeline"]["stage"][-1] == {
        "use": "certified-plan"
    }


def test_another_model_under_the_name_is_refused(tmp_path: Path) -> None:
    mine = tmp_path / "mine.h5"
    shutil.copy(shipped_models()["airhockey-hit"], mine)
    recipe = certified(load_dataset_recipe("airhockey-hit"), model=mine)
    shutil.copy(shipped_models()["airhockey-replan"], mine)
    with is_refused(RecipeError):
        make_dataset(recipe, tmp_path / "out", n=4, workers=1)


def test_a_planner_is_for_certifying(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with is_refused(UsageError, argument="model"):
        make_dataset(
            "airhockey-hit",
            tmp_path / "out",
            n=4,
            options=GenerationOptions(model="airhockey-hit"),
        )
    assert (
        main(
            [
                "make-dataset",
                "airhockey-hit",
                "-o",
                str(tmp_path / "out"),
                "--model",
                "airhockey-hit",
            ]
        )
        == 2
    )
    assert "--model needs --certify" in capsys.readouterr().err
    command = [
        "make-dataset",
        "airhockey-hit",
        "--certify",
        "--model",
        "airhockey-hot",
        "--dry-run",
    ]
    assert main(command) == 2
    assert "unknown model 'airhockey-hot'" in capsys.readouterr().err
