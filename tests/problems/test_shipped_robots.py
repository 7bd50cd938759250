"""The shipped problems of robots that an extra installs: rows, plans, and an independent look at both."""

import numpy as np
import pytest

from cnpgen import draw_boundary_problems, solve_plans
from cnpgen.judges.rows.verify import verify_rows
from cnpgen.problems.constraints.joint import JointJerk
from cnpgen.problems.load import load_problem
from cnpgen.problems.robot import load_robot
from tests.examples.example_robots import SHIPPED, folder, needs_robots
from tests.examples.meshes import Meshes, states

pytestmark = [needs_robots, pytest.mark.extended]


@pytest.mark.parametrize("name", SHIPPED)
def test_rows_are_what_pinocchio_and_coal_call_valid_and_touch_nothing(name):
    problem = load_problem(name)
    robot, drawn = load_robot(problem), draw_boundary_problems(name, 60, seed=4)
    columns = {**vars(drawn.boundary), **drawn.columns}
    found = verify_rows(problem, robot, {key: value for key, value in columns.items() if value is not None})
    assert found.rows == 60
    assert len(found.out) == 0
    meshes = Meshes(problem, robot, folder())
    assert not any(meshes.touches(q) for q in (*drawn.boundary.start_q, *drawn.boundary.goal_q))


@pytest.mark.parametrize("name", SHIPPED)
def test_plans_from_nothing_touch_nothing_and_keep_their_limits(name):
    problem = load_problem(name)
    robot, found = load_robot(problem), solve_plans(draw_boundary_problems(name, 12, seed=5), workers=1)
    assert found.valid.sum() >= 11
    meshes = Meshes(problem, robot, folder())
    for index in np.flatnonzero(found.valid):
        assert not any(meshes.touches(q) for q in states(found.plans, int(index)))
    limits = {"dq": robot.velocity_limit, "ddq": robot.acceleration_limit}
    if any(isinstance(each, JointJerk) for each in problem.constraint):
        limits["jerk"] = robot.jerk_limit
    s = np.linspace(0, 1, 4001)
    moving = found.plans.motion[np.flatnonzero(found.valid)].at(s)
    for what, limit in limits.items():
        assert (np.abs(getattr(moving, what)) <= 1.011 * limit).all(), what


def test_the_panda_has_frankas_limits_and_a_cup_of_a_kilogram():
    problem = load_problem("panda-cup")
    robot = load_robot(problem)
    np.testing.assert_array_equal(robot.velocity_limit, [2.175] * 4 + [2.61] * 3)
    np.testing.assert_array_equal(robot.acceleration_limit, [15, 7.5, 10, 12.5, 15, 20, 20])
    np.testing.assert_array_equal(robot.jerk_limit, [7500, 3750, 5000, 6250, 7500, 10000, 10000])
    np.testing.assert_array_equal(robot.torque_limit, [87] * 4 + [12] * 3)
    assert problem.payload.mass == 1.0
