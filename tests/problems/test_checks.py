"""Errors in robots are reported with the element that has them."""

import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest

from cnpgen.errors import RecipeError, listed
from cnpgen.problems.checks import missing_frame
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from tests.examples.shaped_robot import JOINTS, urdf, write_problem

TORQUE = '[[constraint]]\nuse = "joint-torque"\ntolerance = "0.5 %"\n'


def crane(folder: Path, old: str, new: str, more: str = "") -> Path:
    """A problem whose URDF was changed in one place."""
    file, text = write_problem(folder, more=more), urdf()
    assert text.count(old) >= 1
    (folder / "crane" / "crane.urdf").write_text(text.replace(old, new))
    return file


def errors(file: Path) -> str:
    with pytest.raises(RecipeError) as caught:
        load_robot(load_problem(file))
    return str(caught.value)


def test_a_file_for_xacro_is_told_from_a_urdf(tmp_path):
    new = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="crane"><xacro:arm side="left"/>'
    found = errors(crane(tmp_path, '<robot name="crane" version="1.2">', new))
    assert (
        "robot.urdf: crane.urdf is to be read by xacro, expected a URDF: run 'xacro crane.urdf > robot.urdf'"
        in found
    )


def test_a_locked_joint_that_cannot_stand_at_zero_is_a_mistake(tmp_path):
    limit = '<limit lower="-2.5" upper="2.5" velocity="2" effort="100"/>'
    grip = next(name for name, kind, *_ in JOINTS if kind == "prismatic")
    before, after = urdf().split(f'<joint name="{grip}"')
    file = write_problem(tmp_path)
    text = (
        before
        + f'<joint name="{grip}"'
        + after.replace(limit, limit.replace('lower="-2.5"', 'lower="0.1"'))
    )
    (tmp_path / "crane" / "crane.urdf").write_text(text)
    assert (
        "'grip' is not planned and stays at zero, which is outside of its limits [0.1, 2.5]"
        in errors(file)
    )
    end = text.index("</joint>", text.index(f'<joint name="{grip}"'))
    follows = (
        text[:end] + '<mimic joint="other"/>' + text[end:]
    )  # where such a joint stands is checked elsewhere
    (tmp_path / "crane" / "crane.urdf").write_text(follows)
    assert load_problem(file).name == "crane"


def test_joints_that_move_nothing_heavy_have_no_torques(tmp_path):
    file = crane(tmp_path, '<mass value="1"/>', '<mass value="0"/>', more=TORQUE)
    found = errors(file)
    assert found.count("no link that it moves has a mass") == 4
    assert "swing: no link that it moves has a mass" in found
    (tmp_path / "problem.toml").write_text(file.read_text().replace(TORQUE, ""))
    assert load_robot(load_problem(tmp_path / "problem.toml")).n == 4


def test_a_tip_that_is_not_there_is_refused_with_all_frames(tmp_path):
    file = write_problem(tmp_path)
    file.write_text(file.read_text().replace('tip = "hand"', 'tip = "hnad"'))
    found = errors(file)
    assert (
        "robot.tip: crane.urdf has no frame 'hnad' (did you mean 'hand'?); its frames: base, turret, arm"
        in found
    )


@pytest.mark.parametrize("tag", ["link", "joint"])
@pytest.mark.parametrize("name", [None, ""])
def test_links_and_joints_have_names(tmp_path: Path, tag: str, name: str | None):
    tree = ElementTree.fromstring(urdf())
    part = tree.findall(tag)[-1]
    del part.attrib["name"]
    if name is not None:
        part.set("name", name)
    file = write_problem(tmp_path)
    (tmp_path / "crane" / "crane.urdf").write_text(ElementTree.tostring(tree).decode())
    number = len(tree.findall(tag))
    assert f"crane.urdf: <{tag}> {number} of the file has no name" in errors(file)


@pytest.mark.parametrize("key", ["acceleration_rate", "acceleration_cap"])
def test_rules_beside_stated_accelerations_are_refused(tmp_path: Path, key: str):
    found = errors(limited(tmp_path, f"acceleration = 5\n{key} = 10"))
    assert f"limits.{key}: 'acceleration' takes its place: remove one of them" in found


@pytest.mark.parametrize("key", ["visual_links", "skipped_meshes"])
def test_links_without_shapes_have_no_meshes(tmp_path: Path, key: str):
    robot = f'geometry = "paper-capsules"\n{key} = ["claw"]'
    file = write_problem(tmp_path, robot=robot, obstacles="", more="")
    assert f'robot.{key}: meshes matter with geometry = "urdf" only' in errors(file)


def test_a_held_object_that_nothing_can_touch_is_refused(tmp_path: Path):
    shutil.copytree(load_problem("airhockey").path.parent, tmp_path / "hits")
    file = tmp_path / "hits" / "problem.toml"
    with file.open("a", encoding="utf-8") as stream:
        stream.write("\n[object]\nsize = [0.1, 0.1, 0.1]\n")
    assert "object: nothing uses it: there are no obstacles, and" in errors(file)


def limited(folder: Path, limit: str) -> Path:
    """A problem with a limit, where the URDF allows 2 rad/s and positions of 2.5 rad to either side."""
    file = write_problem(folder)
    file.write_text(
        file.read_text(encoding="utf-8").replace("[limits]", f"[limits]\n{limit}"),
        encoding="utf-8",
    )
    return file


@pytest.mark.parametrize(
    ("limit", "text"),
    [
        (
            "velocity = 80",
            "limits.velocity: swing: must be from 0 to 20 rad/s, got 80 rad/s; 80 rad/s is 4584 deg/s;",
        ),
        (
            "velocity = [2, 2, 115, 2]",
            "limits.velocity: elbow: must be from 0 to 20 rad/s, got 115 rad/s;",
        ),
        (
            "acceleration = 573",
            "limits.acceleration: swing: must be from 0 to 200 rad/s^2, got 573 rad/s^2;",
        ),
        (
            'position = ["[-2, 2]", "[-12, 12]", "[-2, 2]", "[-2, 2]"]',
            "position: lift: must be from -5 to 5 rad, got",
        ),
    ],
)
def test_limits_far_above_those_of_the_urdf_are_in_another_unit(tmp_path, limit, text):
    found = errors(limited(tmp_path, limit))
    assert text in found
    assert "did you mean" in found
    assert (
        "'velocity_scale' is a fraction of the URDF's limit" in found
    ) == limit.startswith("velocity")


def test_joints_of_transmissions_have_no_limits(tmp_path):
    """They repeat names of joints; implausible limits are found in such URDFs, too."""
    file = limited(tmp_path, "velocity = 80")
    (urdf,) = tmp_path.rglob("*.urdf")
    transmission = '<transmission name="t"><joint name="swing"/></transmission></robot>'
    urdf.write_text(
        urdf.read_text(encoding="utf-8").replace("</robot>", transmission),
        encoding="utf-8",
    )
    assert "limits.velocity: swing: must be from 0 to 20 rad/s" in errors(file)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (
            'scale="0.001 0.001 0.001"',
            'scale="1 1 1"',
            "link 'fore': its collision geometry is 250 m large",
        ),
        (
            'scale="0.001 0.001 0.001"',
            'scale="1e-6 1e-6 1e-6"',
            "geometry is 0.00025 m large, expected 0.001 m or more",
        ),
        (
            'xyz="0.4 0 0"',
            'xyz="400 0 0"',
            "the arm is 401 m long, expected 0.01 to 100 m; lengths of a URDF are in m",
        ),
        (
            'lower="-2.5" upper="2.5"',
            'lower="-143" upper="143"',
            "25.1 rad, got -143 rad; -143 rad is -8193 deg; did",
        ),
        (
            'lower="-2.5" upper="2.5"',
            'lower="2.5" upper="-2.5"',
            "joint 'swing': its limits lower=2.5 and upper=-2.5 are swapped: exch",
        ),
        (
            '<mass value="1"/>',
            '<mass value="1"/><origin xyz="0 90 0"/>',
            "the center of mass is 90 m away",
        ),
        (
            'ixx="0.01"',
            'ixx="10000"',
            "the radius of gyration 70.7 m, the arm 1.02 m long; an <inertial> is in kg, m",
        ),
    ],
    ids=[
        "mesh in mm",
        "tiny mesh",
        "joints in mm",
        "degrees",
        "swapped",
        "center in mm",
        "inertia in g mm^2",
    ],
)
def test_a_urdf_that_was_changed_later_is_checked_again(tmp_path, old, new, text):
    assert text in errors(crane(tmp_path, old, new))


def test_obstacles_far_out_of_reach_are_in_another_unit(tmp_path):
    file = write_problem(tmp_path)
    file.write_text(
        file.read_text(encoding="utf-8").replace("x = [0.45, 0.55]", "x = [45, 55]"),
        encoding="utf-8",
    )
    text = (
        "obstacle 1: 'wall' is 45 m away, where the arm is 1.02 m long: check its unit"
    )
    assert text in errors(file)


def test_payloads_in_grams_or_millimetres_are_refused(tmp_path):
    for payload, text in {
        "mass = 500": "payload.mass: is 500 kg, where the arm has 5 kg: masses are in kg, not in g",
        "mass = 1\ncentre = [0, 0, 4.9]": "payload.centre: a length of 4.9 m from it",
        "mass = 1\ninertia = [900, 900, 900, 0, 0, 0]": "payload.inertia: a length of 36.7 m from it",
    }.items():
        file = write_problem(tmp_path)
        content = file.read_text(encoding="utf-8").replace(
            "[robot]", f"[payload]\n{payload}\n[robot]"
        )
        file.write_text(content, encoding="utf-8")
        assert text in errors(file)


def test_obstacles_that_no_constraint_uses_are_refused(tmp_path):
    file = write_problem(tmp_path)
    file.write_text(
        file.read_text(encoding="utf-8").replace("robot-clearance", "self-clearance"),
        encoding="utf-8",
    )
    assert (
        'obstacle 1: no constraint uses it: add a [[constraint]] with use = "robot-clearance"'
        in errors(file)
    )


@pytest.mark.parametrize(
    "limit",
    ["velocity = 19", 'velocity = "80 deg/s"', "acceleration = 190", "torque = 5000"],
)
def test_limits_of_another_motor_are_accepted(tmp_path, limit):
    load_robot(load_problem(limited(tmp_path, limit)))


def test_a_message_lists_at_most_twenty_frames() -> None:
    links = "".join(f'<link name="link_{index}"/>' for index in range(30))
    tree = ElementTree.fromstring(f"<robot>{links}</robot>")
    text = missing_frame(tree, Path("long.urdf"), "link_99")
    assert text.endswith("link_17, link_18, link_19 and 10 more")
    assert missing_frame(tree, Path("long.urdf"), "link_29") == ""
    assert listed(["a", "b"]) == "a, b"


@pytest.mark.parametrize("use", ['["robot-clearance"]', "[]", "{ a = 1 }", "3"])
def test_kinds_that_are_no_text_are_errors(tmp_path, use):
    file = write_problem(tmp_path)
    file.write_text(
        file.read_text(encoding="utf-8").replace(
            'use = "robot-clearance"', f"use = {use}"
        ),
        "utf-8",
    )
    assert "constraint 2.use: expected one of joint-position, " in (
        text := errors(file)
    )
    assert ", got " in text
