"""Locked joints: the model is that of Pinocchio with these joints at their positions, and errors are named."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.urdf_changes import with_locked_joints
from tests.examples.shaped_robot import urdf, write_problem
from tests.refusals import is_refused

LIFT, GRIP = 0.7, -0.4  # rad and m
LOCKED = f"""
locked_joints = ["roll", "grip"]
locked_positions = [{LIFT}, {GRIP}]
"""


def lines(text: str) -> str:
    return text.replace(
        'joints = ["swing", "lift", "elbow", "roll"]',
        'joints = ["swing", "lift", "elbow"]',
    ).replace("[0.0, -0.4, 0.8, 0.0]", "[0.0, -0.4, 0.8]")


def problem_in(folder: Path, locked: str = LOCKED) -> Path:
    file = write_problem(folder, robot=locked, obstacles="", more="")
    text = lines(file.read_text()).replace(
        'use = "robot-clearance"', 'use = "joint-velocity"'
    )
    file.write_text(text)
    return file


@pytest.mark.parametrize("rotation", ["0 0 0", "0.3 -0.5 2"])
def test_the_model_is_that_of_pinocchio_at_the_positions(
    tmp_path: Path, rotation: str
) -> None:
    file = problem_in(tmp_path)
    path = tmp_path / "crane" / "crane.urdf"
    text = path.read_text().replace(
        '<origin xyz="0.3 0 0"/>', f'<origin xyz="0.3 0 0" rpy="{rotation}"/>'
    )
    text = text.replace('<axis xyz="1 0 0"/>', '<axis xyz="0.5 -0.2 0.4"/>')
    path.write_text(text)
    robot = load_robot(load_problem(file))
    full = pin.buildModelFromXML(text)
    data, own = full.createData(), robot.model.createData()
    assert list(robot.model.names)[1:] == ["swing", "lift", "elbow"]
    for q in np.random.default_rng(0).uniform(-1, 1, (5, 3)):
        pin.framesForwardKinematics(full, data, np.append(q, [LIFT, GRIP]))
        pin.framesForwardKinematics(robot.model, own, q)
        for link in ("hand", "claw"):
            expected = data.oMf[full.getFrameId(link)]
            found = own.oMf[robot.model.getFrameId(link)]
            np.testing.assert_allclose(
                found.homogeneous, expected.homogeneous, atol=1e-12
            )
        zero = np.zeros(5)
        torques = pin.rnea(full, data, np.append(q, [LIFT, GRIP]), zero, zero)[:3]
        np.testing.assert_allclose(
            pin.rnea(robot.model, own, q, zero[:3], zero[:3]), torques, atol=1e-10
        )


def test_a_stored_problem_has_the_same_robot(tmp_path: Path) -> None:
    problem = load_problem(problem_in(tmp_path))
    stored, robot = open_problem(record_problem(problem))
    assert stored.urdf_text == problem.urdf_text
    assert (
        with_locked_joints(problem.urdf_text, {"roll": LIFT}, is_stored=True).count(
            'type="fixed"'
        )
        >= 2
    )
    placements = zip(
        robot.model.jointPlacements,
        load_robot(problem).model.jointPlacements,
        strict=True,
    )
    assert all(
        np.array_equal(one.homogeneous, two.homogeneous) for one, two in placements
    )


def test_joints_that_mimic_a_locked_one_follow_it() -> None:
    mimic = '<mimic joint="roll" multiplier="-0.5" offset="0.1"/></joint>\n</robot>'
    text = urdf().replace("</joint>\n</robot>", mimic)
    fixed = with_locked_joints(text, {"roll": LIFT}, is_stored=False)
    both = with_locked_joints(
        urdf(), {"roll": LIFT, "grip": 0.1 - 0.5 * LIFT}, is_stored=False
    )
    assert fixed == both


@pytest.mark.parametrize(
    ("locked", "message"),
    [
        (
            LOCKED.replace(f"{GRIP}]", "5.0]"),
            "joint 'grip' is locked at 5 m, outside of its limits -2.5 to 2.5 m",
        ),
        (
            LOCKED.replace("grip", "gripp"),
            "the URDF has no joint 'gripp' .did you mean 'grip'",
        ),
        (
            LOCKED.replace(f", {GRIP}]", "]"),
            "locked_positions: expected 2 numbers, one per locked joint, got 1",
        ),
        (
            LOCKED.replace("roll", "lift"),
            "a joint is planned or locked, got lift in both lists",
        ),
        (LOCKED.replace("roll", "grip"), "each joint can be locked once"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, locked: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        load_robot(load_problem(problem_in(tmp_path, locked)))


def test_quaternions_of_locked_joints_are_refused() -> None:
    """As for other joints; zero angles in their place would turn all links that follow."""
    joint = urdf().replace(
        '"roll" type="revolute">',
        '"roll" type="revolute"><origin quat_xyzw="0 0 1 0"/>',
    )
    assert joint != urdf()
    with is_refused(RecipeError):
        with_locked_joints(joint, {"roll": 0.1}, is_stored=False)


def test_joints_without_a_position_are_refused() -> None:
    with is_refused(RecipeError):
        with_locked_joints(
            urdf().replace('"roll" type="revolute"', '"roll" type="fixed"'),
            {"roll": 0.1},
            is_stored=False,
        )
