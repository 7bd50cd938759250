"""Loading robots: scaled limits, the capsule axes, and what is said about joints, tips and URDFs that do not fit."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from tests.examples.shipped import PROBLEMS


def changed(problem: Problem, **robot: Any) -> Problem:
    return replace(problem, robot=replace(problem.robot, **robot))


def with_urdf(folder: Path, old: str, new: str) -> Problem:
    """Heavy object with the first ``old`` of its URDF replaced."""
    text = PROBLEMS["heavy-object"].urdf_path.read_text()
    assert old in text
    (folder / "changed.urdf").write_text(text.replace(old, new, 1))
    return changed(
        replace(PROBLEMS["heavy-object"], path=folder / "problem.toml"),
        urdf="changed.urdf",
    )


def mistake_of(problem: Problem) -> str:
    with pytest.raises(RecipeError) as raised:
        load_robot(problem)
    (error,) = raised.value.errors
    return error


@pytest.mark.parametrize("name", ["airhockey", "heavy-object"])
def test_limits_are_those_of_the_urdf_scaled(name):
    problem = PROBLEMS[name]
    robot, model = load_robot(problem), load_robot(problem).model
    assert robot.n == len(problem.robot.joints) == model.nq
    np.testing.assert_allclose(
        robot.position_lower, model.lowerPositionLimit, rtol=1e-15
    )
    np.testing.assert_allclose(
        robot.position_upper, model.upperPositionLimit, rtol=1e-15
    )
    np.testing.assert_allclose(
        robot.velocity_limit, 0.8 * np.array(model.velocityLimit), rtol=1e-15
    )
    np.testing.assert_allclose(
        robot.torque_limit, 0.8 * np.array(model.effortLimit), rtol=1e-15
    )
    np.testing.assert_array_equal(robot.home, problem.robot.base)


def test_acceleration_limit_is_the_rate_times_the_velocity_limit_up_to_the_cap():
    robot = load_robot(
        replace(
            PROBLEMS["heavy-object"],
            limits=replace(
                PROBLEMS["heavy-object"].limits,
                acceleration_rate=10.0,
                acceleration_cap=15.0,
            ),
        )
    )
    np.testing.assert_allclose(
        robot.acceleration_limit, np.minimum(10.0 * robot.velocity_limit, 15.0)
    )
    assert robot.acceleration_limit.max() == 15.0
    assert robot.acceleration_limit.min() < 15.0


def test_position_scale_narrows_limits_about_their_center(tmp_path):
    problem = with_urdf(tmp_path, 'lower="-2.9670597283903604"', 'lower="-1.0"')
    robot = load_robot(
        replace(problem, limits=replace(problem.limits, position_scale=0.5))
    )
    center, half = (2.9670597283903604 - 1.0) / 2, (2.9670597283903604 + 1.0) / 4
    assert robot.position_lower[0] == pytest.approx(center - half)
    assert robot.position_upper[0] == pytest.approx(center + half)


def test_capsule_axes_of_the_heavy_object_are_shoulder_elbow_wrist_object():
    robot = load_robot(PROBLEMS["heavy-object"])
    assert robot.capsule_axes == ((1, 3), (3, 5), (5, 7))
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, np.linspace(-1, 1, 7))
    points = [
        *(data.oMi[i].translation for i in range(1, 8)),
        data.oMf[model.getFrameId(robot.tip)].translation,
    ]
    lengths = [np.linalg.norm(points[b] - points[a]) for a, b in robot.capsule_axes]
    np.testing.assert_allclose(lengths, [0.42, 0.4, 0.251], atol=1e-12)


def test_capsule_axes_end_at_the_tip_where_joint_7_is_locked():
    robot = load_robot(PROBLEMS["airhockey"])
    assert robot.capsule_axes == ((1, 3), (3, 5), (5, 6))
    assert robot.n == 6


def test_locked_inner_joints_leave_angled_capsule_axes():
    joints = tuple(
        name for name in PROBLEMS["heavy-object"].robot.joints if name != "joint_4"
    )
    robot = load_robot(
        changed(PROBLEMS["heavy-object"], joints=joints, base=(0.0,) * 6)
    )
    assert robot.joint_names == joints
    assert robot.chain.joints[3].mass > 0
    assert robot.capsule_axes[-1][1] == robot.n


def test_unknown_joint_is_named_with_the_nearest_one():
    error = mistake_of(
        changed(
            PROBLEMS["heavy-object"],
            joints=("joint1", *PROBLEMS["heavy-object"].robot.joints[1:]),
        )
    )
    assert error.startswith(f"{PROBLEMS['heavy-object'].path}: robot.joints: ")
    assert "'joint1' (did you mean 'joint_1'?)" in error


def test_unknown_tip_is_named_with_the_nearest_one():
    error = mistake_of(changed(PROBLEMS["heavy-object"], tip="objekt"))
    assert error.startswith(f"{PROBLEMS['heavy-object'].path}: robot.tip: ")
    assert "'objekt' (did you mean 'object'?)" in error


def test_tip_must_be_behind_the_last_planned_joint():
    error = mistake_of(changed(PROBLEMS["heavy-object"], tip="link_4"))
    assert (
        "robot.tip: frame 'link_4' is not moved by the last planned joint 'joint_7'"
        in error
    )


def test_joints_must_be_in_the_order_of_the_urdf():
    error = mistake_of(
        changed(
            PROBLEMS["heavy-object"], joints=PROBLEMS["heavy-object"].robot.joints[::-1]
        )
    )
    assert "robot.joints: must be in the URDF's order ['joint_1', 'joint_2'," in error
    assert "got ['joint_7', 'joint_6'," in error


def test_base_needs_one_value_per_joint():
    assert "robot.base: needs 7 values, one per planned joint, got 6" in mistake_of(
        changed(PROBLEMS["heavy-object"], base=(0.0,) * 6)
    )


def test_base_outside_its_limits_names_the_joint_that_is_furthest_out():
    error = mistake_of(
        changed(PROBLEMS["heavy-object"], base=(0.0, 2.2, 0.0, -2.5, 0.0, 0.0, 0.0))
    )
    assert (
        "robot.base: joint_4 = -2.5 rad is outside its planning limits [-2.0944, 2.0944]"
        in error
    )


def test_a_tip_below_the_table_is_a_mistake_with_its_height():
    table = next(
        each
        for each in PROBLEMS["airhockey"].constraint
        if type(each).__name__ == "Table"
    )
    lifted = tuple(
        replace(each, z=1.0, start_band=0.01) if each is table else each
        for each in PROBLEMS["airhockey"].constraint
    )
    found = mistake_of(replace(PROBLEMS["airhockey"], constraint=lifted))
    assert (
        "robot.base: the tip is 0.84 m below the table, at z = 0.16 m, expected 1 m or more"
        in found
    )
    above = tuple(
        replace(each, z=0.165, start_band=0.01) if each is table else each
        for each in PROBLEMS["airhockey"].constraint
    )
    load_robot(
        replace(PROBLEMS["airhockey"], constraint=above)
    )  # as far off as motions may start


def test_base_on_its_limit_is_inside():
    robot = load_robot(PROBLEMS["heavy-object"])
    assert (
        load_robot(
            changed(PROBLEMS["heavy-object"], base=tuple(robot.position_upper))
        ).home[0]
        == robot.position_upper[0]
    )


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            'name="joint_3" type="revolute"',
            'name="joint_3" type="continuous"',
            "'joint_3' is a continuous joint, which has no limits (give ranges to all joints: 'position' in [limits])",
        ),
        (
            'name="joint_3" type="revolute"',
            'name="joint_3" type="floating"',
            "'joint_3' is a floating joint: only revolute and prismatic joints can be planned",
        ),
        (
            '<parent link="link_6"/>',
            '<parent link="link_4"/>',
            "'joint_7' is not moved by 'joint_6'",
        ),
        (
            'effort="110"',
            'effort="0"',
            "joint_5: the torque limit must be positive and finite, got 0",
        ),
        (
            'velocity="1.3089969389957472"',
            'velocity="0"',
            "joint_4: the velocity limit must be positive",
        ),
    ],
    ids=["continuous", "floating", "branching", "no torque", "no velocity"],
)
def test_robots_that_cannot_be_planned_are_refused(tmp_path, old, new, expected):
    assert expected in mistake_of(with_urdf(tmp_path, old, new))


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        (
            'upper="2.0943951023931953"',
            'upper="-3"',
            "'joint_2': its limits lower=-2.0944 and upper=-3 are swapped",
        ),
        (
            'lower="-2.0943951023931953" upper="2.0943951023931953"',
            "",
            "joint_2: the lower position limit must be below the upper one, got 0 and 0",
        ),
    ],
    ids=["empty", "not given"],
)
def test_joints_need_a_range_to_move_in(tmp_path, old, new, found):
    assert found in mistake_of(with_urdf(tmp_path, old, new))


FINGER = """
<link name="finger"/>
<link name="other"/>
<joint name="other_finger" type="prismatic">
  <parent link="link_7"/><child link="other"/><axis xyz="0 0 1"/>
  <limit lower="0" upper="0.1" effort="1" velocity="1"/>
</joint>
<joint name="finger_joint" type="prismatic">
  <parent link="link_7"/><child link="finger"/><axis xyz="0 0 1"/>
  <limit lower="0" upper="0.1" effort="1" velocity="1"/><mimic joint="{other}" multiplier="1" offset="{offset}"/>
</joint>
</robot>"""


@pytest.mark.parametrize(
    ("other", "offset", "expected"),
    [
        (
            "joint_6",
            "0",
            "'finger_joint' mimics the planned joint 'joint_6', but would stay at zero",
        ),
        (
            "other_finger",
            "0.02",
            "'finger_joint' mimics 'other_finger' with an offset, but would stay at zero",
        ),
    ],
)
def test_joints_that_mimic_others_and_would_stand_elsewhere_are_refused(
    tmp_path, other, offset, expected
):
    assert expected in mistake_of(
        with_urdf(tmp_path, "</robot>", FINGER.format(other=other, offset=offset))
    )


def test_a_joint_that_mimics_another_cannot_be_planned(tmp_path):
    mimic = '<mimic joint="joint_2"/>\n<axis'
    urdf = PROBLEMS["heavy-object"].urdf_path.read_text()
    at = urdf.index("<axis", urdf.index('name="joint_5"'))
    problem = with_urdf(tmp_path, urdf[at - 40 : at + 5], urdf[at - 40 : at] + mimic)
    assert "'joint_5' mimics 'joint_2' and cannot be planned by itself" in mistake_of(
        problem
    )


def test_a_joint_that_mimics_another_that_stays_at_zero_is_no_obstacle(tmp_path):
    assert (
        load_robot(
            with_urdf(
                tmp_path, "</robot>", FINGER.format(other="other_finger", offset="0")
            )
        ).n
        == 7
    )


def test_continuous_joint_that_is_locked_is_no_obstacle(tmp_path):
    problem = with_urdf(
        tmp_path, 'name="joint_7" type="revolute"', 'name="joint_7" type="continuous"'
    )
    assert (
        load_robot(
            changed(
                problem,
                joints=PROBLEMS["heavy-object"].robot.joints[:6],
                base=(0.0,) * 6,
            )
        ).n
        == 6
    )


@pytest.mark.parametrize("text", ["", "<robot>", "not xml at all"])
def test_file_that_is_no_urdf_is_named(tmp_path, text):
    (tmp_path / "broken.urdf").write_text(text)
    problem = changed(
        replace(PROBLEMS["heavy-object"], path=tmp_path / "problem.toml"),
        urdf="broken.urdf",
    )
    assert (
        f"{tmp_path / 'broken.urdf'}: not a URDF that Pinocchio can read"
        in mistake_of(problem)
    )


def test_missing_urdf_is_named():
    assert "absent.urdf: no such file" in mistake_of(
        changed(PROBLEMS["heavy-object"], urdf="absent.urdf")
    )
