"""Bodies that a problem adds to the robot of a URDF: against the same robot with a URDF that was edited by hand."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem, resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.robot import Robot
from cnpgen.world.world import World

ROOT = Path(__file__).parents[2]
HEAVY = ROOT / "problems" / "heavy-object"
TOOL = """
  <link name="tool"><inertial><origin xyz="0.01 0.02 0.03"/><mass value="2.5"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001" ixz="-0.002" iyz="0.003"/></inertial></link>
  <joint name="to_tool" type="fixed"><parent link="object"/><child link="tool"/>
    <origin xyz="0.1 -0.05 0.2" rpy="0.3 -0.4 0.5"/></joint>
"""
TIP = 'tip_offset = "[10, -5, 20] cm"\ntip_rotation = [0.3, -0.4, 0.5]\n'
INERTIA = "inertia = [0.02, 0.03, 0.04, 0.001, -0.002, 0.003]\n"
PAYLOAD = f'[payload]\nmass = "2.5 kg"\ncentre = [0.01, 0.02, 0.03]\n{INERTIA}'


def written(
    folder: Path, *, robot: str = "", limits: str = "", more: str = "", urdf: Any = str
) -> Problem:
    """The shipped problem with other keys, and its URDF changed."""
    text = (HEAVY / "problem.toml").read_text()
    if "acceleration" in limits:
        # Stated accelerations take the place of the rules.
        text = re.sub(r"\nacceleration_(rate|cap) = .*", "", text)
    text = text.replace("\n[limits]\n", f"{robot}\n{more}\n[limits]\n{limits}")
    (folder / "problem.toml").write_text(text)
    (folder / "iiwa14_object.urdf").write_text(
        urdf((HEAVY / "iiwa14_object.urdf").read_text())
    )
    return load_problem(folder / "problem.toml")


def error(problem: Problem) -> str:
    with pytest.raises(RecipeError) as caught:
        load_robot(problem)
    return str(caught.value)


@pytest.fixture
def by_hand(tmp_path: Path) -> Robot:
    """The robot with a tool in its URDF."""
    (tmp_path / "by_hand").mkdir()
    problem = written(
        tmp_path / "by_hand",
        urdf=lambda text: text.replace("</robot>", TOOL + "</robot>"),
    )
    return load_robot(replace(problem, robot=replace(problem.robot, tip="tool")))


def test_a_tip_with_an_offset_and_a_payload_are_what_a_tool_in_the_urdf_is(
    tmp_path, by_hand
):
    robot = load_robot(written(tmp_path, robot=TIP, more=PAYLOAD))
    random = np.random.default_rng(0)
    one, other = World(robot), World(by_hand)
    for q, dq, ddq in random.normal(size=(20, 3, robot.n)):
        one.set_state(q, dq, ddq, np.zeros(0))
        other.set_state(q, dq, ddq, np.zeros(0))
        for what in (
            "tip_position",
            "tip_rotation",
            "tip_velocity",
            "tip_acceleration",
            "tip_jacobian",
            "torque",
        ):
            np.testing.assert_allclose(
                getattr(one, what), getattr(other, what), atol=1e-9, rtol=1e-9
            )
    np.testing.assert_allclose(
        robot.chain.tip_translation, by_hand.chain.tip_translation, atol=1e-12
    )
    np.testing.assert_allclose(
        robot.chain.joints[-1].inertia, by_hand.chain.joints[-1].inertia, atol=1e-12
    )
    assert robot.capsule_axes == by_hand.capsule_axes


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        ('size = "[0.1, 0.2, 0.3] m"\n', np.diag([0.13, 0.10, 0.05])),
        ("", np.zeros((3, 3))),
    ],
)
def test_a_payload_may_be_a_box_of_uniform_density_or_a_point(
    tmp_path, payload, expected
):
    problem = written(tmp_path, more=f"[payload]\nmass = 12.0\n{payload}")
    np.testing.assert_allclose(problem.payload.inertia_matrix, expected, atol=1e-12)
    empty = load_robot(load_problem("heavy-object"))
    inertia = load_robot(problem).model.inertias[7]
    assert inertia.mass == pytest.approx(empty.model.inertias[7].mass + 12.0)
    if payload:
        reference = pin.Inertia.FromBox(12.0, 0.1, 0.2, 0.3).inertia
        np.testing.assert_allclose(
            problem.payload.inertia_matrix, reference, atol=1e-12
        )


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        (f"{INERTIA}size = [0.1, 0.1, 0.1]\n", "has both an 'inertia' and a 'size'"),
        (
            "inertia = [1.0, 1.0, 3.0, 0.0, 0.0, 0.0]\n",
            "no body has the principal values 1, 1, 3 kg m^2",
        ),
        (
            "inertia = [1.0, 1.0, 1.0, 2.0, 0.0, 0.0]\n",
            "no body has the principal values -1, 1, 3 kg m^2",
        ),
    ],
)
def test_inertias_that_no_body_has_are_refused(tmp_path, keys, text):
    with pytest.raises(RecipeError) as caught:
        written(tmp_path, more=f"[payload]\nmass = 1.0\n{keys}")
    assert text in str(caught.value)


def test_limits_are_typed_in_for_all_joints_or_one_by_one(tmp_path):
    ranges = ", ".join(
        f"[{-low}, {low}]" for low in (2.0, 1.9, 1.8, 1.7, 1.6, 1.5, 1.4)
    )
    speeds = "[1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6] rad/s"
    text = f'position = [{ranges}]\nvelocity = "{speeds}"\nacceleration = 7.5\ntorque = "50 N m"\n'
    robot = load_robot(written(tmp_path, limits=text))
    np.testing.assert_allclose(
        robot.position_upper, [2.0, 1.9, 1.8, 1.7, 1.6, 1.5, 1.4]
    )
    np.testing.assert_allclose(robot.rated_velocity, np.arange(10, 17) / 10)
    np.testing.assert_allclose(
        robot.velocity_limit, 0.8 * np.arange(10, 17) / 10
    )  # scaled as the URDF's are
    np.testing.assert_allclose(robot.acceleration_limit, 7.5)
    np.testing.assert_allclose(robot.torque_limit, 40.0)
    np.testing.assert_allclose(robot.model.upperPositionLimit, robot.position_upper)


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        (
            "velocity = [1.0, 2.0]\n",
            "limits.velocity: needs one number, or 7, one per planned joint, got 2",
        ),
        (
            "position = [[-1, 1]]\n",
            "limits.position: needs 7 ranges, one per planned joint, got 1",
        ),
    ],
)
def test_limits_for_another_number_of_joints_are_refused(tmp_path, limits, text):
    assert text in error(written(tmp_path, limits=limits))


def test_a_limit_is_above_zero_and_has_a_unit(tmp_path):
    with pytest.raises(RecipeError) as caught:
        written(
            tmp_path,
            limits='velocity = "[1, 2] m"\nacceleration = [1.0, -1.0]\ntorque = "much"\n',
        )
    found = "\n".join(caught.value.errors)
    for text in (
        "limits.velocity: ",
        "limits.acceleration: -1.0 rad/s^2 is too small",
        "limits.torque: ",
    ):
        assert text in found


def test_continuous_joints_are_planned_within_the_ranges_that_they_are_given(tmp_path):
    def turning(text: str) -> str:
        return text.replace(
            'name="joint_3" type="revolute"', 'name="joint_3" type="continuous"'
        )

    ranges = "position = [" + ", ".join(["[-2.0, 2.0]"] * 7) + "]\n"
    problem = written(tmp_path, limits=ranges, urdf=turning)
    robot = load_robot(problem)
    assert robot.model.nq == 7
    np.testing.assert_allclose(robot.position_lower, -2.0)
    assert (robot.velocity_limit > 0).all()
    assert "continuous" in robot.urdf_text  # the URDF itself is kept as it is
    (tmp_path / "other").mkdir()
    assert "give ranges to all joints" in error(
        written(tmp_path / "other", urdf=turning)
    )


def test_a_record_keeps_what_was_added(tmp_path):
    limits = "acceleration = 5.0\nvelocity = [1, 1, 1, 1, 2, 2, 2]\n"
    problem = written(tmp_path, robot=TIP, more=PAYLOAD, limits=limits)
    restored, robot = open_problem(record_problem(problem))
    assert restored.identity == problem.identity
    assert resolved(restored)["payload"]["mass"] == 2.5
    np.testing.assert_array_equal(
        robot.velocity_limit, load_robot(problem).velocity_limit
    )
    np.testing.assert_array_equal(
        robot.chain.tip_translation, load_robot(problem).chain.tip_translation
    )
    assert problem.identity != load_problem("heavy-object").identity


def test_an_unknown_frame_is_refused_with_the_nearest_and_the_first_known_ones(
    tmp_path,
):
    problem = written(tmp_path)
    text = error(replace(problem, robot=replace(problem.robot, tip="objekt")))
    assert "has no frame 'objekt' (did you mean 'object'?)" in text
    assert "its frames: universe, " in text
    assert re.search(r" and \d+ more$", text)
