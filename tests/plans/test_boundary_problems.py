"""Boundary problems to solve: rows of datasets and boundary conditions in HDF5, refused by what is wrong there."""

import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import CnpgenError, DatasetError, RecipeError, UsageError
from cnpgen.plans import PlanStatus, load_plans, save_plans
from cnpgen.plans.boundary_problems import load_boundary_problems
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import ProblemRecord, record_problem
from cnpgen.refine.refine_plans import solve_plans
from tests.refusals import is_refused

Tiny = Callable[[str], Path]


@cache
def record() -> ProblemRecord:
    return record_problem(load_problem("airhockey"))


CONDITIONS = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")


@pytest.fixture(scope="module")
def rows(tiny: Tiny) -> Any:
    return load_boundary_problems(tiny("airhockey-replan"), n=3)


@pytest.fixture
def write(tmp_path: Path, rows: Any) -> Callable[..., Path]:
    """Write the rows' boundary conditions, some of them changed or left out, with attributes, as anybody would."""

    def call(
        name: str = "tasks.h5", attributes: dict[str, Any] | None = None, **changed: Any
    ) -> Path:
        columns = {key: getattr(rows.boundary, key) for key in CONDITIONS} | changed
        with h5py.File(tmp_path / name, "w") as file:
            file.attrs.update(attributes or {})
            for key, values in columns.items():
                if values is not None:
                    file[key] = values
        return tmp_path / name

    return call


def test_a_file_of_boundary_conditions_is_what_its_numbers_say(rows, write) -> None:
    found = load_boundary_problems(
        write(sample_id=np.array([7, 3, 5]), hit_angle=np.zeros(3)), problem="airhockey"
    )
    for name in CONDITIONS:
        np.testing.assert_array_equal(
            getattr(found.boundary, name), getattr(rows.boundary, name)
        )
    assert found.sample_id.tolist() == [7, 3, 5]
    assert set(found.columns) == {"start_xyz", "goal_xyz", "hit_angle"}
    np.testing.assert_allclose(
        found.columns["goal_xyz"], rows.columns["goal_xyz"], atol=1e-12
    )
    assert np.isnan(found.path_control_points).all()
    assert found.source == "boundary conditions in tasks.h5"


def test_what_is_left_out_is_zero_and_goal_accelerations_are_kept_where_they_are_given(
    write,
) -> None:
    still = load_boundary_problems(
        write(start_dq=None, start_ddq=None, goal_dq=None), problem=record()
    )
    assert not np.any(
        [still.boundary.start_dq, still.boundary.start_ddq, still.boundary.goal_dq]
    )
    assert still.boundary.goal_ddq is None
    fixed = load_boundary_problems(
        write(goal_ddq=np.full((3, 6), 0.5)), problem=record()
    )
    np.testing.assert_array_equal(fixed.boundary.goal_ddq, np.full((3, 6), 0.5))


def test_a_file_may_say_its_problem_itself(write) -> None:
    assert (
        load_boundary_problems(write(attributes={"problem": "airhockey"})).problem
        == record()
    )
    texts = {
        "problem_recipe": record().recipe,
        "problem_urdf": record().urdf,
        "problem_sha256": record().comparable_sha256,
    }
    assert load_boundary_problems(write(attributes=texts)).problem == record()


def test_a_shard_is_of_the_problem_of_its_dataset_and_needs_one_without_it(
    tiny: Tiny, tmp_path: Path, rows
) -> None:
    shard = tiny("airhockey-replan") / "train" / "shard-00000.h5"
    found = load_boundary_problems(shard)
    assert found.problem.comparable_sha256 == record().comparable_sha256
    np.testing.assert_array_equal(found.boundary.start_ddq[:3], rows.boundary.start_ddq)
    with is_refused(DatasetError):
        load_boundary_problems(shard, problem="heavy-object")
    alone = shutil.copy(shard, tmp_path / "alone.h5")
    with is_refused(UsageError, argument="problem"):
        load_boundary_problems(alone)
    assert len(load_boundary_problems(alone, problem="airhockey")) == len(found)


def test_plans_in_a_file_are_not_looked_at(tmp_path: Path, rows) -> None:
    save_plans(tmp_path / "plans.h5", solve_plans(rows, workers=1).plans)
    found = load_boundary_problems(tmp_path / "plans.h5")
    assert np.isnan(found.path_control_points).all()
    np.testing.assert_array_equal(found.boundary.goal_dq, rows.boundary.goal_dq)


@pytest.mark.parametrize(
    ("changed", "attributes", "message"),
    [
        (
            {"goal_q": None, "start_q": None},
            {},
            r"lacks start_q and goal_q: boundary conditions are needed",
        ),
        ({}, {"problem": "airhokey"}, r"attribute 'problem'.*did you mean 'airhockey'"),
        (
            {},
            {"problem": "airhockey", "problem_sha256": "0" * 64},
            r"is of another 'airhockey'",
        ),
        (
            {"start_q": np.zeros((3, 7))},
            {"problem": "airhockey"},
            r"start_q must have shape \(6,\) or \(N, 6\)",
        ),
        (
            {"start_dq": np.zeros((2, 6))},
            {"problem": "airhockey"},
            r"start_dq has 2 rows, another .* has 3",
        ),
        (
            {"goal_q": np.full((3, 6), np.nan)},
            {"problem": "airhockey"},
            r"goal_q must be finite, got .* in row 0",
        ),
        (
            {"goal_q": [["a"] * 6] * 3},
            {"problem": "airhockey"},
            r"goal_q must hold numbers",
        ),
        (
            {"sample_id": np.array([0.5] * 3)},
            {"problem": "airhockey"},
            r"sample_id must hold 3 integers",
        ),
        (
            {"goal_q": np.zeros((1, 6))},
            {"problem": "airhockey"},
            r"goal_q has shape \(1, 6\), expected \(3, 6\)",
        ),
        (
            {"goal_dq": None, "goal_qd": np.zeros((3, 6))},
            {},
            r"'goal_qd' is almost 'goal_dq', which the file lacks",
        ),
        (
            {"hit_angle": np.zeros(2)},
            {"problem": "airhockey"},
            r"hit_angle must have shape \(3,\)",
        ),
    ],
)
def test_a_file_that_cannot_be_meant_is_refused_by_name(
    write, changed, attributes, message: str
) -> None:
    with pytest.raises(DatasetError, match=message):
        load_boundary_problems(write(attributes=attributes, **changed))


def test_names_that_resemble_none_of_a_boundary_condition_are_passed_over(
    write,
) -> None:
    foreign = {
        "goal_xyz": np.zeros((3, 3)),
        "goal_tau": np.zeros(3),
        "score": np.zeros(3),
    }
    assert (
        len(load_boundary_problems(write(goal_dq=None, **foreign), problem="airhockey"))
        == 3
    )


def test_a_problem_that_a_file_is_not_of_is_refused(write) -> None:
    with is_refused(DatasetError):
        load_boundary_problems(
            write(attributes={"problem_sha256": "0" * 64}), problem="airhockey"
        )
    with is_refused(DatasetError):
        load_boundary_problems(
            write(attributes={"problem": "airhockey"}), problem="heavy-object"
        )
    with is_refused(RecipeError, argument="problem"):
        load_boundary_problems(write(), problem="airhokey")


def test_what_is_for_folders_is_refused_of_files_and_the_other_way_round(
    tiny: Tiny, write, tmp_path: Path
) -> None:
    with is_refused(UsageError, argument="split"):
        load_boundary_problems(write(), n=2)
    with is_refused(UsageError, argument="problem"):
        load_boundary_problems(tiny("airhockey-hit"), problem="airhockey")
    with is_refused(UsageError, argument="path"):
        load_boundary_problems(tmp_path / "nowhere.h5")
    with is_refused(UsageError, argument="path"):
        load_boundary_problems(tmp_path / "nowhere")
    with is_refused(CnpgenError, argument="path"):
        load_boundary_problems(
            Path(__file__).parents[2] / "datasets" / "models" / "airhockey-hit.h5"
        )


def test_solve_makes_plans_for_a_file_of_boundary_conditions(
    rows, write, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    write("tasks.h5")
    assert (
        main(["solve", "tasks.h5", "--problem", "airhockey", "--quiet", "--json"]) == 0
    )
    assert json.loads(capsys.readouterr().out)["file"] == "tasks-plans.h5"
    made, expected = load_plans("tasks-plans.h5"), solve_plans(rows, workers=1).plans
    assert (made.status == PlanStatus.VALID).all()
    np.testing.assert_allclose(
        made.path_control_points, expected.path_control_points, atol=1e-9
    )
    np.testing.assert_allclose(
        made.rate_control_points, expected.rate_control_points, atol=1e-9
    )


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["tasks.h5"],
            "tasks.h5 does not name its problem: set its attribute 'problem' to a name or a file, or pass",
        ),
        (
            ["tasks.h5", "--n", "2"],
            "--n needs the folder of a dataset, got a file",
        ),
        (
            ["tasks.csv", "--n", "2"],
            "tasks.csv is a table, expected a recipe: 'cnpgen complete NAME tasks.csv -o",
        ),
        (
            ["pucks.h5"],
            "pucks.h5 lacks start_q and goal_q: boundary conditions are needed to plan; of tasks in the",
        ),
        (
            ["tasks.h5", "--seed", "2"],
            "--seed is for fresh draws of a recipe, got a file of boundary conditions",
        ),
        (
            ["airhockey-hit", "--n", "1", "--problem", "airhockey"],
            "--problem is for boundary conditions in HDF5",
        ),
        (["empty.h5", "--problem", "airhockey"], "no boundary conditions in empty.h5"),
    ],
)
def test_options_of_solve_that_mean_nothing_for_what_is_given_are_refused(
    words: list[str], line: str, write, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    write("tasks.h5")
    write("empty.h5", **dict.fromkeys(CONDITIONS, np.zeros((0, 6))))
    write("pucks.h5", **dict.fromkeys(CONDITIONS), goal_xyz=np.zeros((1, 3)))
    (tmp_path / "tasks.csv").write_text(
        "goal_xyz.x,goal_xyz.y\n1,0\n", encoding="utf-8"
    )
    before = sorted(tmp_path.iterdir())
    assert main(["solve", *words]) in {1, 2}
    assert f"cnpgen: error: {line}" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_the_folder_of_a_dataset_may_be_called_as_a_file(
    tiny: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(tiny("airhockey-hit"), tmp_path / "hits.h5"))
    assert len(load_boundary_problems(folder, split="validation", n=3)) == 3
