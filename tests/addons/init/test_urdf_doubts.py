"""URDFs of other programs: stated limits are kept, and what is doubtful, missing or broken is named."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.addons.init.arm import arm_notes, read_arm
from cnpgen.addons.init.initial_recipes import InitialProblem, problem_of
from cnpgen.addons.init.joint_limits import read_joint_limits, with_joint_limits
from cnpgen.addons.init.write import problem_text
from cnpgen.cli.main import main
from cnpgen.errors import RecipeError, UsageError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.robot_spec import LimitSources
from cnpgen.robots.urdf import urdf_tree
from cnpgen.robots.urdf_changes import with_disabled_pairs
from cnpgen.robots.urdf_elements import (
    _KNOWN,
    SRDF_NAMES,
    check_elements,
    unread_elements,
)
from tests.refusals import is_refused

BOX = '<geometry><box size="0.4 0.08 0.08"/></geometry>'
INERTIA = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.06" iyz="0" izz="0.06"/>'
UPPER = f'<inertial><origin xyz="0.2 0 0"/><mass value="4"/>{INERTIA}</inertial>'
SHAPE = f'<collision><origin xyz="0.2 0 0"/>{BOX}</collision>'
LIMIT = '<limit lower="-2" upper="2" velocity="2" effort="120"/>'
FINGER = """<link name="{name}"><collision><origin xyz="0.05 0 0"/><geometry><box size="0.1 0.02 0.02"/></geometry>
</collision></link><joint name="{joint}" type="revolute"><parent link="wrist"/><child link="{name}"/>
<origin xyz="0.1 0.03 0"/><axis xyz="0 0 1"/><limit lower="{low}" upper="1.2" velocity="1" effort="10"/>{mimic}</joint>"""


def finger(
    name: str = "f1", joint: str = "g1", low: float = -0.1, mimic: str = ""
) -> str:
    return FINGER.format(name=name, joint=joint, low=low, mimic=mimic)


def write(
    path: Path,
    *,
    upper: str = UPPER + SHAPE,
    limit: str = LIMIT,
    more: str = "",
    root: str = "",
) -> Path:
    """Write an arm with two joints on a base, whose first link is ``upper``."""
    path.write_text(f"""<robot name="arm">{root}
<link name="base"><collision><origin xyz="0 0 0.05"/><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
<link name="upper">{upper}</link>
<link name="wrist"><inertial><origin xyz="0.1 0 0"/><mass value="0.5"/>{INERTIA}</inertial>
<collision><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.05 0.05"/></geometry></collision></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.3"/>
<axis xyz="0 1 0"/>{limit}</joint>
<joint name="j2" type="revolute"><parent link="upper"/><child link="wrist"/><origin xyz="0.45 0 0"/>
<axis xyz="0 1 0"/>{LIMIT}</joint>
{more}</robot>""")
    return path


def initial(path: Path, tip: str | None = "wrist", **options: Any) -> InitialProblem:
    return problem_of(
        read_arm(path, tip), "arm", path.parent / "arm", (), None, **options
    )


def notes(path: Path, tip: str | None = "wrist") -> str:
    return "\n".join(arm_notes(read_arm(path, tip)))


LIFT = """<link name="rail"/><joint name="lift" type="prismatic"><parent link="rail"/><child link="base"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.4" velocity="0.1" effort="{effort}"/></joint>"""


@pytest.mark.parametrize(("effort", "scale"), [(70, 0.8), (50, 1.0)])
def test_a_torque_limit_above_the_gravity_load_is_kept(
    tmp_path: Path, effort: float, scale: float
) -> None:
    path = write(tmp_path / "a.urdf", root=LIFT.format(effort=effort))
    made = initial(path)  # the load is 4.5 kg, 44.1 N
    assert made.problem.limits.torque is None
    assert made.problem.limits.torque_scale == scale
    robot = load_robot(made.problem)
    assert robot.torque_limit[0] == pytest.approx(scale * effort)


def test_a_torque_limit_below_the_gravity_load_is_replaced_with_a_doubt(
    tmp_path: Path,
) -> None:
    made = initial(write(tmp_path / "a.urdf", root=LIFT.format(effort=20)))
    assert made.problem.limits.torque is not None
    (note,) = (note for note in made.notes if "gravity needs" in note)
    assert "lift: gravity needs 44.14 N, where the URDF allows 20 N" in note
    assert "check the masses" in note


def test_masses_in_grams_are_refused(tmp_path: Path) -> None:
    upper = UPPER.replace('value="4"', 'value="4000"') + SHAPE
    with is_refused(RecipeError):
        initial(write(tmp_path / "a.urdf", upper=upper))


def test_a_link_without_a_collision_element_is_named_and_can_use_its_visual(
    tmp_path: Path,
) -> None:
    visual = SHAPE.replace("collision>", "visual>")
    path = write(tmp_path / "a.urdf", upper=UPPER + visual)
    assert "links with a <visual> and no <collision> element: upper" in notes(path)
    assert links(load_robot(initial(path).problem)) == {"base", "wrist"}
    arm = read_arm(path, "wrist").with_visual_shapes()
    assert "no <collision> element" not in "\n".join(arm_notes(arm))
    made = problem_of(arm, "arm", tmp_path / "arm", (), None)
    assert made.problem.robot.visual_links == ("upper",)
    with_collision = write(tmp_path / "b.urdf", upper=UPPER + visual + SHAPE)
    expected = load_robot(initial(with_collision).problem)
    found = load_robot(made.problem)
    assert corners(found, "upper") == pytest.approx(corners(expected, "upper"))


def links(robot: Robot) -> set[str]:
    assert robot.shape is not None
    return {part.link for part in robot.shape.convex_parts}


def corners(robot: Robot, link: str) -> np.ndarray:
    assert robot.shape is not None
    (part,) = (part for part in robot.shape.convex_parts if part.link == link)
    return np.array(part.vertices)


def test_a_locked_joint_moves_to_the_limit_nearest_to_zero(tmp_path: Path) -> None:
    path = write(tmp_path / "a.urdf", more=finger(low=0.3))
    assert "the locked joint g1 is at 0.3, its limit nearest to zero" in notes(path)
    spec = initial(path).problem.robot
    assert dict(zip(spec.locked_joints, spec.locked_positions, strict=True)) == {
        "g1": 0.3
    }
    inside = write(tmp_path / "b.urdf", more=finger())
    assert initial(inside).problem.robot.locked_joints == ()


def test_a_recipe_with_a_locked_joint_that_cannot_be_at_zero_is_read(
    tmp_path: Path,
) -> None:
    made = initial(write(tmp_path / "a.urdf", more=finger(low=0.3)))
    file = tmp_path / "arm" / "problem.toml"
    file.parent.mkdir()
    text = problem_text(made, file.parent)
    file.write_text(text)
    assert load_problem(file).robot.locked_positions == (0.3,)
    file.write_text(re.sub("locked_(joints|positions) = .*", "", text))
    with is_refused(RecipeError):
        load_problem(file)


def test_followers_of_a_locked_joint_have_their_offset(tmp_path: Path) -> None:
    mimic = '<mimic joint="g1" multiplier="2" offset="0.4"/>'
    more = finger() + finger("f2", "g2", mimic=mimic)
    spec = initial(write(tmp_path / "a.urdf", more=more)).problem
    assert spec.robot.locked_joints == ("g1",)
    joint = re.search(
        r'<joint name="g2" type="fixed">.*?rpy="([^"]*)"', spec.urdf_text, re.S
    )
    assert joint is not None
    assert np.allclose([float(v) for v in joint[1].split()], [0, 0, 0.4])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"limit": LIMIT.replace('velocity="2"', 'velocity="180"')},
            "joint j1: its velocity limit is 180 rad/s; 180 deg/s would be 3.142 rad/s",
        ),
        (
            {
                "upper": UPPER
                + SHAPE.replace('xyz="0.2 0 0"', 'xyz="0.2 0 0" rpy="0 90 0"')
            },
            "link upper: <origin rpy> has the angle 90 rad; 90 deg would be 1.571 rad",
        ),
        (
            {"limit": LIMIT.replace('lower="-2"', "")},
            "joint j1: its <limit> has no 'lower', which means 0",
        ),
        (
            {"more": finger().replace('<axis xyz="0 0 1"/>', "")},
            "joint g1: it has no <axis>, so that it moves along or about 1 0 0",
        ),
        (
            {"more": finger().replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 2"/>')},
            "joint g1: its <axis> has the length 2: only its direction counts",
        ),
        (
            {"upper": UPPER.replace("0.2 0 0", "1.4 0 0") + SHAPE},
            "link upper: its center of mass is 1.4 m from its origin, the link reaches 0.45 m",
        ),
        (
            {"upper": re.sub('i(..)="[^"]*"', r'i\1="0"', UPPER) + SHAPE},
            "link upper: it has 4 kg and an <inertia> of zeros",
        ),
        (
            {"upper": UPPER.replace(INERTIA, "") + SHAPE},
            "link upper: its <inertial> has no <inertia>, so that its 4 kg count as a point",
        ),
    ],
)
def test_doubtful_numbers_are_named(
    tmp_path: Path, changes: dict[str, str], text: str
) -> None:
    assert text in notes(write(tmp_path / "a.urdf", **changes))
    assert text not in notes(write(tmp_path / "b.urdf"))


def test_a_mass_without_inertia_counts_and_the_parser_prints_no_error(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "a.urdf", upper=UPPER.replace(INERTIA, "") + SHAPE)
    robot = load_robot(initial(path).problem)
    assert robot.chain.joints[0].mass == pytest.approx(4.0)
    assert capfd.readouterr().err == ""


def dae(path: Path, unit: float) -> Path:
    corners = " ".join(
        f"{x} {y} {z}" for x in (0, 0.4 / unit) for y in (0, 8) for z in (0, 5)
    )
    faces = "0 1 3 0 3 2 4 6 7 4 7 5 0 4 5 0 5 1 2 3 7 2 7 6 0 2 6 0 6 4 1 5 7 1 7 3"
    path.write_text(f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="u" meter="{unit}"/><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="24">{corners}</float_array><technique_common>
<accessor source="#pa" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v">
<input semantic="POSITION" source="#p"/></vertices><triangles count="12">
<input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">
<instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>""")
    return path


MESH = '<collision><geometry><mesh filename="{name}"/></geometry></collision>'


@pytest.mark.parametrize("unit", [0.01, 0.001])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_the_remedy_for_a_mesh_in_another_unit_is_the_unit_of_its_file(
    tmp_path: Path, unit: float
) -> None:
    dae(tmp_path / "a.dae", unit)
    upper = UPPER + MESH.format(name="a.dae")
    path = write(tmp_path / "a.urdf", upper=upper)
    with is_refused(RecipeError):
        initial(path)
    scaled = upper.replace('"a.dae"', f'"a.dae" scale="{unit} {unit} {unit}"')
    assert "upper" in links(load_robot(initial(write(path, upper=scaled)).problem))


def test_a_broken_mesh_names_its_link_and_can_be_left_out(tmp_path: Path) -> None:
    (tmp_path / "broken.stl").write_bytes(b"solid nothing")
    path = write(tmp_path / "a.urdf", upper=UPPER + MESH.format(name="broken.stl"))
    with is_refused(RecipeError):
        initial(path)
    made = initial(path, skipped_meshes=("upper",))
    assert "upper" not in links(load_robot(made.problem))
    with is_refused(RecipeError):
        initial(path, skipped_meshes=("uper",))


def test_the_default_tip_is_no_finger(tmp_path: Path) -> None:
    more = finger("left_finger") + finger("right_finger", "g2")
    assert read_arm(write(tmp_path / "a.urdf", more=more), None).tip == "wrist"
    tcp = '<link name="tcp"/><joint name="jt" type="fixed"><parent link="wrist"/><child link="tcp"/></joint>'
    assert read_arm(write(tmp_path / "b.urdf", more=more + tcp), None).tip == "tcp"
    with is_refused(UsageError):
        read_arm(write(tmp_path / "c.urdf", more=finger() + tcp), None)


LIMITS = """default_velocity_scaling_factor: 0.1
joint_limits:
  j1:
    has_velocity_limits: true
    max_velocity: 1.5
    has_acceleration_limits: true
    max_acceleration: 3.0
    has_position_limits: true
    min_position: -1.0
    max_position: 0.5
  j2:
    has_velocity_limits: false
    max_velocity: 0.1
    has_jerk_limits: true
    max_jerk: 44.0
"""


def test_limits_of_moveit_replace_those_of_the_urdf(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    (tmp_path / "limits.yaml").write_text(LIMITS)
    path = write(tmp_path / "a.urdf")
    limits = read_joint_limits(tmp_path / "limits.yaml", ("j1", "j2"))
    arm = with_joint_limits(read_arm(path, "wrist"), limits)
    made = problem_of(arm, "arm", tmp_path / "arm", (), None, joint_limits=limits)
    robot, usual = load_robot(made.problem), load_robot(initial(path).problem)
    assert robot.position_lower.tolist() == [-1.0, -2.0]
    assert robot.position_upper.tolist() == [0.5, 2.0]
    assert robot.rated_velocity.tolist() == [1.5, 2.0]
    assert robot.acceleration_limit[0] == 3.0
    assert robot.acceleration_limit[1] == usual.acceleration_limit[1]
    assert robot.jerk_limit.tolist() == [300.0, 44.0]
    assert made.problem.limits.sources == LimitSources(
        position="stated: limits.yaml for j1; the URDF for j2",
        velocity="stated: limits.yaml for j1; the URDF for j2",
        acceleration="guess: limits.yaml for j1;"
        " 10/s times the velocity limits, at most 20 rad/s^2 for j2",
        jerk="guess: limits.yaml for j2; 100/s times the acceleration limits for j1",
    )
    notes = "\n".join(arm_notes(arm))
    assert "j2: max_velocity is not used, since has_velocity_limits is not" in notes
    assert "limits.yaml: default_velocity_scaling_factor is not used" in notes


def test_limits_of_joints_that_are_not_planned_are_listed(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    file = tmp_path / "limits.yaml"
    file.write_text(LIMITS.replace("  j2:", "  g1:"))
    arm = read_arm(write(tmp_path / "a.urdf", more=finger()), "wrist")
    limits = read_joint_limits(file, ("j1", "j2", "g1"))
    notes = "\n".join(arm_notes(with_joint_limits(arm, limits)))
    assert "limits.yaml: limits of g1 are not used, since it is not planned" in notes


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("j1:", "j9:", "the URDF has no joint 'j9'"),
        ("max_velocity: 1.5", "max_velocty: 1.5", "unknown key 'max_velocty'"),
        ("    max_velocity: 1.5\n", "", "max_velocity must be a number, got None"),
        ("max_acceleration: 3.0", "max_acceleration: 0.0", "must be positive, got 0"),
        ("min_position: -1.0", "min_position: 1.0", "must be below max_position"),
        ("has_jerk_limits: true", "has_jerk_limits: 1", "must be true or false"),
        ("joint_limits:", "limits:", "expected 'joint_limits'"),
    ],
)
def test_faults_in_limits_of_moveit_are_named(
    tmp_path: Path, old: str, new: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("yaml")
    assert LIMITS.count(old) >= 1
    (tmp_path / "limits.yaml").write_text(LIMITS.replace(old, new, 1))
    words = ["init", str(tmp_path / "arm"), "--urdf", str(write(tmp_path / "a.urdf"))]
    limits = str(tmp_path / "limits.yaml")
    assert main([*words, "--tip", "wrist", "--joint-limits", limits]) == 2
    assert text in capsys.readouterr().err


def test_what_is_not_read_is_listed(tmp_path: Path) -> None:
    more = "<gazebo/><gazebo><plugin a='1'/></gazebo><sensor name='eye'/><material name='red'/>"
    limit = LIMIT.replace("/>", ' gear="3"/>') + "<hardwareInterface/>"
    shape = SHAPE + "<verbose/>"
    path = write(tmp_path / "arm.urdf", upper=UPPER + shape, limit=limit, more=more)
    notes = list(unread_elements(urdf_tree(path.read_text())))
    assert (
        notes[0]
        == "elements of other software are not read: <gazebo> (2), <sensor> (1)"
    )
    assert notes[1:] == [
        "<hardwareInterface> in <joint> is not read, 1 time",
        "<verbose> in <link> is not read, 1 time",
        "the attribute 'gear' of <limit> is not read, 1 time",
    ]
    load_robot(initial(path).problem)
    plain = write(tmp_path / "plain.urdf")
    assert not list(unread_elements(urdf_tree(plain.read_text())))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"upper": UPPER + SHAPE.replace("collision", "colision") + SHAPE},
            "<colision> in <link> (did you mean 'collision'?)",
        ),
        (
            {"limit": LIMIT.replace("effort", "efort")},
            "the attribute 'efort' of <limit> (did you mean 'effort'?)",
        ),
        (
            {"limit": LIMIT + "<safety_controler soft_upper_limit='1'/>"},
            "<safety_controler> in <joint> (did you mean 'safety_controller'?)",
        ),
        (
            {"upper": UPPER.replace("inertial", "inertal") + SHAPE},
            "<inertal> in <link> (did you mean 'inertial'?)",
        ),
        ({"more": "<Link name='x'/>"}, "<Link> in <robot> (did you mean 'link'?)"),
    ],
)
def test_misspelt_elements_of_a_urdf_are_refused(
    tmp_path: Path, changes: dict[str, str], text: str
) -> None:
    path = write(tmp_path / "a.urdf", **changes)
    with pytest.raises(RecipeError, match=re.escape(text)):
        initial(path)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {
                "upper": UPPER
                + SHAPE.replace("<geometry>", "<geometry><sphere radius='9'/>")
            },
            "a second shape in <geometry>",
        ),
        (
            {
                "upper": UPPER
                + SHAPE.replace(
                    "<geometry>", "<origin/><origin xyz='9 0 0'/><geometry>"
                )
            },
            "a second <origin> in <collision>",
        ),
        (
            {"limit": LIMIT + "<mimic joint='j2'/><mimic joint='j1'/>"},
            "a second <mimic> in <joint>",
        ),
        ({"more": "<axis xyz='0 0 1'/>"}, "<axis> in <robot> (it belongs in <joint>)"),
        (
            {"limit": LIMIT.replace("/>", " soft_lower_limit='0'/>")},
            "'soft_lower_limit' of <limit> (it belongs in <safety_controller>)",
        ),
    ],
)
def test_repeated_and_misplaced_elements_of_a_urdf_are_refused(
    tmp_path: Path, changes: dict[str, str], text: str
) -> None:
    path = write(tmp_path / "arm.urdf", **changes)
    with pytest.raises(RecipeError, match=re.escape(text)):
        initial(path)


def test_the_jerk_and_deceleration_of_a_urdf_limit_the_arm(tmp_path: Path) -> None:
    limit = LIMIT.replace("/>", ' acceleration="8" deceleration="7" jerk="250"/>')
    path = write(tmp_path / "a.urdf", limit=limit)
    problem = initial(path).problem
    robot = load_robot(problem)
    assert robot.acceleration_limit[0] == 7.0
    assert robot.jerk_limit[0] == 250.0
    assert problem.limits.sources.jerk == (
        "guess: the URDF for j1; 100/s times the acceleration limits for j2"
    )
    assert "is not read" not in notes(path)
    wrong = write(path, limit=limit.replace("deceleration", "deceleraton"))
    with is_refused(RecipeError):
        initial(wrong)


def test_a_follower_needs_a_leader_that_the_urdf_has(tmp_path: Path) -> None:
    mimic = "<mimic joint='g9' multiplier='-1'/>"
    path = write(tmp_path / "a.urdf", more=finger() + finger("f2", "g2", mimic=mimic))
    with is_refused(RecipeError):
        initial(path)
    initial(path, allow_unused=("mimic",))


def test_no_planned_joint_is_passive(tmp_path: Path) -> None:
    path = write(tmp_path / "a.urdf")
    srdf = tmp_path / "a.srdf"
    srdf.write_text("<robot name='arm'><passive_joint name='j2'/></robot>")
    with_disabled_pairs(path.read_text(), srdf, planned=["j1"])
    with is_refused(RecipeError):
        with_disabled_pairs(path.read_text(), srdf, planned=["j1", "j2"])


def test_the_root_of_urdf_and_srdf_is_a_robot(tmp_path: Path) -> None:
    path = write(tmp_path / "arm.urdf")
    srdf = tmp_path / "arm.srdf"
    pair = "<disable_collisions link1='base' link2='upper'/>"
    groups = "<group name='a'/><group name='b'/>"
    srdf.write_text(f"<robot name='arm'>{groups}{pair}</robot>")
    with_disabled_pairs(path.read_text(), srdf)
    srdf.write_text(f"<robt name='arm'>{pair}</robt>")
    with is_refused(RecipeError):
        with_disabled_pairs(path.read_text(), srdf)


def test_the_loss_of_a_misspelt_element_is_accepted_by_name_and_recorded(
    tmp_path: Path,
) -> None:
    upper = UPPER + SHAPE.replace("collision", "colision") + SHAPE
    path = write(tmp_path / "a.urdf", upper=upper)
    found = initial(path, allow_unused=("colision",))
    assert found.problem.robot.allow_unused == ("colision",)
    assert "<colision> in <link> is not read, 1 time" in "".join(found.notes)
    with is_refused(UsageError, argument="allow_unused"):
        initial(path, allow_unused=("colision", "colison"))
    srdf = tmp_path / "a.srdf"
    srdf.write_text("<robot name='a'><disable_collision link1='a'/></robot>")
    tree = urdf_tree(srdf.read_text())
    with is_refused(RecipeError):
        check_elements(tree, srdf, SRDF_NAMES)
    check_elements(tree, srdf, SRDF_NAMES, allow_unused=["disable_collision"])


def test_a_name_beside_the_one_that_it_resembles_is_not_misspelt() -> None:
    limit = "<joint><limit velocity='1' gear_velocity='9'/></joint>"
    check_elements(urdf_tree(f"<robot>{limit}</robot>"), Path("arm.urdf"))
    other = limit.replace(" velocity", " v")
    with is_refused(RecipeError):
        check_elements(urdf_tree(f"<robot>{other}</robot>"), Path("arm.urdf"))


def chain_to(tag: str) -> list[str]:
    """Return the tags from the root of a URDF to an element."""
    parents: dict[str, str] = {}
    for parent, names in _KNOWN.items():
        for name in names:
            parents.setdefault(name.strip("<>"), parent)
    tags = [tag]
    while tags[0] != "robot":
        tags.insert(0, parents[tags[0]])
    return tags


@pytest.mark.parametrize("tag", _KNOWN)
def test_every_misspelt_name_of_a_urdf_is_refused(tag: str) -> None:
    opening = "".join(f"<{each}>" for each in chain_to(tag))
    closing = "".join(f"</{each}>" for each in chain_to(tag)[::-1])
    for name in (each.strip("<>") for each in _KNOWN[tag]):
        for wrong in (f"{name}q", name.capitalize()[:-1] + name[-1:] * 2):
            for part in (f"<{wrong}/>", opening.removesuffix(">")):
                text = f"{opening}{part}{closing}"
                if part != f"<{wrong}/>":
                    text = f"{part} {wrong}='1'>{closing}"
                with pytest.raises(RecipeError, match=f"{wrong}.*did you mean"):
                    check_elements(urdf_tree(text), Path("arm.urdf"))
        check_elements(urdf_tree(f"{opening}{closing}"), Path("arm.urdf"))


@pytest.mark.parametrize("tag", _KNOWN)
def test_children_given_as_attributes_and_the_reverse_are_refused(tag: str) -> None:
    opening = "".join(f"<{each}>" for each in chain_to(tag))
    closing = "".join(f"</{each}>" for each in chain_to(tag)[::-1])
    for name in {*_KNOWN[tag]} - {"version", "name"}:
        other = name.strip("<>") if name.startswith("<") else f"<{name}>"
        start, part = opening, f"<{other.strip('<>')}/>"
        if name.startswith("<"):
            start, part = opening.removesuffix(">"), f" {other}='1'>"
        with pytest.raises(RecipeError, match=f"{other}.* (is read|belongs) in <"):
            check_elements(urdf_tree(f"{start}{part}{closing}"), Path("arm.urdf"))


def test_a_mass_is_no_attribute_of_an_inertial(tmp_path: Path) -> None:
    upper = UPPER.replace("<inertial>", "<inertial mass='7'>") + SHAPE
    path = write(tmp_path / "a.urdf", upper=upper)
    text = "the attribute 'mass' of <inertial> (<mass> is read in <inertial>)"
    with pytest.raises(RecipeError, match=re.escape(text)):
        initial(path)


def test_texts_in_elements_are_refused_or_listed(tmp_path: Path) -> None:
    """An axis as SDF states it would be that of x."""
    tree = urdf_tree("<robot><joint><axis>0 0 1</axis></joint></robot>")
    text = "the text '0 0 1' in <axis> (expected xyz) would not be read"
    with pytest.raises(RecipeError, match=re.escape(text)):
        check_elements(tree, Path("arm.urdf"))
    check_elements(tree, Path("arm.urdf"), allow_unused=["axis"])
    path = write(tmp_path / "a.urdf", upper=UPPER + "four" + SHAPE + "kg")
    assert "the text 'four kg' in <link> is not read, 1 time" in notes(path)


def test_unknown_parts_of_a_calibration_and_groups_are_listed(tmp_path: Path) -> None:
    limit = LIMIT + "<calibration rising='0.1' offset='0.2'><zero/></calibration>"
    shape = SHAPE.replace("<collision>", "<collision group='a'>")
    found = notes(write(tmp_path / "a.urdf", upper=UPPER + shape, limit=limit))
    for part in ("the attribute 'offset' of <calibration>", "<zero> in <calibration>"):
        assert f"{part} is not read, 1 time" in found
    assert "the attribute 'group' of <collision> is not read, 1 time" in found


@pytest.mark.parametrize("name", SRDF_NAMES["robot"][2:])
def test_elements_of_an_srdf_in_a_urdf_are_refused(tmp_path: Path, name: str) -> None:
    part = name.replace(">", " link1='base' link2='wrist'/>")
    path = write(tmp_path / "a.urdf", more=part)
    text = f"{name} in <robot> (it belongs in an SRDF)"
    with pytest.raises(RecipeError, match=re.escape(text)):
        initial(path)


def test_link_pairs_that_a_urdf_disables_are_left_unused(tmp_path: Path) -> None:
    pair = "<disable_collisions link1='base' link2='wrist'/>"
    path = write(tmp_path / "a.urdf", more=pair)
    found = initial(path, allow_unused=("disable_collisions",)).problem
    plain = initial(write(tmp_path / "b.urdf")).problem
    assert links(load_robot(found)) == {"base", "upper", "wrist"}
    shapes = load_robot(found).shape, load_robot(plain).shape
    assert repr(shapes[0].pairs) == repr(shapes[1].pairs)
    # Elements of other parts are not read by MoveIt either.
    nested = write(tmp_path / "c.urdf", upper=UPPER + SHAPE + pair)
    assert repr(load_robot(initial(nested).problem).shape.pairs) == repr(
        shapes[1].pairs
    )


def test_an_srdf_of_another_robot_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    urdf = write(tmp_path / "a.urdf").read_text()
    srdf = tmp_path / "a.srdf"
    for name in ("arm", "crane"):
        srdf.write_text(f"<robot name='{name}'/>")
        with_disabled_pairs(urdf, srdf)
        warned = f"a.srdf is of the robot {name!r}, the URDF of 'arm'" in caplog.text
        assert warned == (name != "arm")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (
            "<actuator><mechanicalReduction>9</mechanicalReduction></actuator>",
            "<mechanicalReduction>",
        ),
        ("<actuator><motorInertia>1</motorInertia></actuator>", "<motorInertia>"),
        (
            "<mechanicalReduction>9</mechanicalReduction><motorInertia>1</motorInertia>",
            "<mechanicalReduction> and <motorInertia>",
        ),
    ],
)
def test_the_parts_of_a_transmission_are_listed(
    tmp_path: Path, content: str, text: str
) -> None:
    more = f"<transmission><joint name='j1'/>{content}</transmission>"
    found = read_arm(write(tmp_path / "a.urdf", more=more), "wrist").joint_notes
    assert found == (
        f"not used of the <transmission> of j1: {text};"
        " gear_ratio and rotor_inertia of [drive] state both",
    )
