"""URDFs of strangers: what would end the process, or is no URDF, is an error in the recipe."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.urdf import MAX_DEPTH, MAX_URDF_BYTES, read_urdf, urdf_tree
from cnpgen.world.world import World
from tests.examples.shipped import PROBLEMS
from tests.refusals import is_refused

LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'


def problem_with(folder: Path, urdf: str | bytes) -> Path:
    """A problem file beside a URDF."""
    text = (
        PROBLEMS["heavy-object"]
        .path.read_text(encoding="utf-8")
        .replace(f'"{PROBLEMS["heavy-object"].robot.urdf}"', '"robot.urdf"')
    )
    (folder / "problem.toml").write_text(text, encoding="utf-8")
    (folder / "robot.urdf").write_bytes(
        urdf.encode() if isinstance(urdf, str) else urdf
    )
    return folder / "problem.toml"


def shipped_with(*changes: tuple[str, str]) -> str:
    text = PROBLEMS["heavy-object"].urdf_text
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def load(path: Path) -> Problem:
    problem = load_problem(path)
    load_robot(problem)
    return problem


def chain(count: int, kind: str = "fixed") -> str:
    links = "".join(f'<link name="l{i}"/>' for i in range(count + 1))
    joints = "".join(
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>{LIMIT}</joint>'
        for i in range(count)
    )
    return f'<robot name="r">{links}{joints}</robot>'


@pytest.mark.parametrize(
    ("urdf", "message"),
    [
        (chain(5000), "it has 5,001 links, expected at most 1,000"),
        ("<robot>" + "<x>" * 10_000 + "</x>" * 10_000 + "</robot>", f"more than {MAX_DEPTH} nested elements"),
        ('<!DOCTYPE robot [<!ENTITY a "aaaa">]><robot name="&a;"/>', "it has a document type"),
        (shipped_with(("robot name=", "robot name=")).replace("<robot ", "<robot title='Grün' ", 1).encode("latin-1"),
         r"line \d+: not UTF-8: byte 0xfc; save the URDF as UTF-8"),
        ('<robot name="r"><link name="a&#10;[robot]"/></robot>', "its <link name=...> has control characters"),
        ("<robot", "it is not XML"),
        (b"", "it is not XML"),
        (b"<robot>" + bytes(8) + b"</robot>", "it is not XML"),
    ],
    ids=["chain", "depth", "entities", "latin-1", "a line in a name", "cut off", "empty", "zeros"],
)  # fmt: skip
def test_what_no_robot_needs_is_a_mistake_in_the_recipe(
    tmp_path: Path, urdf: str | bytes, message: str
) -> None:
    with pytest.raises(RecipeError, match=rf"robot.urdf.*{message}"):
        load(problem_with(tmp_path, urdf))


def test_so_it_is_in_the_record_of_a_problem() -> None:
    record = record_problem(PROBLEMS["heavy-object"])
    long = type(record)(record.recipe, chain(5000))
    with is_refused(RecipeError):
        open_problem(long)
    with is_refused(ValueError):
        _ = long.held_joints


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    path = problem_with(tmp_path, "")
    with (tmp_path / "robot.urdf").open("wb") as file:
        file.truncate(MAX_URDF_BYTES + 1)
    with is_refused(RecipeError):
        load(path)


@pytest.mark.parametrize("what", ["device", "pipe", "folder", "nothing"])
def test_what_is_no_file_is_not_read(tmp_path: Path, what: str) -> None:
    path = problem_with(tmp_path, "")
    (tmp_path / "robot.urdf").unlink()
    if what == "device":
        (tmp_path / "robot.urdf").symlink_to("/dev/zero")
    elif what == "pipe":
        os.mkfifo(tmp_path / "robot.urdf")
    elif what == "folder":
        (tmp_path / "robot.urdf").mkdir()
    with is_refused(RecipeError):
        load(path)
    with is_refused(RecipeError):
        read_urdf(tmp_path / "robot.urdf")


def test_an_offset_with_a_comma_is_no_number(tmp_path: Path) -> None:
    mimic = '<mimic joint="other" offset="0,5"/>'
    finger = f'<link name="f"/><joint name="finger" type="revolute"><parent link="iiwa_link_1"/><child link="f"/>{LIMIT}'
    other = finger.replace('"f"', '"o"').replace('"finger"', '"other"')
    link = PROBLEMS["heavy-object"].urdf_text.split('<link name="')[1].split('"')[0]
    joints = f"{other}</joint>{finger}{mimic}</joint>".replace("iiwa_link_1", link)
    urdf = shipped_with(("</robot>", f"{joints}</robot>"))
    with is_refused(RecipeError):
        load(problem_with(tmp_path, urdf))


def test_a_link_may_have_the_name_of_its_joint(tmp_path: Path) -> None:
    """The tip is the frame of the link; the numbers are those of the robot whose names differ."""
    usual = load_robot(PROBLEMS["heavy-object"])
    last, joint = (
        PROBLEMS["heavy-object"].robot.tip,
        usual.model.frames[usual.tip_frame].name,
    )
    assert joint == last
    names = [
        part.split('"')[0]
        for part in PROBLEMS["heavy-object"].urdf_text.split('<joint name="')[1:]
    ]
    fixed = next(
        name
        for name in reversed(names)
        if name not in PROBLEMS["heavy-object"].robot.joints
    )
    problem = load(
        problem_with(
            tmp_path, shipped_with((f'<joint name="{fixed}"', f'<joint name="{last}"'))
        )
    )
    robot = load_robot(problem)
    worlds = [
        World(
            each,
            PROBLEMS["heavy-object"].obstacle,
            PROBLEMS["heavy-object"].object_size,
        )
        for each in (usual, robot)
    ]
    q = np.linspace(-0.5, 0.5, 7)
    for world in worlds:
        world.set_state(q, q, q, np.zeros(2))
    np.testing.assert_array_equal(worlds[0].tip_position, worlds[1].tip_position)
    assert usual.capsule_axes == robot.capsule_axes


def test_a_link_may_have_the_name_of_any_joint(tmp_path: Path) -> None:
    """Of joints that are held still, too, without which Pinocchio reduces the model."""
    shipped = load_problem("airhockey")
    there = replace(shipped.robot, urdf="robot.urdf")
    usual, urdf = load_robot(shipped), shipped.urdf_text
    links = [part.split('"')[0] for part in urdf.split('<link name="')[1:]]
    for joint in (part.split('"')[0] for part in urdf.split('<joint name="')[1:]):
        if joint in shipped.robot.joints:
            continue
        for link in links:
            text = urdf.replace(f'<joint name="{joint}"', f'<joint name="{link}"', 1)
            problem = replace(shipped, path=problem_with(tmp_path, text), robot=there)
            robot = load_robot(problem)
            assert robot.capsule_axes == usual.capsule_axes
            np.testing.assert_array_equal(
                robot.chain.tip_translation, usual.chain.tip_translation
            )


def test_a_tree_as_deep_as_robots_are_is_read() -> None:
    inside = "<x>" * (MAX_DEPTH - 1) + "</x>" * (MAX_DEPTH - 1)
    assert urdf_tree(f"<robot>{inside}</robot>").tag == "robot"
    assert pin.buildModelFromXML(chain(1000 - 1)).nframes == 2 * 999 + 2


GAZEBO = '<gazebo reference="l1"><sensor:camera name="rgb"/></gazebo>'


def test_undeclared_prefixes_are_read_as_pinocchio_reads_them(tmp_path: Path) -> None:
    text = shipped_with(("</robot>", f"{GAZEBO}</robot>"))
    assert [element.tag for element in urdf_tree(text).iter("gazebo")] == ["gazebo"]
    assert record_problem(load(problem_with(tmp_path, text))).urdf == text
    deep = "<x>" * MAX_DEPTH + "</x>" * MAX_DEPTH
    for wrong, message in (
        (f"<robot>{GAZEBO}{deep}</robot>", "nested elements"),
        (
            f'<!DOCTYPE robot [<!ENTITY a "b">]><robot>{GAZEBO}&a;</robot>',
            "document type",
        ),
        (f"<robot>{GAZEBO}", "it is not XML: no element found"),
        (f'<robot>{GAZEBO}<link name="a&#10;b"/></robot>', "control characters"),
    ):
        with pytest.raises(ValueError, match=message):
            urdf_tree(wrong)
