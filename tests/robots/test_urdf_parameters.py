"""Numbers of a URDF that Pinocchio's parser drops without an error are refused by name."""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from cnpgen.errors import CnpgenError, RecipeError
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plan_file import load_plans, save_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import ProblemRecord, open_problem, record_problem
from cnpgen.robots.urdf_parameters import urdf_parameters
from tests.examples.plan_files import plans_of
from tests.examples.plans import load as stored_plan
from tests.examples.shipped import PROBLEMS
from tests.refusals import is_refused

NUMBERS = (
    "1,5",
    "nan",
    "inf",
    "0x10",
    "",
    " 1.5 ",
    "1.5 kg",
    "1_5",
    "1d3",
    "1e999",
    "\u0661",
)


def changed(
    path: str,
    attribute: str,
    value: str,
    *,
    urdf: str | None = None,
) -> str:
    """Change an attribute of the last link with an inertia, or of a joint, in the shipped URDF."""
    tree = ElementTree.fromstring(urdf or PROBLEMS["heavy-object"].urdf_text)
    kind = "joint" if path.startswith("joint") else "link"
    element = [
        each
        for each in tree.findall(kind)
        if each.find(path.partition("/")[2]) is not None
    ][-1]
    found = element.find(path.partition("/")[2])
    assert found is not None
    found.set(attribute, value)
    return ElementTree.tostring(tree, encoding="unicode")


def record_of(urdf: str) -> ProblemRecord:
    return ProblemRecord(record_problem(PROBLEMS["heavy-object"]).recipe, urdf)


@pytest.mark.parametrize("value", NUMBERS)
@pytest.mark.parametrize(
    ("path", "attribute"),
    [
        ("link/inertial/mass", "value"),
        ("link/inertial/inertia", "ixx"),
        ("link/inertial/inertia", "iyz"),
        ("joint/limit", "effort"),
        ("joint/limit", "lower"),
    ],
)
def test_a_number_in_another_notation_is_refused_with_its_element_and_value(
    path: str, attribute: str, value: str
) -> None:
    kind, _, element = path.partition("/")
    place = rf"{kind} '.+': <{element.rpartition('/')[2]} {attribute}={re.escape(repr(value))}>"
    with pytest.raises(RecipeError, match=place):
        open_problem(record_of(changed(path, attribute, value)))


@pytest.mark.parametrize(
    "value", ["0 0,1 0", "0 nan 0", "", "0 0", "0 0 0 0", "0;0;0", "0\xa00 0 0"]
)
@pytest.mark.parametrize(
    ("path", "attribute"),
    [
        ("link/inertial/origin", "xyz"),
        ("link/inertial/origin", "rpy"),
        ("joint/origin", "xyz"),
        ("joint/axis", "xyz"),
    ],
)
def test_a_vector_in_another_notation_is_refused(
    path: str, attribute: str, value: str
) -> None:
    with pytest.raises(
        RecipeError, match=rf"{attribute}={re.escape(repr(value))}> must be 3 numbers"
    ):
        open_problem(record_of(changed(path, attribute, value)))


@pytest.mark.parametrize("value", ["+1.5", "1.", ".5", "15e-1", "1.5E0", "0"])
def test_every_notation_that_pinocchio_reads_is_accepted(value: str) -> None:
    _, robot = open_problem(record_of(changed("link/inertial/mass", "value", value)))
    _, usual = open_problem(record_problem(PROBLEMS["heavy-object"]))
    tree = ElementTree.fromstring(PROBLEMS["heavy-object"].urdf_text)
    mass = float(list(tree.iterfind("link/inertial/mass"))[-1].attrib["value"])
    total, before = (
        sum(inertia.mass for inertia in each.model.inertias) for each in (robot, usual)
    )
    assert total == pytest.approx(before - mass + float(value))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (r"<inertial>", "<Inertial>", "<Inertial> is not an element of a URDF"),
        (r"<mass value=[^>]*/>", "", "its <inertial> has no <mass value=...>"),
        (r"(<mass) value", r"\1 weight", "its <inertial> has no <mass value=...>"),
        (
            r"(<inertia) ixx=\S+",
            r"\1",
            "its <inertia> has no ixx: all of its numbers would be ignored",
        ),
        (r"(<mass [^>]*/>)", r"\1\1", "it has 2 elements <mass>, expected one"),
        (
            r"<axis [^>]*/>",
            '<axis xyz="0 0 0"/>',
            "<axis xyz='0 0 0'> has no direction",
        ),
        (
            r"<axis [^>]*/>",
            '<axis xyz="1e-320 0 0"/>',
            "<axis xyz='1e-320 0 0'> has no direction",
        ),
        (r"(<origin) ", r'\1 quat_xyzw="0 0 0 1" ', "quat_xyzw=...> is not supported"),
        (r"<mass [^>]*/>", '<mass value="1e-320"/>', "Pinocchio reads|has no mass"),
    ],
)
def test_an_element_that_pinocchio_ignores_is_refused(
    old: str, new: str, message: str
) -> None:
    text = PROBLEMS["heavy-object"].urdf_text
    if old == "<inertial>":
        text = text.replace("</inertial>", "</Inertial>")
    urdf = re.sub(old, new, text)
    assert urdf != text
    with pytest.raises(RecipeError, match=message):
        open_problem(record_of(urdf))


def test_all_mistakes_of_a_file_are_listed_with_its_name(tmp_path: Path) -> None:
    urdf = changed(
        "joint/limit",
        "effort",
        "1,5",
        urdf=changed("link/inertial/mass", "value", "2,5"),
    )
    text = (
        PROBLEMS["heavy-object"]
        .path.read_text(encoding="utf-8")
        .replace(f'"{PROBLEMS["heavy-object"].robot.urdf}"', '"robot.urdf"')
    )
    (tmp_path / "problem.toml").write_text(text, encoding="utf-8")
    (tmp_path / "robot.urdf").write_text(urdf, encoding="utf-8")
    with pytest.raises(RecipeError) as error:
        load_robot(load_problem(tmp_path / "problem.toml"))
    assert len(error.value.errors) == 2
    assert all("robot.urdf: " in error for error in error.value.errors)


def test_plans_with_such_a_urdf_are_not_judged(tmp_path: Path) -> None:
    """The file is consistent: its checksum and the hash of its problem are those of the changed URDF."""
    plan = stored_plan("transport")
    plans = plans_of(plan)
    dropped = ProblemRecord(
        plans.problem.recipe,
        re.sub(r'(<mass value=")([^"]*)"', r'\g<1>1,5"', plans.problem.urdf),
    )
    assert dropped.urdf != plans.problem.urdf
    save_plans(tmp_path / "plans.h5", replace(plans, problem=dropped))
    with is_refused(CnpgenError):
        evaluate_plans(load_plans(tmp_path / "plans.h5"), workers=1)


def test_joints_and_links_are_read_by_name() -> None:
    tree = ElementTree.fromstring(PROBLEMS["heavy-object"].urdf_text)
    parameters = urdf_parameters(tree)
    assert set(parameters.inertias) == {
        link.get("name") for link in tree.findall("link")
    }
    assert {joint.name for joint in parameters.joints.values()} == {
        each.get("name") for each in tree.findall("joint")
    }


@pytest.mark.parametrize("length", [1, 3])
def test_a_cycle_that_no_root_moves_is_refused(length: int) -> None:
    """Pinocchio builds a model without these links."""
    links = "".join(f'<link name="c{k}"/>' for k in range(length))
    joints = "".join(
        f'<joint name="cycle{k}" type="fixed"><parent link="c{k}"/><child link="c{(k + 1) % length}"/></joint>'
        for k in range(length)
    )
    urdf = PROBLEMS["heavy-object"].urdf_text.replace(
        "</robot>", f"{links}{joints}</robot>"
    )
    with is_refused(RecipeError):
        open_problem(record_of(urdf))
