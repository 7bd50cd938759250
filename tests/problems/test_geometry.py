"""Which shape a robot has, what does not go with it, and that a problem carries it wherever it goes as text."""

import shutil
from pathlib import Path

import pytest

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem, resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import as_problem, open_problem, record_problem
from tests.examples.shaped_robot import LINKS, SELF, write_crane, write_problem

RADIUS = 'radius = "0.1 m"'
PAPER = 'geometry = "paper-capsules"'


def errors(file: Path) -> list[str]:
    with pytest.raises(RecipeError) as caught:
        load_problem(file)
    return [error.removeprefix(f"{file}: ") for error in caught.value.errors]


@pytest.mark.parametrize(
    ("changes", "geometry"),
    [
        ({}, "urdf"),
        ({"more": ""}, "urdf"),
        ({"obstacles": ""}, "urdf"),
        ({"obstacles": "", "more": "", "clearance": RADIUS}, "paper-capsules"),
        ({"robot": PAPER, "more": "", "clearance": RADIUS}, "paper-capsules"),
        ({"robot": 'geometry = "urdf"', "obstacles": "", "more": ""}, "urdf"),
    ],
)
def test_a_robot_that_may_hit_something_has_its_real_shape_unless_it_is_told_otherwise(
    tmp_path, changes, geometry
):
    problem = load_problem(write_problem(tmp_path, **changes))
    assert problem.robot.geometry == geometry
    assert (load_robot(problem).shape is not None) == (geometry == "urdf")


def test_a_urdf_without_shapes_is_a_line_through_its_joints(tmp_path):
    file = write_problem(tmp_path, more="", clearance=RADIUS)
    write_crane(tmp_path, {link: [] for link in LINKS})
    assert load_problem(file).robot.geometry == "paper-capsules"


@pytest.mark.parametrize(
    ("changes", "place", "text"),
    [
        (
            {"clearance": RADIUS},
            "constraint 2.radius",
            "the robot has the shape that its URDF gives it, and no radius",
        ),
        (
            {"robot": PAPER, "more": ""},
            "constraint 2.radius",
            "missing key, expected a length [m]",
        ),
        (
            {"robot": PAPER, "clearance": RADIUS},
            "constraint 3",
            'needs geometry = "urdf" in [robot]',
        ),
        (
            {"robot": f'{PAPER}\nsrdf = "a.srdf"', "more": "", "clearance": RADIUS},
            "robot.srdf",
            "matter with",
        ),
        ({"robot": 'srdf = "a.srdf"'}, "robot.srdf", "no such file: "),
        ({"robot": 'packages = ["nowhere"]'}, "robot.packages", "no such folder: "),
        ({"robot": 'geometry = "urdfs"'}, "robot.geometry", "did you mean 'urdf'?"),
    ],
)
def test_what_does_not_go_with_the_shape_is_a_mistake(tmp_path, changes, place, text):
    (found,) = (
        each
        for each in errors(write_problem(tmp_path, **changes))
        if each.startswith(f"{place}: ")
    )
    assert text in found


def test_a_named_shape_that_the_urdf_does_not_have_is_a_mistake(tmp_path):
    file = write_problem(tmp_path, robot='geometry = "urdf"')
    write_crane(tmp_path, {link: [] for link in LINKS})
    (found,) = errors(file)
    assert found.startswith("robot.geometry: the URDF gives no shape")


def test_a_missing_mesh_is_a_mistake_of_the_problem(tmp_path):
    file = write_problem(tmp_path)
    (tmp_path / "crane" / "meshes" / "wedge.stl").unlink()
    (found,) = errors(file)
    assert found.startswith("robot.urdf: ")
    assert f"searched paths:\n  {tmp_path}/crane/crane/meshes/wedge.stl\n" in found


def test_packages_are_relative_to_the_problem_file(tmp_path):
    file = write_problem(tmp_path, robot='packages = ["elsewhere"]')
    shutil.move(
        tmp_path / "crane" / "meshes", tmp_path / "elsewhere" / "crane" / "meshes"
    )
    shutil.copytree(
        tmp_path / "elsewhere" / "crane" / "meshes", tmp_path / "crane" / "meshes"
    )
    (tmp_path / "crane" / "meshes" / "wedge.stl").unlink()
    assert load_robot(load_problem(file)).shape is not None


@pytest.fixture
def problem(tmp_path: Path) -> Problem:
    srdf = '<robot name="crane"><disable_collisions link1="hand" link2="base" reason="Default"/></robot>'
    (tmp_path / "crane.srdf").write_text(srdf)
    return load_problem(
        write_problem(tmp_path, robot='srdf = "crane.srdf"\npackages = ["."]')
    )


def test_a_record_has_the_shape_without_the_files(problem, tmp_path):
    identity, shape = problem.identity, load_robot(problem).shape
    record = record_problem(problem)
    shutil.rmtree(tmp_path / "crane")
    (tmp_path / "crane.srdf").unlink()
    restored, robot = open_problem(record)
    assert restored.identity == identity
    assert repr(robot.shape.pairs) == repr(shape.pairs)
    assert [piece.vertices.tobytes() for piece in robot.shape.convex_parts] == [
        p.vertices.tobytes() for p in shape.convex_parts
    ]
    assert (
        record_problem(as_problem(record)).comparable_sha256 == record.comparable_sha256
    )


def test_a_mesh_that_changes_changes_the_identity(problem, tmp_path):
    before, claw = record_problem(problem), tmp_path / "crane" / "meshes" / "claw.obj"
    claw.write_text(claw.read_text().replace("0.06", "0.0601"))
    after = load_problem(tmp_path / "problem.toml")
    assert after.identity != problem.identity
    assert record_problem(after).comparable_sha256 != before.comparable_sha256
    assert record_problem(after).differences(before) == ["robot.urdf"]


@pytest.mark.parametrize("name", ["airhockey", "heavy-object"])
def test_shipped_problems_are_written_as_before_there_were_shapes(name):
    problem = load_problem(name)
    content = resolved(problem)
    assert problem.robot.geometry == "paper-capsules"
    assert set(content["robot"]) == {"urdf", "joints", "tip", "base"}
    kinds = [
        constraint
        for constraint in content["constraint"]
        if constraint["use"] != "object-clearance"
    ]
    assert all("distance" not in constraint for constraint in kinds)
    assert load_robot(problem).shape is None


def test_keys_that_came_later_are_written_where_they_are_said(tmp_path):
    content = resolved(
        load_problem(write_problem(tmp_path, clearance="distance = 0.01"))
    )
    assert content["robot"]["geometry"] == "urdf"
    assert content["constraint"][1]["distance"] == 0.01
    assert SELF.split('"')[1] == content["constraint"][2]["use"]
