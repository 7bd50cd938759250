"""Recipes for anybody's arm: they work as they are, explain every key, and say what is missing in the URDF."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.benchmark.run_suite import run_benchmark
from cnpgen.addons.init import hull_gap, link_overlaps
from cnpgen.addons.init.arm import read_arm
from cnpgen.addons.init.initial_recipes import problem_of
from cnpgen.addons.init.stated_sources import INITIAL_JERK_RATE
from cnpgen.addons.init.write import toml
from cnpgen.addons.manual.describe_keys import part_of
from cnpgen.cli.main import main
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.problems.constraints.joint import JointJerk
from cnpgen.problems.idle_keys import idle_keys
from cnpgen.problems.limit_sources import limit_sources
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.schema.keys import PerJoint, Range, keys
from cnpgen.world.world import World
from tests.examples.example_robots import folder as robots
from tests.examples.example_robots import needs_robots
from tests.examples.installed import installed_kind
from tests.examples.meshes import Meshes
from tests.examples.shaped_robot import LINKS, arm_of_channels, write_crane
from tests.refusals import assert_said

IIWA = Path(__file__).parents[3] / "problems" / "airhockey" / "iiwa14_striker.urdf"
_INERTIA = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/>'


def write_arm(
    path: Path, joints: list[tuple[str, str, str]], *, mass: float = 2.0
) -> Path:
    """Write a URDF of links without shapes in a row: (type, axis, what is in the joint's element)."""
    inertial = f'<inertial><mass value="{mass}"/>{_INERTIA}</inertial>' if mass else ""
    parts = ['<robot name="arm"><link name="link_0"/>']
    for number, (kind, axis, limit) in enumerate(joints, 1):
        parts.append(
            f'<link name="link_{number}">{inertial}</link><joint name="joint_{number}" type="{kind}">'
        )
        parts.append(
            f'<parent link="link_{number - 1}"/><child link="link_{number}"/><axis xyz="{axis}"/>'
        )
        parts.append(
            f'<origin xyz="0.3 0 {0.3 if number == 1 else 0.0}"/>{limit}</joint>'
        )
    end = (
        f'<parent link="link_{len(joints)}"/><child link="end"/><origin xyz="0.3 0 0"/>'
    )
    parts.append(
        f'<link name="end"/><joint name="end_joint" type="fixed">{end}</joint></robot>'
    )
    path.write_text("\n".join(parts))
    return path


LIMIT = '<limit lower="-2" upper="2" velocity="2" effort="90"/>'
ELBOW = [
    ("revolute", "0 0 1", LIMIT),
    ("revolute", "0 1 0", LIMIT),
    ("revolute", "0 1 0", LIMIT),
]


def proved(folder: Path) -> None:
    """Check that a dataset of the recipes is what it is said to be."""
    made = cnpgen.make_dataset(
        folder / "dataset.toml", folder / "rows", n=300, workers=1
    )
    assert cnpgen.validate_dataset(made.folder, deep=True, workers=1).ok


def solved(folder: Path, n: int) -> None:
    """Check that all of some fresh problems of the recipes are solved."""
    assert (
        main(
            [
                "solve",
                str(folder / "pipeline.toml"),
                "--n",
                str(n),
                "-o",
                str(folder / "plans.h5"),
                "--quiet",
            ]
        )
        == 0
    )
    plans = cnpgen.load_plans(folder / "plans.h5")
    assert cnpgen.evaluate_plans(plans, workers=1).valid.all()


@pytest.fixture(scope="module")
def crane(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("crane")
    urdf = write_crane(folder)
    assert (
        main(["init", str(folder / "my-crane"), "--urdf", str(urdf), "--tip", "hand"])
        == 0
    )
    return folder / "my-crane"


def test_the_recipes_of_a_crane_work_as_they_are(crane):
    proved(crane)
    solved(crane, 8)


def test_every_key_is_there_with_what_it_means(crane):
    recipe = load_dataset_recipe(crane / "dataset.toml")
    problem = recipe.pipeline.problem
    files = {
        "problem.toml": [
            problem,
            problem.robot,
            problem.limits,
            problem.trajectory,
            *problem.constraint,
        ]
    }
    files |= {
        "pipeline.toml": [recipe.pipeline, *recipe.pipeline.stage],
        "dataset.toml": [recipe],
    }
    for name, tables in files.items():
        text = (crane / name).read_text(encoding="utf-8")
        flat = " ".join(line.removeprefix("# ") for line in text.splitlines())
        for table in tables:
            for key in (key for key in keys(type(table)) if part_of(key) is None):
                assert key.doc in flat
                assert f"\n{key.name} = " in text or f"\n# {key.name} = " in text


def test_what_is_left_out_is_at_its_default(crane):
    with (crane / "problem.toml").open("rb") as file:
        said = tomllib.load(file)
    assert said["limits"] == {
        "velocity_scale": 0.8,
        "torque_scale": 0.8,
        "jerk": said["limits"]["jerk"],
        "sources": {"jerk": "guess: 100/s times the acceleration limits"},
    }
    assert said["robot"]["joints"] == ["swing", "lift", "elbow", "roll"]
    assert {"object", "payload", "obstacle"}.isdisjoint(said)


def test_what_was_found_out_is_said_at_the_top(crane):
    text = (crane / "problem.toml").read_text(encoding="utf-8")
    about = text[: text.index("\nname = ")]
    assert re.search(r"swing +revolute +-2.5 to 2.5 +2 +100\n", about)
    for found in (
        "stay at zero: grip",
        "5 kg in 5 moving links",
        "claw",
        "overhang [mm]",
    ):
        assert found in about
    assert "checked by" in about
    assert "of the draws" in (crane / "pipeline.toml").read_text(encoding="utf-8")


def test_reading_the_recipes_again_says_nothing(
    crane: Path, caplog: pytest.LogCaptureFixture
) -> None:
    load_problem(crane / "problem.toml")
    assert not caplog.messages


def test_the_base_configuration_is_ahead_and_links_do_not_touch_there(crane):
    robot = load_robot(load_problem(crane / "problem.toml"))
    world = World(robot)
    assert min(world.self_distances()) > 0
    assert world.tip_position[0] > 0
    assert (np.abs(world.holding_torque) < robot.torque_limit).all()


@pytest.mark.slow
def test_the_recipes_of_an_iiwa_make_datasets(tmp_path):
    folder = tmp_path / "striker"
    assert main(["init", str(folder), "--urdf", str(IIWA), "--tip", "striker_tip"]) == 0
    proved(folder)


@needs_robots
@pytest.mark.extended  # two arms more, the claim of the crane's
@pytest.mark.parametrize(
    ("file", "tip"),
    [
        ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
        ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    ],
)
def test_the_recipes_of_arms_that_people_have_work_as_they_are(file, tip, tmp_path):
    urdf = robots() / "example-robot-data" / "robots" / file
    assert main(["init", str(tmp_path / "arm"), "--urdf", str(urdf), "--tip", tip]) == 0
    proved(tmp_path / "arm")
    solved(tmp_path / "arm", 8)


ARMS = {  # URDF, tip
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "jaco": ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "tiago": ("tiago_description/robots/tiago.urdf", "arm_tool_link"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", None),
    "z1": ("z1_description/urdf/z1.urdf", None),
    "baxter": ("baxter_description/urdf/baxter.urdf", "left_gripper"),
    "iiwa": (
        "kuka_description/kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf",
        "tool0",
    ),  # of rtb-data, an optional package
}


@needs_robots
@pytest.mark.extended  # the claim about arms of channels, for arms that people have
@pytest.mark.parametrize("name", ARMS)
def test_convex_parts_reject_less_than_two_percent_of_the_free_states(name, tmp_path):
    file, tip = ARMS[name]
    share = robots()
    urdf = share / "example-robot-data" / "robots" / file
    if name == "iiwa":
        urdf = Path(pytest.importorskip("rtbdata").__file__).parent / "xacro" / file
        (share := tmp_path / "packages").mkdir()
        (share / "kuka_lbr_iiwa_support").symlink_to(
            urdf.parents[1]
        )  # the name of the package, for Pinocchio
    initial = problem_of(read_arm(urdf, tip), name, tmp_path, (), None)
    problem = initial.problem
    assert problem.robot.hull_gap < 0.02
    robot, still = load_robot(problem), np.zeros(len(problem.robot.joints))
    world, meshes, free, rejected = World(robot), Meshes(problem, robot, share), 0, 0
    count = 4000 if name == "baxter" else 1000  # of Baxter's states 9 % are free
    for q in np.random.default_rng(1).uniform(
        robot.position_lower, robot.position_upper, (count, robot.n)
    ):
        if not meshes.touches(q):  # by Pinocchio's own reading of the URDF
            world.set_state(q, still, still, np.zeros(0))
            touches = min(world.self_distances()) < 0
            if (
                not touches or meshes.distances(q)[1] > 0
            ):  # the fast check misses overlaps of cylinders
                free, rejected = free + 1, rejected + touches
    print(f"{name}: {rejected} of {free} free states are rejected")
    assert rejected < 0.02 * free
    assert not meshes.touches(robot.home)
    for pair in robot.shape.pairs:
        if pair.left_out == "always":
            assert any(f"{pair.first}, {pair.second}" in note for note in initial.notes)


@pytest.mark.parametrize("limit", ['<limit velocity="0" effort="0"/>', "<limit/>", ""])
def test_limits_that_are_missing_are_put_in_and_said(tmp_path, limit):
    joints = [("continuous", "0 0 1", ""), ELBOW[1], ("revolute", "0 1 0", limit)]
    urdf = write_arm(tmp_path / "arm.urdf", joints)
    assert main(["init", str(tmp_path / "bare"), "--urdf", str(urdf)]) == 0
    text = " ".join(
        (tmp_path / "bare" / "problem.toml")
        .read_text(encoding="utf-8")
        .replace("\n#", " ")
        .split()
    )
    assert text.count("The URDF has none for joint_1, joint_3: put in:") == 3
    problem = load_problem(tmp_path / "bare" / "problem.toml")
    limits = problem.limits
    for quantity in ("position", "velocity", "torque"):
        text = getattr(limits.sources, quantity)
        assert text.startswith("guess: the URDF for joint_2; ")
        assert text.endswith(" for joint_1, joint_3")
    assert limits.sources.jerk == "guess: 100/s times the acceleration limits"
    sources = limit_sources(problem, load_robot(problem))
    assert {each.basis for each in sources.values()} == {"guess"}
    assert limits.position[1] == Range(-2, 2)
    assert np.allclose(
        [limits.position[0].low, limits.position[0].high], [-np.pi, np.pi]
    )
    assert limits.velocity == PerJoint((1.0, 2.0, 1.0))
    assert limits.torque.values[1] == 90
    assert min(limits.torque.values) >= 1


def test_an_absent_limit_without_a_placeholder_names_its_joint(tmp_path, capsys):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    assert main(["init", str(tmp_path / "bare"), "--urdf", str(urdf)]) == 0
    urdf.write_text(urdf.read_text().replace(' effort="90"', "", 1))
    capsys.readouterr()
    assert main(["show", str(tmp_path / "bare" / "problem.toml")]) == 2
    assert "joint_1: the torque limit must be positive" in capsys.readouterr().err


def test_errors_name_the_urdf_or_an_option(tmp_path, capsys):
    urdf, place = write_crane(tmp_path), tmp_path / "mine"
    said = refused(capsys, 2, place, "--urdf", urdf, "--skip-mesh", "no-link")
    assert said.startswith("cnpgen: error: --skip-mesh: the URDF has no link")
    other = write_arm(tmp_path / "other.urdf", [*ELBOW[:2], ("floating", "0 0 1", "")])
    said = refused(capsys, 2, place, "--urdf", other)
    assert said.startswith(f"cnpgen: error: {other}: 'joint_3' is a floating joint")


@pytest.mark.parametrize("option", ["--skip-mesh", "--srdf"])
def test_options_of_shapes_are_refused_for_an_arm_without_any(tmp_path, capsys, option):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    said = refused(capsys, 2, tmp_path / "mine", "--urdf", urdf, option, "link_1")
    assert f"{option} has no effect" in said


def test_jerks_are_limited_in_proportion_to_the_accelerations(crane):
    problem = load_problem(crane / "problem.toml")
    robot = load_robot(problem)
    assert JointJerk in map(type, problem.constraint)
    assert idle_keys(problem) == {}
    np.testing.assert_allclose(
        robot.jerk_limit, INITIAL_JERK_RATE * robot.acceleration_limit, rtol=5e-3
    )
    text = (crane / "problem.toml").read_text(encoding="utf-8")
    assert "100/s times the acceleration limits" in " ".join(
        text.replace("\n#", " ").split()
    )


def test_start_and_goal_boxes_have_a_minimum_distance(crane):
    draw = load_dataset_recipe(crane / "dataset.toml").pipeline.stage[0]
    reach = load_robot(load_problem(crane / "problem.toml")).chain.reach
    gaps = [
        max(one.low - other.high, other.low - one.high)
        for one, other in zip(draw.start, draw.goal, strict=True)
    ]
    assert max(gaps) >= draw.min_distance > 0.1 * reach


def head_of(problem: Path) -> str:
    """The findings about an arm on one line."""
    text = problem.read_text(encoding="utf-8")
    return " ".join(
        line.removeprefix("#").strip()
        for line in text[: text.index("\nname = ")].splitlines()
    )


def test_hulls_that_reject_free_space_are_decomposed_and_the_gap_is_shown(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(hull_gap, "GAP_STATES", 400)
    monkeypatch.setattr(link_overlaps, "GAP_STATES", 400)
    monkeypatch.setattr(link_overlaps, "PART_COUNTS", (4,))
    urdf = arm_of_channels(tmp_path).urdf_path
    assert (
        main(["init", str(tmp_path / "arm"), "--urdf", str(urdf), "--tip", "hand"]) == 0
    )
    assert (
        "decomposing base, fore, turret into at most 4 convex parts each"
        not in capsys.readouterr().out
    )
    robot = load_problem(tmp_path / "arm" / "problem.toml").robot
    assert (robot.convex_parts, robot.decomposed, robot.hull_gap) == (4, ("fore",), 0.0)
    head = head_of(tmp_path / "arm" / "problem.toml")
    assert (
        "free space: convex hulls of the meshes reject 1.65% of the states that the meshes accept"
        in head
    )
    assert re.search(
        r"turret fore +14.25% +3.00% +3.00% +0.00%", re.sub(" +", " ", head)
    )
    assert main(["show", str(tmp_path / "arm" / "problem.toml")]) == 0
    text = "gap: 0.00% of the random states in which no triangle meshes overlap are rejected by the convex parts"
    assert text in capsys.readouterr().out


STUCK = '<origin xyz="0 0 0.15"/><geometry><sphere radius="0.42"/></geometry>'
HALF = '<origin xyz="0.25 0 0.1"/><geometry><box size="0.5 1.5 1.5"/></geometry>'


def test_pairs_in_permanent_contact_are_named(tmp_path):
    urdf = write_crane(tmp_path, {**LINKS, "base": [STUCK]})
    assert (
        main(["init", str(tmp_path / "arm"), "--urdf", str(urdf), "--tip", "hand"]) == 0
    )
    head = head_of(tmp_path / "arm" / "problem.toml")
    assert "not checked, since they are always in contact: base, arm" in head


def test_pairs_that_leave_no_free_state_are_ignored_with_a_note(tmp_path, monkeypatch):
    monkeypatch.setattr(link_overlaps, "MIN_FREE_FRACTION", 0.6)
    urdf = write_crane(tmp_path, {**LINKS, "base": [HALF]})
    assert (
        main(["init", str(tmp_path / "arm"), "--urdf", str(urdf), "--tip", "hand"]) == 0
    )
    problem = load_problem(tmp_path / "arm" / "problem.toml")
    pairs = problem.robot.ignored_pairs
    assert pairs
    shape = load_robot(problem).shape
    assert {
        (pair.first, pair.second) for pair in shape.pairs if pair.left_out == "disabled"
    } == set(pairs)
    head = head_of(tmp_path / "arm" / "problem.toml")
    for first, second in pairs:
        text = f"no state is free of collisions: {first}, {second} (their convex parts overlap in"
        assert f"ignored, since otherwise {text}" in head


def test_an_srdf_is_used_and_named_from_the_recipes(tmp_path):
    urdf = write_crane(tmp_path)
    srdf = tmp_path / "crane.srdf"
    srdf.write_text(
        '<robot name="crane"><disable_collisions link1="hand" link2="base"/></robot>'
    )
    assert (
        main(
            [
                "init",
                str(tmp_path / "arm"),
                "--urdf",
                str(urdf),
                "--tip",
                "hand",
                "--srdf",
                str(srdf),
            ]
        )
        == 0
    )
    problem = load_problem(tmp_path / "arm" / "problem.toml")
    assert problem.robot.srdf == "../crane.srdf"
    pairs = load_robot(problem).shape.pairs
    assert [
        (pair.first, pair.second) for pair in pairs if pair.left_out == "disabled"
    ] == [("base", "hand")]
    assert "collisions are not noticed: base and hand (" in head_of(
        tmp_path / "arm" / "problem.toml"
    )


def test_an_entry_of_an_srdf_without_a_link_is_named(tmp_path, capsys):
    urdf, srdf = write_crane(tmp_path), tmp_path / "crane.srdf"
    srdf.write_text('<robot name="crane"><disable_collisions link1="hand"/></robot>')
    said = refused(
        capsys, 2, tmp_path / "arm", "--urdf", urdf, "--tip", "hand", "--srdf", srdf
    )
    assert "crane.srdf: {'link1': 'hand'} lacks link2" in said


def test_a_torque_limit_below_what_gravity_needs_is_replaced(tmp_path):
    weak = '<limit lower="-2" upper="2" velocity="2" effort="3"/>'
    urdf = write_arm(
        tmp_path / "arm.urdf",
        [ELBOW[0], ("revolute", "0 1 0", weak), ELBOW[2]],
        mass=8.0,
    )
    assert main(["init", str(tmp_path / "arm"), "--urdf", str(urdf)]) == 0
    assert re.search(
        r"joint_2: gravity needs [\d.]+ N m, where the URDF allows 3 N m",
        head_of(tmp_path / "arm/problem.toml"),
    )
    torque = load_problem(tmp_path / "arm" / "problem.toml").limits.torque.values
    assert (torque[0], torque[2]) == (90, 90)
    assert torque[1] > 30


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ('lower="-2" upper="2"', 'lower="2" upper="-2"'),
            "'joint_2': its limits lower=2 and upper=-2 are swapped",
        ),
        (
            ('lower="-2" upper="2"', 'lower="-115" upper="90"'),
            "joint_2: limits of positions are at most 25.1 rad",
        ),
        (
            ('lower="-2" upper="2"', 'lower="-115" upper="90"'),
            "did you mean -115 deg = -2.01 rad?",
        ),
        (
            ('axis xyz="0 1 0"', 'axis xyz="0 0 0"'),
            "joint 'joint_2': <axis xyz='0 0 0'> has no direction",
        ),
        (
            ('mass value="2.0"', 'mass value="-2.0"'),
            "<mass value='-2.0'> must not be negative: give the mass",
        ),
        (
            ('mass value="2.0"', 'mass value="2,0"'),
            "link 'link_2': <mass value='2,0'> must be a number",
        ),
        (
            ('velocity="2"', 'velocity="-2"'),
            "joint 'joint_2': velocity=-2 must not be negative",
        ),
        (
            ('xyz="0.3 0 0.0"', 'xyz="300 0 0"'),
            "m long, expected 0.01 to 100 m; lengths of a URDF are in m, not in mm",
        ),
        (('xyz="0.3 0 0', 'xyz="0.00003 0 0'), "the arm is 0.000"),
    ],
)
def test_implausible_input_is_refused_with_a_remedy(tmp_path, capsys, change, message):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    first, *others = urdf.read_text().split('<link name="link_2">')
    tail = '<link name="link_2">' + "".join(others)
    whole = "0.00003" in change[1]
    urdf.write_text(
        (first + tail).replace(*change).replace('0.3"', '0.00003"')
        if whole
        else first + tail.replace(*change)
    )
    assert message in refused(capsys, 2, tmp_path / "arm", "--urdf", urdf)


@pytest.mark.parametrize(
    ("mesh", "scale", "message"),
    [
        (
            "claw.obj",
            "1000 1000 1000",
            "link 'claw': its collision geometry is 60 m large, the arm 1.02 m",
        ),
        (
            "wedge.stl",
            "1 1 1",
            "link 'fore': its collision geometry is 250 m large, the arm 1.02 m",
        ),
    ],
)
def test_meshes_in_millimetres_are_refused_with_a_remedy(
    tmp_path, capsys, mesh, scale, message
):
    urdf = write_crane(tmp_path)
    text = re.sub(
        rf'{mesh}"( scale="[^"]*")?', f'{mesh}" scale="{scale}"', urdf.read_text()
    )
    urdf.write_text(text)
    said = refused(capsys, 2, tmp_path / "arm", "--urdf", urdf, "--tip", "hand")
    assert message in said
    assert 'write scale="0.001 0.001 0.001" in the <mesh> of a file in mm' in said


def test_findings_are_printed_as_notes(tmp_path, capsys):
    continuous = ("continuous", "0 0 1", '<limit velocity="0" effort="20"/>')
    urdf = write_arm(tmp_path / "arm.urdf", [continuous, *ELBOW[1:]], mass=0)
    assert main(["init", str(tmp_path / "arm"), "--urdf", str(urdf)]) == 0
    notes = [
        line.removeprefix("note: ")
        for line in capsys.readouterr().err.splitlines()
        if line.startswith("note: ")
    ]
    assert notes[0] == "the tip is end; planned joints: joint_1, joint_2, joint_3"
    assert any(
        note.startswith(
            "the URDF has no position limit of joint_1, or the joint is cont"
        )
        for note in notes
    )
    assert any(
        note.startswith(
            "the URDF has no velocity limit of joint_1, or it is zero: [limits]"
        )
        for note in notes
    )
    assert any(note.startswith("no mass that the last joint moves") for note in notes)


def test_limits_of_many_turns_stand_for_none(tmp_path, capsys):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    urdf.write_text(
        urdf.read_text().replace(
            'lower="-2" upper="2"', 'lower="-1e16" upper="1e16"', 1
        )
    )
    assert main(["init", str(tmp_path / "arm"), "--urdf", str(urdf)]) == 0
    assert "the URDF has no position limit of joint_1" in capsys.readouterr().err


def test_a_urdf_in_the_place_of_an_srdf_and_the_reverse_are_named(tmp_path, capsys):
    urdf, srdf = write_crane(tmp_path), tmp_path / "crane.srdf"
    srdf.write_text(
        '<robot name="crane"><disable_collisions link1="hand" link2="base"/></robot>'
    )
    arm = tmp_path / "arm"
    said = refused(capsys, 2, arm, "--urdf", urdf, "--tip", "hand", "--srdf", urdf)
    assert "is a URDF, expected an SRDF" in said
    assert "has no <link>, expected a URDF (an SRDF is given by --srdf)" in refused(
        capsys, 2, arm, "--urdf", srdf
    )


def test_inertias_that_no_body_has_are_noted(tmp_path):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    urdf.write_text(urdf.read_text().replace('ixx="0.01"', 'ixx="0.05"', 1))
    assert main(["init", str(tmp_path / "arm"), "--urdf", str(urdf)]) == 0
    assert (
        "no body has the <inertia> of link_1: a principal inertia is negative"
        in head_of(tmp_path / "arm/problem.toml")
    )


def test_meshes_that_are_tiny_are_refused_with_a_remedy(tmp_path, capsys):
    tiny = {link: [] for link in LINKS} | {
        "claw": [
            '<geometry><mesh filename="meshes/claw.obj" scale="1e-3 1e-3 1e-3"/></geometry>'
        ]
    }
    urdf = write_crane(tmp_path, tiny)
    said = refused(capsys, 2, tmp_path / "arm", "--urdf", urdf, "--tip", "hand")
    assert re.search(
        r"no moving link is larger than 6e-05 m, where the arm is 1.02 m long; remove the scale",
        said,
    )


def test_without_masses_and_shapes_their_constraints_are_left_out(tmp_path):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW, mass=0.0)
    assert main(["init", str(tmp_path / "light"), "--urdf", str(urdf)]) == 0
    problem = load_problem(tmp_path / "light" / "problem.toml")
    assert [type(each).__name__ for each in problem.constraint] == [
        "JointPosition",
        "JointVelocity",
        "JointAcceleration",
        "JointJerk",
    ]
    assert idle_keys(problem) == {}
    text = (tmp_path / "light" / "problem.toml").read_text(encoding="utf-8")
    assert "'joint-torque' is left out" in text
    assert "'self-clearance' is left out" in text


@pytest.mark.slow
def test_an_arm_of_sliding_joints_has_boxes_within_its_reach(tmp_path):
    slide = '<limit lower="0" upper="1" velocity="1" effort="200"/>'
    urdf = write_arm(
        tmp_path / "gantry.urdf",
        [("prismatic", axis, slide) for axis in ("1 0 0", "0 1 0", "0 0 1")],
    )
    assert main(["init", str(tmp_path / "gantry"), "--urdf", str(urdf)]) == 0
    goal = (
        load_dataset_recipe(tmp_path / "gantry" / "dataset.toml").pipeline.stage[0].goal
    )
    assert goal[1].low > 0
    text = (tmp_path / "gantry" / "problem.toml").read_text(encoding="utf-8")
    units = next(line for line in text.splitlines() if "[m/s]" in line)
    assert re.findall(r"\[.*?\]", units) == ["[m]", "[m/s]", "[N]"]


def test_the_urdf_and_packages_are_named_from_the_recipes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots").mkdir()
    write_arm(tmp_path / "robots" / "arm.urdf", ELBOW)
    (tmp_path / "meshes").mkdir()
    assert (
        main(
            ["init", "recipes/arm", "--urdf", "robots/arm.urdf", "--packages", "meshes"]
        )
        == 0
    )
    robot = load_problem(tmp_path / "recipes" / "arm" / "problem.toml").robot
    assert (robot.urdf, robot.packages) == ("../../robots/arm.urdf", ("../../meshes",))


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_packages_that_the_environment_names_are_written_down(
    tmp_path, monkeypatch, variable
):
    urdf = write_crane(tmp_path / "share")
    (tmp_path / "robots").mkdir()
    moved = tmp_path / "robots" / "crane.urdf"
    moved.write_text(
        urdf.read_text().replace('"meshes/claw', '"package://crane/meshes/claw')
    )
    of_ros = variable == "ROS_PACKAGE_PATH"
    monkeypatch.setenv(variable, str(tmp_path / "share") if of_ros else str(tmp_path))
    assert (
        main(
            ["init", str(tmp_path / "my-crane"), "--urdf", str(moved), "--tip", "hand"]
        )
        == 0
    )
    monkeypatch.delenv(variable)
    problem = load_problem(tmp_path / "my-crane" / "problem.toml")
    assert problem.robot.packages == ("../share",)
    assert load_robot(problem).shape is not None


def test_a_package_that_is_nowhere_is_refused_with_how_to_name_it(
    tmp_path, capsys, monkeypatch
):
    for variable in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(variable, raising=False)
    urdf = write_crane(tmp_path / "share")
    moved = tmp_path / "crane.urdf"
    moved.write_text(urdf.read_text())
    said = refused(capsys, 2, tmp_path / "my-crane", "--urdf", moved, "--tip", "hand")
    assert "package://crane/meshes/wedge.stl" in said
    assert "--packages of 'cnpgen init'" in said


def refused(capsys: pytest.CaptureFixture[str], code: int, *words: object) -> str:
    assert main(["init", *map(str, words)]) == code
    return capsys.readouterr().err


def test_a_frame_that_is_not_there_is_refused_with_all_that_are(tmp_path, capsys):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    said = refused(capsys, 2, tmp_path / "arm", "--urdf", urdf, "--tip", "ends")
    assert (
        "--tip: arm.urdf has no frame 'ends' (did you mean 'end'?); its frames: link_0, link_1, link_2, link_3, end,"
        in said
    )
    assert not (tmp_path / "arm").exists()


def test_several_links_that_carry_none_are_listed(tmp_path, capsys):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    camera = '<link name="camera"/><joint name="holder" type="fixed"><parent link="link_3"/><child link="camera"/></joint>'
    urdf.write_text(urdf.read_text().replace("</robot>", f"{camera}</robot>"))
    said = refused(capsys, 2, tmp_path / "arm", "--urdf", urdf)
    assert (
        "--tip must name the tip frame of arm.urdf: 2 links have no child: end, camera"
        in said
    )


def test_a_frame_that_nothing_moves_is_refused(tmp_path, capsys):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    assert "no joint moves the frame 'link_0'" in refused(
        capsys, 2, tmp_path / "arm", "--urdf", urdf, "--tip", "link_0"
    )


def test_xacro_is_refused(tmp_path, capsys):
    xacro = tmp_path / "arm.urdf.xacro"
    xacro.write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="x"/></robot>'
    )
    said = refused(capsys, 2, tmp_path / "arm", "--urdf", xacro)
    assert (
        "is to be read by xacro, expected a URDF: run 'xacro arm.urdf.xacro > robot.urdf'"
        in said
    )


def test_a_file_that_is_missing_or_no_urdf_is_refused(tmp_path, capsys):
    assert "no such file" in refused(
        capsys, 2, tmp_path / "arm", "--urdf", tmp_path / "none.urdf"
    )
    (tmp_path / "text.urdf").write_text("no XML")
    assert "it is not XML" in refused(
        capsys, 2, tmp_path / "arm", "--urdf", tmp_path / "text.urdf"
    )


def test_joints_in_a_circle_are_refused(tmp_path, capsys):
    joint = '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/></joint>'
    circle = joint.format("one", "a", "b") + joint.format("two", "b", "a")
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="r"><link name="a"/><link name="b"/>{circle}</robot>'
    )
    said = refused(
        capsys, 2, tmp_path / "arm", "--urdf", tmp_path / "arm.urdf", "--tip", "a"
    )
    assert "its joints form a cycle" in said


@pytest.mark.slow
def test_a_tip_that_reaches_no_box_is_refused(tmp_path, capsys):
    pan_tilt = [("revolute", "0 0 1", LIMIT), ("revolute", "0 1 0", LIMIT)]
    urdf = write_arm(tmp_path / "arm.urdf", pan_tilt)
    said = refused(capsys, 2, tmp_path / "arm", "--urdf", urdf)
    assert "the tip reaches less than 2 % of every box of positions near" in said
    assert (
        load_problem(tmp_path / "arm" / "problem.toml").name == "arm"
    )  # the problem is written none the less


def test_an_arm_of_one_joint_is_looked_at_like_any_other(tmp_path, capsys):
    """Its Jacobian has one column, which Pinocchio gives as a vector."""
    write_arm(tmp_path / "one.urdf", [("revolute", "0 0 1", LIMIT)])
    assert (
        main(
            [
                "init",
                str(tmp_path / "one"),
                "--urdf",
                str(tmp_path / "one.urdf"),
                "--tip",
                "end",
            ]
        )
        == 2
    )
    assert (
        "the tip reaches less than 2 % of every box of positions"
        in capsys.readouterr().err
    )


def test_files_that_are_there_are_written_over_only_by_force(tmp_path, capsys):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "pipeline.toml").write_text("mine")
    assert "exists already: --force writes over it" in refused(
        capsys, 2, tmp_path / "arm", "--urdf", urdf
    )
    assert (tmp_path / "arm" / "pipeline.toml").read_text() == "mine"
    assert main(["init", str(tmp_path / "arm"), "--urdf", str(urdf), "--force"]) == 0
    assert resolved(load_dataset_recipe(tmp_path / "arm" / "dataset.toml"))[
        "splits"
    ] == {
        "train": 18000,
        "validation": 2000,
    }


def test_a_name_that_no_recipe_may_have_is_refused(tmp_path, capsys):
    urdf = write_arm(tmp_path / "arm.urdf", ELBOW)
    assert "NAME must be lower-case letters" in refused(
        capsys, 2, tmp_path / "My Arm", "--urdf", urdf
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (Range(0.1, 2.0), "[0.1, 2.0]"),
        (PerJoint((1.0,)), "1.0"),
        (PerJoint((1.0, 2.0)), "[1.0, 2.0]"),
        ((Range(0.0, 1.0), Range(2.0, 2.0)), "[[0.0, 1.0], [2.0, 2.0]]"),
        (('a "b"', "c"), '["a \\"b\\"", "c"]'),
        ({"train": 9, "validation": 1}, "{ train = 9, validation = 1 }"),
        (1e-6, "1e-06"),
        (7, "7"),
        (None, ""),
        ((), ""),
    ],
)
def test_a_value_is_written_as_toml_reads_it(value, text):
    assert toml(value) == text
    if text:
        tomllib.loads(f"key = {text}")


def test_the_template_of_a_planner_runs_in_the_benchmark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", "my-line", "--planner"]) == 0
    assert capsys.readouterr().out.split() == [
        "my-line/pyproject.toml",
        "my-line/my_line.py",
    ]
    settings = tomllib.loads(Path("my-line/pyproject.toml").read_text())["project"]
    entry_points = settings["entry-points"]["cnpgen.planners"]
    assert entry_points == {"my-line": "my_line:MyLine"}
    with installed_kind(
        tmp_path / "my-line", "my-line", entry_points["my-line"], monkeypatch
    ):
        for suite in ("hits-81", "heavy-100"):
            benchmark = run_benchmark(
                suite, tmp_path / suite, planners=["my-line"], n=1
            )
            (row,) = benchmark.results["my-line"]
            assert row["ending"] == "planned", row["error"]
            verdict = row["verdict"]
            assert verdict["severity"]["joint velocity"] <= 1
            assert verdict["severity"]["joint torque"] <= 1
            assert suite != "hits-81" or verdict["severity"]["table height"] <= 1
    assert main(["init", "my-line", "--planner"]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["init", "my-line", "--planner", "--force"]) == 0


def test_an_arm_and_a_planner_exclude_each_other(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["init", "mine", "--planner", "--urdf", str(IIWA)]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["init", "mine"]) == 2
    assert_said(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("dynamics", "choice"),
    [
        (("1", "0.5", "0.1"), "use"),
        (("1", "1", "1"), "ignore"),  # one pair for all joints
        (("1", "0.5", "400"), "ignore"),  # more than the effort of a joint
    ],
)
def test_the_choice_about_friction_of_the_urdf_is_written_with_its_shares(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    dynamics: tuple[str, ...],
    choice: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    limit = '<limit lower="-2" upper="2" velocity="1" effort="100"/>'
    soft = (
        '<safety_controller soft_lower_limit="-1" soft_upper_limit="1" k_velocity="9"/>'
    )
    joints = [
        ("revolute", axis, f'{limit}<dynamics damping="{value}"/>{soft}')
        for axis, value in zip(("0 0 1", "0 1 0", "0 1 0"), dynamics, strict=True)
    ]
    urdf = write_arm(tmp_path / "arm.urdf", joints)
    assert main(["init", "made", "--urdf", str(urdf)]) == 0
    written = capsys.readouterr()
    assert f'[drive] has urdf_dynamics = "{choice}"' in written.err
    assert "soft limits of the URDF narrow the position limits: joint_1 [-1, 1]" in (
        written.err
    )
    text = (tmp_path / "made" / "problem.toml").read_text()
    assert tomllib.loads(text)["drive"] == {"urdf_dynamics": choice}
    assert tomllib.loads(text)["version"] == 2
    robot = load_robot(load_problem(tmp_path / "made" / "problem.toml"))
    assert (robot.drive is not None) == (choice == "use")
    np.testing.assert_allclose(robot.position_upper, 1)
    assert main(["show", str(tmp_path / "made" / "problem.toml")]) == 0
    shown = capsys.readouterr().out
    judged = {
        "use": "rigid body and drives, limits on both sides",
        "ignore": "rigid body",
    }
    assert f"  torque: {judged[choice]}\n" in shown
    assert ("friction of the URDF that is not used" in shown) == (choice == "ignore")
