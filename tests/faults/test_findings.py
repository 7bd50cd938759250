"""Minimal inputs that formerly caused neither a result nor a CnpgenError."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.addons.benchmark.results_file import open_results
from cnpgen.addons.online.moving_pucks import PuckModel
from cnpgen.errors import (
    MAX_ERROR_LINES,
    MAX_LINE_LENGTH,
    DatasetError,
    RecipeError,
    UsageError,
)
from cnpgen.plans import PlanStatus, load_plans, save_plans
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import screen
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.scenes import (
    Grasp,
    SceneError,
    SceneProblem,
    load_family,
    load_scenes,
    save_scenes,
)
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.inspection import inspect_dataset
from cnpgen.store.shard_record import load_record
from cnpgen.trajectories import largest_error, load_trajectories
from tests.examples.documents import rewritten
from tests.examples.plan_files import plans_of
from tests.examples.plans import load as stored_plan
from tests.examples.scene_files import REQUEST, ROBOMETRICS, SCENE
from tests.examples.store import dataset  # noqa: F401 - a fixture
from tests.refusals import is_refused


@pytest.mark.parametrize("value", [[], {}, [1], {"a": 1}], ids=str)
def test_a_list_or_a_table_where_a_number_is_expected(
    dataset: Path,  # noqa: F811
    value: Any,
) -> None:
    task = shards(load_dataset_spec(dataset))[0]
    rewritten(dataset / task.sidecar, lambda record: record.update(seconds=value))
    with is_refused(DatasetError):
        load_record(dataset, task)


def test_a_histogram_with_one_bin_more_than_those_of_other_shards(
    dataset: Path,  # noqa: F811
) -> None:
    task = shards(load_dataset_spec(dataset))[0]
    rewritten(
        dataset / task.sidecar,
        lambda record: record["statistics"]["clearance"]["histogram"]["counts"][
            0
        ].append(0),
    )
    (problem,) = inspect_dataset(dataset).summary.problems
    assert "a histogram must have shape (1, 64), got (1, 65)" in problem


def test_an_archive_whose_damage_a_library_reports_with_the_content_of_the_file(
    tmp_path: Path,
) -> None:
    path = tmp_path / "plans.npz"
    np.savez(path, q=np.zeros((4000, 7)))
    content = bytearray(path.read_bytes())
    content[26:28] = (30_000).to_bytes(
        2, "little"
    )  # the length of the member's name, which zipfile's message repeats
    path.write_bytes(content)
    with pytest.raises(UsageError) as caught:
        load_trajectories(path, "airhockey")
    assert str(caught.value).startswith(f"{path} is not an archive")
    assert len(str(caught.value)) <= MAX_LINE_LENGTH


def test_a_long_line_of_a_recipe() -> None:
    error = RecipeError(["key" * MAX_LINE_LENGTH, "another"])
    assert [len(line) <= MAX_LINE_LENGTH for line in error.errors] == [True, True]
    assert RecipeError(error.errors).errors == error.errors


def test_a_message_lists_a_limited_number_of_errors():
    error = RecipeError([f"obstacle {k}: bad" for k in range(206)])
    lines = str(error).splitlines()
    assert len(lines) == MAX_ERROR_LINES + 1
    assert lines[-1] == f"and {206 - MAX_ERROR_LINES} more errors"
    assert len(error.errors) == 206


@pytest.mark.parametrize("planned", [True, False])
def test_a_link_with_the_name_of_a_fixed_joint(tmp_path: Path, planned: bool) -> None:
    problem = load_problem("airhockey")
    shutil.copytree(problem.path.parent, tmp_path / "airhockey")
    path = tmp_path / "airhockey" / problem.robot.urdf
    joint = "joint_1" if planned else "joint_7"
    path.write_text(
        path.read_text(encoding="utf-8").replace('"link_3"', f'"{joint}"'),
        encoding="utf-8",
    )
    robot = load_robot(load_problem(tmp_path / "airhockey" / "problem.toml"))
    assert robot.capsule_axes == load_robot(problem).capsule_axes


def test_a_rate_whose_differences_are_infinite(tmp_path: Path) -> None:
    plans = plans_of(stored_plan("hit"), stored_plan("hit"))
    plans.rate_control_points[1, 5] = -1e308
    save_plans(tmp_path / "plans.h5", plans)
    found = load_plans(tmp_path / "plans.h5")
    assert screen(found).tolist() == [PlanStatus.UNKNOWN, PlanStatus.NOT_FORWARD]
    assert evaluate_plans(found, workers=1).valid.tolist() == [True, False]
    assert np.isfinite(found.duration[0])


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: load_family("tabletop", "a b"), "parameters"),
        (lambda: load_family({}), "name"),
        (lambda: PuckModel(friction="x"), "friction"),
        (lambda: PuckModel(drag=np.zeros(2)), "drag"),
        (lambda: save_scenes("scenes.h5", [None]), "scenes"),
        (lambda: largest_error({"x": 1}, [0.0, 1.0], [[0.0], [1.0]]), "motion"),
        (lambda: load_trajectories("missing.csv", "airhockey"), "path"),
        (
            lambda: SceneProblem(
                name="a", obstacles=(), start_q=None, goal_q=np.zeros((1, 7))
            ),
            "start_q",
        ),
        (lambda: Grasp(None, np.ones(3)), "position"),
    ],
)
def test_wrong_arguments_of_scenes_and_trajectories_are_named(
    call: Any, argument: str
) -> None:
    with pytest.raises(UsageError) as caught:
        call()
    assert caught.value.argument == argument


def test_empty_states_in_a_scene_of_robometrics(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    lines = [
        line
        for line in ROBOMETRICS.splitlines()
        if "start:" not in line and not line.startswith("  - [")
    ]
    (tmp_path / "scene.yaml").write_text("\n".join(lines))
    (scene,) = load_scenes(tmp_path / "scene.yaml")
    assert scene.goal_q.shape == (0, 0)


def test_numbers_written_as_texts_in_a_trajectory(tmp_path: Path) -> None:
    rows = [{"t": str(k), "q": [0.1 * k] * 6} for k in range(3)]
    (tmp_path / "rows.json").write_text(json.dumps(rows))
    with is_refused(UsageError, argument="path"):
        load_trajectories(tmp_path / "rows.json", "airhockey")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[0.002]", "[]", r"dimensions of the goal region must be positive, got \[\]"),
        ("[0.002]", "[nan]", "dimensions of the goal region must be positive"),
        ("[0.002]", "[-1]", "dimensions of the goal region must be positive"),
        (
            "orientation_constraints:",
            "orientation_constraints: [7]\n    other:",
            "must be a mapping, got",
        ),
    ],
)
def test_a_goal_region_without_a_size_and_an_orientation_that_is_a_number(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    (tmp_path / "scene1.yaml").write_text(SCENE, encoding="utf-8")
    (tmp_path / "request1.yaml").write_text(REQUEST.replace(old, new), encoding="utf-8")
    with pytest.raises(SceneError, match=message):
        load_scenes(tmp_path)


def test_an_answer_in_a_row_of_results_without_its_ending(tmp_path: Path) -> None:
    results = open_results(tmp_path / "results.jsonl", {"steps": 10})
    results.append({"problem": 0, "answer": {"t": ["0,5"], "q": [[0.0]]}})
    results.file.close()
    with is_refused(DatasetError):
        open_results(tmp_path / "results.jsonl", {"steps": 10})
