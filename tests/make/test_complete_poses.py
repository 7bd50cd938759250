"""Tasks whose goals are poses of the tip: goal states with tolerances, reasons, and the best motion to any of them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, UsageError
from cnpgen.plans.join import concatenate
from cnpgen.problems.problem import Problem
from cnpgen.refine.goal_options import goal_groups, min_durations, refine_to_any
from cnpgen.refine.task import Attempt, Outcome
from tests.examples.shaped_robot import SELF, write_problem
from tests.refusals import is_refused

VELOCITY = '[[constraint]]\nuse = "joint-velocity"\ntolerance = "0.2 %"\n'
GOALS = [
    [0.4, 0.4, 0.5],
    [3.0, 0.0, 0.3],
    [0.0, 0.0, 0.32],
]  # m; the second is out of reach, the third in the arm
OUT_OF_REACH = "no inverse kinematics of the goal"


@pytest.fixture(scope="module")
def crane(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_problem(
        tmp_path_factory.mktemp("crane"), obstacles="", more=SELF + VELOCITY
    )


@pytest.fixture(scope="module")
def problem(crane: Path) -> Problem:
    return cnpgen.load_problem(crane)


def quaternion(rotation: np.ndarray) -> list[float]:
    """Return the quaternion w, x, y, z of a rotation matrix by less than half a turn."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return [w, *(skew / (4 * w))]


def test_a_task_has_several_goal_states_with_its_pose(problem: Problem) -> None:
    found = cnpgen.complete(
        problem, goal_xyz=GOALS[:2], goal_xyz_tolerance=[0.0, 0.0, 0.02]
    )
    assert found.reasons == ("", OUT_OF_REACH)
    assert len(found) == 1
    plans = found.plans
    assert len(plans) > 1
    assert set(plans.sample_id) == {0}
    assert plans.columns["goal_option"].tolist() == list(range(len(plans)))
    error = np.abs(plans.columns["goal_xyz"] - GOALS[0])
    assert error[:, :2].max() < 1e-5
    assert error[:, 2].max() < 0.02 + 1e-5
    assert (np.diff(min_durations(plans)) >= 0).all()
    difference = np.abs(plans.boundary.goal_q[:, None] - plans.boundary.goal_q).max(
        axis=2
    )
    assert difference[~np.eye(len(plans), dtype=bool)].min() > 0.29


def test_goal_states_meet_the_constraints_of_the_problem(tmp_path: Path) -> None:
    more = SELF + VELOCITY + '[[constraint]]\nuse = "vertical"\ntolerance = "2 deg"\n'
    problem = cnpgen.load_problem(write_problem(tmp_path, obstacles="", more=more))
    level, tilted = np.array([[0.7, -0.6, 0.6, 0.0], [0.7, -0.6, 1.0, 0.0]])
    positions, rotations = cnpgen.RobotModel(problem).forward_kinematics(
        np.array([level, tilted])
    )
    task = {"start_q": [0.0, -0.6, 0.6, 0.0], "goal_rotation_tolerance": [0, 0, 3.15]}
    found = cnpgen.complete(
        problem,
        **task,
        goal_xyz=positions,
        goal_wxyz=[quaternion(each) for each in rotations],
    )
    assert found.reasons == ("", "all goal states in collision or off a constraint")
    for q in found.plans.boundary.goal_q:
        assert abs(q[1] + q[2]) < np.deg2rad(2)
    start = [0.0, -0.6, 0.9, 0.0]
    found = cnpgen.complete(problem, **task | {"start_q": start}, goal_xyz=positions[0])
    assert found.reasons == (
        "start in collision, outside its limits or off a constraint",
    )


def test_tolerances_in_degrees_are_refused(problem: Problem) -> None:
    with is_refused(UsageError, argument="goal_rotation_tolerance"):
        cnpgen.complete(
            problem, goal_xyz=GOALS[0], goal_rotation_tolerance=[0.0, 0.0, 180.0]
        )


def test_a_quaternion_is_met_and_pi_frees_an_axis(problem: Problem) -> None:
    (aim,) = cnpgen.complete(problem, goal_xyz=GOALS[0]).plans[0]
    model = cnpgen.RobotModel(problem)
    (rotation,) = model.forward_kinematics(aim.boundary.goal_q)[1]
    task = {"goal_xyz": GOALS[0], "goal_wxyz": quaternion(rotation)}
    exact = cnpgen.complete(problem, **task).plans
    free = cnpgen.complete(
        problem, **task, goal_rotation_tolerance=[np.pi, 0.0, 0.0]
    ).plans
    poses = model.forward_kinematics(exact.boundary.goal_q)[1]
    assert np.abs(poses - rotation).max() < 1e-4
    axes = model.forward_kinematics(free.boundary.goal_q)[1][:, :, 0]
    assert np.abs(axes - rotation[:, 0]).max() < 1e-4  # turned about x only
    assert len(free) >= len(exact)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"goal_q": [0.0] * 4},
            r"has no column to give 'goal_q'.*only start_q, goal_xyz, goal_wxyz",
        ),
        ({"start_q": [0.0] * 4}, "must give goal_xyz"),
        (
            {"goal_xyz": GOALS[0], "goal_wxyz": [0.0] * 4},
            "goal_wxyz quaternion .* is zero, expected length 1 in task 0",
        ),
        (
            {"goal_xyz": GOALS[0], "goal_xyz_tolerance": [-1, 0, 0]},
            "goal_xyz_tolerance must not be negative",
        ),
        ({"goal_xyz": [400, 400, 500]}, "did you mean 400 mm = 0.4 m"),
    ],
)
def test_wrong_columns_are_refused(
    problem: Problem, columns: dict[str, list[float]], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        cnpgen.complete(problem, **columns)


def test_the_command_takes_tables_of_poses(
    crane: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, out = tmp_path / "tasks.csv", tmp_path / "problems.h5"
    table.write_text(
        "goal_xyz.x,goal_xyz.y,goal_xyz.z\n0.4,0.4,0.5\n3,0,0.3\n", encoding="utf-8"
    )
    assert main(["complete", str(crane), str(table), "-o", str(out)]) == 0
    captured = capsys.readouterr()
    assert "1 of 2 tasks completed" in captured.err
    assert f"1 {OUT_OF_REACH}: task 1" in captured.err
    problems = cnpgen.load_boundary_problems(out)
    assert len(problems) == len(problems.columns["goal_option"]) > 1
    table.write_text("goal_xyz.x,goal_xyz.y\n1,2\n", encoding="utf-8")
    with is_refused(DatasetError):
        cnpgen.complete(crane, table)


def attempts(cost: dict[int, float], tried: list[int]) -> Callable[[Any], Attempt]:
    """Return a stand-in for the refiner: number of a goal state -> cost, invalid if there is none."""

    def refine(number: int) -> Attempt:
        tried.append(number)
        return Attempt(
            path=np.zeros((2, 2)),
            rate=np.ones(2),
            cost=cost.get(number, np.inf),
            outcome=Outcome.SOLVED,
            reason="ok" if number in cost else "robot in collision",
        )

    return refine


@pytest.mark.parametrize(
    ("cost", "first_valid", "chosen", "tried"),
    [
        ({0: 9.0, 1: 8.0, 2: 8.5}, False, 1, [2, 0, 1]),
        ({1: 7.0}, False, 1, [2, 0, 1]),
        ({}, False, 2, [2, 0, 1]),  # the first attempt without a valid one
        ({0: 1.9, 1: 1.0}, False, 0, [2, 0]),  # no motion to goal state 1 is faster
        ({2: 9.0, 0: 8.0}, True, 2, [2]),
        ({0: 9.0, 1: 8.0}, True, 0, [2, 0]),
    ],
)
def test_the_best_valid_motion_to_any_goal_state_is_chosen(
    cost: dict[int, float], *, first_valid: bool, chosen: int, tried: list[int]
) -> None:
    calls = list[int]()
    found, best = refine_to_any(
        range(3),  # type: ignore[arg-type]
        attempts(cost, calls),
        order=[2, 0, 1],
        min_durations=np.array([1.0, 2.0, 1.5]),
        first_valid=first_valid,
    )
    assert (found, calls) == (chosen, tried)
    assert best.valid == bool(cost)


def test_goal_states_of_a_task_are_tried_in_their_order(problem: Problem) -> None:
    plans = cnpgen.complete(problem, goal_xyz=[GOALS[0], [0.4, -0.4, 0.5]]).plans
    counts = np.bincount(plans.sample_id)
    assert (counts >= 3).all()
    rows = np.arange(len(plans))
    assert goal_groups(plans) == [rows[: counts[0]].tolist(), rows[counts[0] :].tolist()]  # fmt: skip
    mixed = plans[rows[::-1]]
    assert goal_groups(mixed) == [rows[counts[1] - 1 :: -1].tolist(), rows[: counts[1] - 1 : -1].tolist()]  # fmt: skip


@pytest.mark.slow
def test_tasks_with_goal_poses_are_solved(problem: Problem) -> None:
    completed = cnpgen.complete(problem, goal_xyz=[GOALS[0], [0.4, -0.4, 0.5]])
    solved = cnpgen.solve_plans(completed.plans, workers=1)
    assert solved.plans.sample_id.tolist() == [0, 1]
    assert solved.valid.all()
    for row in range(2):
        options = completed.plans[completed.plans.sample_id == row]
        single = replace(
            options,
            columns={k: v for k, v in options.columns.items() if k != "goal_option"},
        )
        assert solved.plans.duration[row] == pytest.approx(
            cnpgen.solve_plans(single, workers=1).plans.duration.min()
        )


def test_unplanned_tasks_can_be_filled_in_place(problem: Problem) -> None:
    plans = cnpgen.complete(problem, goal_xyz=GOALS[0]).plans
    assert plans.path_control_points.flags.writeable
    assert plans.rate_control_points.flags.writeable


def test_tasks_with_one_number_are_refused_instead_of_merged(problem: Problem) -> None:
    first, second = (
        cnpgen.complete(problem, goal_xyz=goal).plans
        for goal in (GOALS[0], [0.4, 0.3, 0.5])
    )
    with is_refused(UsageError, argument="plans"):
        cnpgen.solve_plans(concatenate([first, second]), workers=1)
