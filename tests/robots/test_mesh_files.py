"""URDFs of packages: where they are looked for, and what is said where the package is missing."""

from pathlib import Path

import pytest

from cnpgen.errors import PluginError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.shape.mesh_files import find_named_file, find_urdf
from tests.examples.shaped_robot import write_problem


def installed(site: Path, name: str, folder: str) -> Path:
    """Write a Python package with a robot, as pip leaves it; return the folder of its data."""
    (site / f"{name.replace('-', '_')}-1.0.dist-info").mkdir(parents=True)
    text = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
    (site / f"{name.replace('-', '_')}-1.0.dist-info" / "METADATA").write_text(text)
    data = site / folder / name
    data.mkdir(parents=True)
    return data


@pytest.mark.parametrize("folder", ["cmeel.prefix/share", "share", "."])
def test_a_urdf_of_an_installed_package_is_found_and_so_are_its_meshes(
    tmp_path, monkeypatch, folder
):
    data = installed(tmp_path / "site", "arms-for-tests", folder)
    (data / "arm.urdf").write_text("<robot/>")
    (data / "a.stl").write_bytes(b"mesh")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    problem = tmp_path / "elsewhere" / "problem.toml"
    found = find_urdf("package://arms-for-tests/arm.urdf", problem)
    assert found.resolve() == (data / "arm.urdf").resolve()
    mesh = find_named_file(
        "package://arms-for-tests/a.stl", tmp_path / "elsewhere" / "other.urdf"
    )
    assert mesh.read_bytes() == b"mesh"


def test_a_urdf_beside_the_problem_is_where_it_always_was(tmp_path):
    assert (
        find_urdf("arm/arm.urdf", tmp_path / "problem.toml")
        == tmp_path / "arm" / "arm.urdf"
    )


def test_a_problem_may_name_the_urdf_of_a_package_in_one_of_its_folders(tmp_path):
    file = write_problem(tmp_path / "a")
    plain = load_robot(load_problem(file))
    text = file.read_text().replace(
        '"crane/crane.urdf"', '"package://crane/crane.urdf"\npackages = ["../a"]'
    )
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "problem.toml").write_text(text)
    problem = load_problem(tmp_path / "b" / "problem.toml")
    assert problem.robot.geometry == "urdf"
    assert load_robot(problem).urdf_text == plain.urdf_text
    assert problem.identity == load_problem(file).identity


@pytest.mark.parametrize(
    ("package", "hint"),
    [
        ("example-robot-data", "pip install 'cnpgen[robots]'"),
        (
            "nobody-has-this",
            "name a folder that holds the package as 'packages' in [robot]",
        ),
    ],
)
def test_a_problem_whose_package_is_missing_can_be_listed_and_its_robot_says_what_to_do(
    tmp_path, package, hint
):
    file = write_problem(tmp_path, robot='geometry = "urdf"')
    file.write_text(
        file.read_text().replace(
            "crane/crane.urdf", f"package://{package}/no/such.urdf"
        )
    )
    problem = load_problem(file)
    assert problem.name == "crane"
    with pytest.raises(PluginError) as caught:
        load_robot(problem)
    assert caught.value.exit_code == 3
    said = str(caught.value)
    assert said.startswith(
        f"{file}: the file 'package://{package}/no/such.urdf' is missing; searched paths:\n"
    )
    assert hint in said
