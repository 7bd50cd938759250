"""The example for ROS 2: its logic runs against a controller that a program plays, and its node compiles."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.deploy.export_planner import planner_files, write_planner
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import find_model
from tests.addons.deploy.ros2_declarations import definitions, header, write_headers
from tests.refusals import is_refused

CXX = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
CC = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
needs_compilers = pytest.mark.skipif(
    None in (CXX, CC), reason="there is no C++ compiler on this machine"
)
EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "ros2"
HERE = Path(__file__).parent / "ros2"
WARNINGS = ("-std=c++17", "-Wall", "-Wextra", "-Werror")


def exported(model: str, folder: Path) -> tuple[str, Path]:
    """Export a planner, and write planner.hpp as CMake does; return the planner's name."""
    files = planner_files(find_model(model))
    write_planner(files, folder)
    name = next(iter(files)).removesuffix(".c")
    text = (EXAMPLE / "src" / "planner.hpp.in").read_text(encoding="utf-8")
    text = text.replace("@PLANNER@", name).replace("@PLANNER_UPPER@", name.upper())
    assert "@" not in text
    (folder / "planner.hpp").write_text(text, encoding="utf-8")
    return name, folder


def run(*command: object, given: str = "") -> str:
    done = subprocess.run(
        [str(word) for word in command],
        input=given,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[:3000]
    return done.stdout


def played(model: str, folder: Path, rows: np.ndarray, rest: bool) -> list[int]:
    """Run the program that plays the controller; return how many plans, stops and ends without a stop it saw."""
    name, folder = exported(model, folder)
    run(CC, "-std=c11", "-O2", "-c", folder / f"{name}.c", "-o", folder / "planner.o")
    sources = [EXAMPLE / "src" / file for file in ("motions.cpp", "motion_server.cpp")]
    program = folder / "program"
    include = (f"-I{folder}", f"-I{EXAMPLE / 'src'}", "-pthread")
    objects = (HERE / "motion_server_test.cpp", *sources, folder / "planner.o")
    run(CXX, *WARNINGS, "-O1", *include, *objects, "-lm", "-o", program)
    text = "\n".join(" ".join(map(repr, row.tolist())) for row in rows)
    return [int(word) for word in run(program, int(rest), given=text).split()]


def rows_of(problem: str, rest: bool, count: int) -> np.ndarray:
    """Return start_q, goal_q, goal_dq and rest_q; the arm rests at the goal of the next row."""
    boundary = draw_boundary_problems(problem, count, seed=6).boundary
    conditions = boundary.conditions()
    goal_q = conditions["goal_q"]
    goal_dq = conditions["goal_dq"] if rest else 0 * goal_q
    columns = (conditions["start_q"], goal_q, goal_dq, np.roll(goal_q, 1, axis=0))
    return np.concatenate(columns, axis=1)


@pytest.mark.slow
@needs_compilers
def test_transports_are_run_stopped_and_refused(tmp_path):
    rows = rows_of("heavy-object", rest=False, count=12)
    planned, stops, ends = played("heavy-object", tmp_path, rows, rest=False)
    assert planned >= 6
    assert stops >= 2 * planned
    assert ends >= planned  # near the end of every motion


@pytest.mark.slow
@needs_compilers
def test_a_hit_ends_at_rest_by_a_second_motion(tmp_path):
    rows = rows_of("airhockey-hit", rest=True, count=24)
    planned, stops, ends = played("airhockey-online", tmp_path, rows, rest=True)
    assert planned >= 6
    assert stops >= planned
    assert stops + ends == 7 * planned


@pytest.mark.slow
@needs_compilers
def test_the_node_compiles_against_the_published_interfaces(tmp_path):
    published = (HERE / "interfaces.txt").read_text(encoding="utf-8")
    own = (EXAMPLE / "action" / "PlanMotion.action").read_text(encoding="utf-8")
    interfaces = definitions(published)
    interfaces["cnpgen_planner/action/PlanMotion"] = own
    write_headers(interfaces, tmp_path)
    exported("heavy-object", tmp_path / "planner")
    own_header = (tmp_path / "planner" / "heavy_object.h").read_text(encoding="utf-8")
    codes = re.findall(r"#define HEAVY_OBJECT_(\w+) (\d) /\*", own_header)
    names = (tmp_path / "planner" / "planner.hpp").read_text(encoding="utf-8")
    written = re.findall(r'"([A-Z_]+)"', names)
    assert codes == [(name, str(code)) for code, name in enumerate(written)]
    folders = (tmp_path, tmp_path / "planner", HERE / "include", EXAMPLE / "src")
    node = EXAMPLE / "src" / "plan_motion_node.cpp"
    include = [f"-I{folder}" for folder in folders]
    run(CXX, *WARNINGS, *include, "-c", node, "-o", tmp_path / "node.o")
    wrong = tmp_path / "wrong.cpp"  # the declarations refuse what they do not have
    text = node.read_text(encoding="utf-8")
    assert "goal.trajectory.points" in text
    wrong.write_text(text.replace("to.positions", "to.position"), encoding="utf-8")
    with pytest.raises(AssertionError, match="position"):
        run(CXX, *WARNINGS, *include, "-fsyntax-only", wrong)


def test_a_type_without_a_definition_is_refused():
    with is_refused(ValueError):
        header("a/msg/B", "std_msgs/Missing value", set())


def test_the_readme_has_the_parameters_of_the_node_and_their_defaults():
    node = (EXAMPLE / "src" / "plan_motion_node.cpp").read_text(encoding="utf-8")
    readme = (EXAMPLE / "README.md").read_text(encoding="utf-8")
    table = readme.partition("| parameter |")[2].partition("\n\n")[0]
    parameters = re.findall(r"declare_parameter(?:<[\w:]+>)?\(\s*\"(\w+)\"", node)
    assert sorted(re.findall(r"`(\w+)`", table.replace("joint_states", ""))) == sorted(
        [*parameters, "start_q"]
    )
    for name, default in re.findall(r"<double>\(\"(\w+)\", ([\d.]+)\)", node):
        row = next(line for line in table.splitlines() if f"`{name}`" in line)
        assert default in re.findall(r"[\d.]+", row)
