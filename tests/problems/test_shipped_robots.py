"""The shipped problems of robots that an extra installs: rows, plans, and an independent look at both.

The look is Pinocchio's and Coal's at the meshes of the URDF and at what is held, every millisecond.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cnpgen import evaluate_plans, refine_plans, solve_plans
from cnpgen.judges.rows.verify import verify_rows
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.make_dataset import make_dataset
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.planner.planner import Planner
from cnpgen.plans import Plans
from cnpgen.plans.boundary_problems import load_boundary_problems
from cnpgen.problems.constraints.joint import JointJerk
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import Prepare
from tests.examples.example_robots import SHIPPED, folder, needs_robots
from tests.examples.meshes import Meshes, states

pytestmark = needs_robots
ROWS, PLANS = 500, 200  # of the long look
WAYS = ("from nothing", "from the planner", "certified")


@cache
def meshes_of(name: str) -> Meshes:
    problem = load_problem(name)
    return Meshes(problem, load_robot(problem), folder())


def touching(name: str, plans: Plans) -> list[int]:
    """Which of some plans touch something."""
    meshes = meshes_of(name)
    return [
        index
        for index in range(len(plans))
        if any(meshes.touches(q) for q in states(plans, index))
    ]


def ends_touch(name: str, boundary: Boundary) -> bool:
    return any(
        meshes_of(name).touches(q) for q in (*boundary.start_q, *boundary.goal_q)
    )


@pytest.mark.parametrize("name", SHIPPED)
def test_rows_and_plans_of_the_shipped_planner_touch_nothing(
    name: str, prepare: Prepare
) -> None:
    columns = (
        prepare(load_pipeline(name), "numpy").block(3, "train", 0, stop=20).columns
    )  # compiling takes minutes
    boundary = Boundary.from_batch(
        {name: values.T for name, values in columns.items()}, None
    )
    assert not ends_touch(name, boundary)
    plans = Planner(name, backend="numpy").plan_batch(boundary[:6])
    valid = evaluate_plans(plans, workers=1).valid
    assert valid.sum() >= 5
    assert touching(name, plans[valid]) == []


@pytest.mark.extended
@pytest.mark.parametrize("name", SHIPPED)
def test_rows_are_what_pinocchio_and_coal_call_valid_and_touch_nothing(
    name: str,
) -> None:
    problem, drawn = load_problem(name), draw_boundary_problems(name, ROWS, seed=4)
    columns = drawn.boundary.conditions() | drawn.columns
    found = verify_rows(problem, load_robot(problem), columns)
    assert found.rows == ROWS
    assert len(found.failed_rows) == 0
    assert not ends_touch(name, drawn.boundary)


def made(name: str, way: str, where: Path) -> Plans:
    """Plans that are made in one of ``WAYS``."""
    if way == "certified":
        make_dataset(
            name, where / "rows", n=11 * PLANS // 10, certify=True, workers=1
        )  # one of eleven is for validation
        return load_boundary_problems(where / "rows")
    problems = draw_boundary_problems(name, PLANS, seed=5)
    if way == "from nothing":
        return solve_plans(problems, workers=1).plans
    return refine_plans(Planner(name).plan_batch(problems.boundary), workers=1).plans


@pytest.mark.extended
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", SHIPPED)
def test_valid_plans_touch_nothing_and_keep_their_limits(
    name: str, way: str, tmp_path: Path
) -> None:
    plans = made(name, way, tmp_path)
    found = plans[evaluate_plans(plans, workers=1).valid]
    assert len(found) >= 0.97 * len(plans)
    assert touching(name, found) == []
    problem = load_problem(name)
    robot = load_robot(problem)
    limits = {"dq": robot.velocity_limit, "ddq": robot.acceleration_limit}
    if any(isinstance(each, JointJerk) for each in problem.constraint):
        limits["jerk"] = robot.jerk_limit
    moving = found.motion.at(np.linspace(0, 1, 4001))
    for what, limit in limits.items():
        assert (np.abs(getattr(moving, what)) <= 1.011 * limit).all(), what


def test_the_panda_has_frankas_limits_and_a_cup_of_a_kilogram():
    problem = load_problem("panda-cup")
    robot = load_robot(problem)
    np.testing.assert_array_equal(robot.velocity_limit, [2.175] * 4 + [2.61] * 3)
    np.testing.assert_array_equal(
        robot.acceleration_limit, [15, 7.5, 10, 12.5, 15, 20, 20]
    )
    np.testing.assert_array_equal(
        robot.jerk_limit, [7500, 3750, 5000, 6250, 7500, 10000, 10000]
    )
    np.testing.assert_array_equal(robot.torque_limit, [87] * 4 + [12] * 3)
    assert problem.payload.mass == 1.0
