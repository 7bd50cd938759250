"""The Pinocchio model equals the XML of its URDF, or the URDF is refused."""

from dataclasses import replace
from random import Random

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import ProblemRecord, record_problem
from cnpgen.robots.chain import name_links_uniquely
from cnpgen.robots.robot import reduced_model
from cnpgen.robots.urdf import urdf_tree
from cnpgen.robots.urdf_parameters import check_model, urdf_parameters
from tests.examples.urdf_reading import bodies_in, differences
from tests.faults.mutations import changed_number

SHIPPED = ("airhockey", "heavy-object")
N_CHANGES = 150  # of each URDF; 4,000 of each take a minute and had no finding


def read_or_refused(name: str, number: int) -> tuple[str, list[str]]:
    """Change a URDF and load its robot; return the outcome and the differences from an independent reading."""
    problem = load_problem(name)
    urdf = changed_number(problem.urdf_text, Random(f"{name} {number}"))
    try:
        with (
            ProblemRecord(record_problem(problem).recipe, urdf).restored() as restored,
            np.errstate(all="ignore"),
        ):
            robot = load_robot(restored)
    except RecipeError:
        return "refused", []
    with np.errstate(all="ignore"):
        return "read", differences(robot, bodies_in(urdf, robot.joint_names))


@pytest.mark.parametrize("name", SHIPPED)
def test_a_changed_number_is_in_the_model_or_refused(name: str) -> None:
    outcomes = [read_or_refused(name, number) for number in range(N_CHANGES)]
    assert [
        (number, found) for number, (_, found) in enumerate(outcomes) if found
    ] == []
    assert {outcome for outcome, _ in outcomes} == {"read", "refused"}


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_urdfs_are_read_as_written(name: str) -> None:
    robot = load_robot(load_problem(name))
    assert differences(robot, bodies_in(robot.urdf_text, robot.joint_names)) == []


CHANGES = {
    r"the body of joint 'joint_3', of the links .*: Pinocchio reads its mass": lambda model: (
        model.appendBodyToJoint(
            3, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity()
        )
    ),
    r"joint 'joint_2': Pinocchio reads its <origin>": lambda model: move(
        model.jointPlacements[2]
    ),
    r"joint 'joint_2': .* its limit 'effort'": lambda model: (
        model.effortLimit.__setitem__(1, 7.0)
    ),
    r"joint 'joint_2': .* its limit 'upper'": lambda model: (
        model.upperPositionLimit.__setitem__(1, 7.0)
    ),
    r"joint 'joint_2': .* its limit 'velocity'": lambda model: (
        model.velocityLimit.__setitem__(1, 7.0)
    ),
    r"link '.*': Pinocchio reads its placement": lambda model: move(
        model.frames[model.nframes - 1].placement
    ),
}


def move(placement: pin.SE3) -> None:
    placement.translation = placement.translation + 0.5


@pytest.mark.parametrize("message", CHANGES)
def test_every_difference_names_its_joint_or_link(message: str) -> None:
    problem = load_problem("airhockey")
    model = pin.buildModelFromXML(problem.urdf_text)
    name_links_uniquely(model)
    parameters = urdf_parameters(urdf_tree(problem.urdf_text))
    check_model(model, parameters)
    CHANGES[message](model)
    with pytest.raises(RecipeError, match=message):
        check_model(model, parameters)


def test_joints_that_are_not_planned_are_part_of_the_body_that_carries_them() -> None:
    robot = load_robot(load_problem("airhockey"))
    fewer = robot.joint_names[:4]
    attached = replace(robot.attached, ranges={})
    model = reduced_model(robot.urdf, robot.urdf_text, fewer, attached)
    lumped = bodies_in(robot.urdf_text, fewer)[-1]
    assert model.inertias[4].mass == pytest.approx(lumped.mass)
    np.testing.assert_allclose(
        model.inertias[4].lever * lumped.mass, lumped.mass_center, atol=1e-12
    )
