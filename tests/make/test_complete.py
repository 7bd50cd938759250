"""Completing tasks from Python and from tables: problems to solve, which task each is, what is wrong with a table."""

import os
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

import cnpgen
from cnpgen.errors import DatasetError, UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.make.complete import complete
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import make_plans
from cnpgen.problems.problem_record import as_record, open_problem
from cnpgen.schema.catalogue import list_recipes
from cnpgen.trajectory.boundary import Boundary
from tests.examples.example_robots import needs_robots
from tests.refusals import is_refused

GOALS = [[1.0, 0.1], [3.0, 0.0], [1.1, -0.2]]  # m; the second is out of reach
ANGLES = [0.0, 0.1, 0.2]  # rad
BOTH = (
    "".join(f"start_q.joint_{joint}," for joint in range(1, 7))
    + "goal_xyz.x,goal_xyz.y,"
)
# Their base is no start: the tool is above the plane, the object upside down.
NEED_A_START = {"ur5-wipe", "heavy-object", "heavy-object-drive", "heavy-object-loads"}
PROBLEMS = [
    pytest.param(name, marks=needs_robots)
    if name.startswith(("panda", "ur5"))
    else name
    for name in list_recipes("problem")
]


@pytest.fixture(scope="module")
def found():
    return complete("airhockey-replan", goal_xyz=GOALS, hit_angle=ANGLES)


def test_problems_say_which_tasks_they_are_and_the_others_why_they_have_no_answer(
    found,
):
    assert found.reasons == ("", "no hitting configuration", "")
    assert found.rejections == {"no hitting configuration": 1}
    np.testing.assert_array_equal(found.plans.sample_id, [0, 2])
    np.testing.assert_allclose(
        found.plans.columns["goal_xyz"][:, :2], [GOALS[0], GOALS[2]]
    )
    np.testing.assert_array_equal(found.plans.columns["hit_angle"], [0.0, 0.2])
    assert "2 of 3 tasks" in repr(found)


def test_what_is_completed_can_be_solved(found):
    assert cnpgen.solve_plans(found.plans[0], workers=1).valid.all()


def test_one_task_is_written_without_a_list_and_one_value_holds_for_all():
    (alone,) = complete("airhockey-hit", goal_xyz=[1.0, 0.1], hit_angle=0.3).plans
    both = complete(
        "airhockey-hit", goal_xyz=[[1.0, 0.1], [1.0, 0.2]], hit_angle=0.3
    ).plans
    np.testing.assert_array_equal(alone.boundary.goal_q[0], both.boundary.goal_q[0])
    np.testing.assert_array_equal(both.columns["hit_angle"], [0.3, 0.3])


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"goal_xyz": [1.0]},
            r"goal_xyz must have shape \(3,\) or \(N, 3\), got \(1,\)",
        ),
        (
            {"goal_xyz": [np.nan, 0.0]},
            r"goal_xyz must be finite, got \[nan +0.\] in task 0",
        ),
        (
            {"goal_xyz": np.zeros((3, 2)), "hit_angle": [0.0, 1.0]},
            "hit_angle is given for 2 tasks, another",
        ),
        ({"goal_xyz": np.zeros((0, 2))}, "goal_xyz has no rows"),
        ({"goal_xyz": "here"}, "goal_xyz must be an array of numbers"),
    ],
)
def test_columns_of_a_wrong_shape_are_refused(columns, message):
    with pytest.raises(UsageError, match=message):
        complete("airhockey-hit", **columns)


@pytest.mark.slow
def test_without_a_table_positions_need_all_three_coordinates():
    with is_refused(UsageError, argument="goal_xyz"):
        complete("heavy-object", start_xyz=[0.4, -0.4, 0.3], goal_xyz=[0.4, 0.4])
    assert complete(
        "heavy-object", start_xyz=[0.4, -0.4, 0.3], goal_xyz=[0.4, 0.4, 0.3]
    ).reasons == ("",)


def test_a_table_of_csv_and_one_of_hdf5_give_what_python_gives(found, tmp_path):
    lines = [
        "goal_xyz.x, goal_xyz.y ,hit_angle",
        *(f"{x},{y},{a}" for (x, y), a in zip(GOALS, ANGLES, strict=True)),
        "",
    ]
    (tmp_path / "tasks.csv").write_text("\n".join(lines), encoding="utf-8-sig")
    with h5py.File(tmp_path / "tasks.h5", "w") as file:
        file["goal_xyz"], file["hit_angle"] = (
            np.array([[*goal, 0.16] for goal in GOALS]),
            ANGLES,
        )
    with h5py.File(tmp_path / "parts.h5", "w") as file:
        (file["goal_xyz.x"], file["goal_xyz.y"]), file["hit_angle"] = (
            np.array(GOALS).T,
            ANGLES,
        )
    with h5py.File(
        tmp_path / "behind.h5", "w", userblock_size=512
    ) as file:  # the format leaves users a first block
        file["goal_xyz"], file["hit_angle"] = (
            np.array([[*goal, 0.16] for goal in GOALS]),
            ANGLES,
        )
    for name in ("tasks.csv", "tasks.h5", "parts.h5", "behind.h5"):
        again = complete("airhockey-replan", tmp_path / name)
        assert again.reasons == found.reasons
        np.testing.assert_array_equal(
            again.plans.boundary.goal_dq, found.plans.boundary.goal_dq
        )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "goal_xyz.x,goal_xyz.y\n",
            "tasks.csv has no tasks: it names columns (goal_xyz.x, goal_xyz.y), but has no",
        ),
        (
            "hit_angle\n1\n",
            "tasks.csv: tasks of the pipeline 'airhockey-replan' must give goal_xyz",
        ),
        (
            f"{BOTH}start_xyz.x,start_xyz.y\n{'1,' * 8}1,1\n",
            "tasks.csv: start_q and start_xyz are both given",
        ),
        (
            "goal_xyz.x,goal_xyz.y,hit_speed,hit_speed_share\n1,0,1,1\n",
            "tasks.csv: hit_speed and hit_speed_share both",
        ),
        (
            "goal_xyz.x;goal_xyz.y\n1,0;0,5\n",
            "tasks.csv: line 1: columns are separated by ',', got ';'",
        ),
        ("", "is empty: its first line must name columns"),
        (
            "goal_xyz.x,goal_xyz.w\n1,2\n",
            "cannot give 'goal_xyz.w' (did you mean 'goal_xyz.",
        ),
        (
            "colour,goal_xyz.y\n1,2\n",
            "cannot give 'colour', only start_xyz, goal_xyz, start_q",
        ),
        ("goal_xyz.y,hit_angle\n1,2\n", "lacks goal_xyz.x beside goal_xyz.y"),
        ("start_q.joint_1,goal_xyz.x,goal_xyz.y\n1,2,3\n", "lacks start_q.joint_2"),
        (
            "goal_xyz.x,goal_xyz.y\n1,2,3\n",
            "line 2 has 3 values, the first line names 2 columns",
        ),
        (
            "goal_xyz.x,goal_xyz.y\n1,2\n\n1,left\n",
            "line 4: goal_xyz.y must be a number, got 'left'",
        ),
        (
            "goal_xyz.x,goal_xyz.y\n1,nan\n",
            "goal_xyz.y must be a finite number in every task, got nan in task 0",
        ),
        (
            "goal_xyz.x,goal_xyz.x\n1,2\n",
            "the column 'goal_xyz.x' is there more than once",
        ),
        (
            ",".join(map(str, range(100_000))) + "\n",
            "line 1 names 100,000 columns, expected at most 1,000",
        ),
    ],
)
def test_a_table_with_a_mistake_is_refused_with_the_place(tmp_path, text, message):
    path = tmp_path / "tasks.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DatasetError) as error:
        complete("airhockey-replan", path)
    assert message in str(error.value)


def test_a_machine_without_a_compiler_is_warned_of_once(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "cnpgen.make.complete.choose_backend", once := Mock(side_effect=choose_backend)
    )
    (tmp_path / "tasks.csv").write_text(
        "goal_xyz.x,goal_xyz.y\n1,0\n", encoding="utf-8"
    )
    complete("airhockey-replan", tmp_path / "tasks.csv")
    once.assert_called_once()


def test_a_table_of_nothing_but_a_size_is_refused(tmp_path):
    (tmp_path / "tasks.csv").write_text(
        "goal_xyz.x,goal_xyz.y\n1,2\n", encoding="utf-8"
    )
    os.truncate(tmp_path / "tasks.csv", 1 << 40)
    with is_refused(DatasetError):
        complete("airhockey-replan", tmp_path / "tasks.csv")


def test_a_table_without_heights_is_refused_where_no_table_gives_them(tmp_path):
    (tmp_path / "tasks.csv").write_text(
        "goal_xyz.x,goal_xyz.y\n1,0\n", encoding="utf-8"
    )
    with is_refused(DatasetError):
        complete("heavy-object", tmp_path / "tasks.csv")


def test_hdf5_with_columns_of_different_lengths_or_no_numbers_is_refused(tmp_path):
    with h5py.File(tmp_path / "long.h5", "w") as file:
        file["goal_xyz"], file["hit_angle"] = np.zeros((2, 3)), [0.0]
    with h5py.File(tmp_path / "text.h5", "w") as file:
        file["goal_xyz"] = "here"
    for name, message in (
        ("long", "one value per task each, got goal_xyz"),
        ("text", "goal_xyz must hold numbers, got object"),
    ):
        with pytest.raises(DatasetError, match=message):
            complete("airhockey-replan", tmp_path / f"{name}.h5")


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_default_start_of_every_shipped_problem_is_valid_or_documented(name):
    problem, robot = open_problem(as_record(name))
    base = robot.home[None]
    still, spline = np.zeros_like(base), problem.trajectory
    parameters = robot.nominal_parameters[None] if robot.parameters.names else None
    boundary = Boundary(base, still, still, base, still, parameters=parameters)
    path = np.repeat(base[:, None], spline.path_control_points, axis=1)
    rate = np.ones((1, spline.rate_control_points))
    plans = make_plans(
        name, boundary, path_control_points=path, rate_control_points=rate
    )
    assert evaluate_plans(plans, workers=1).valid[0] == (name not in NEED_A_START)
    guide = Path(__file__).parents[2] / "docs" / "how-to" / "tasks.md"
    sentence = "`ur5-wipe` and `heavy-object*` need a start"
    assert sentence in guide.read_text(encoding="utf-8")


def test_the_default_start_on_a_table_answers_a_goal_alone():
    assert complete("airhockey-tables", goal_xyz=GOALS[0]).reasons == ("",)
