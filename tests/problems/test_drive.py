"""Drives: envelope of friction, symbolic and measured forms, limits on both sides, keys and the URDF's friction."""

import warnings
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import RecipeError
from cnpgen.judges.plans.plan_plot import shares_of_limits
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.stages.torque import torque_ratio
from cnpgen.problems.constraints.joint import JointTorque, judged_torque
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.problems.robot_model import RobotModel
from cnpgen.robots.drive import NO_DRIVE, Drive, DriveLine, DriveSpec
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import PerJoint
from cnpgen.world.drive import friction_bounds
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.refusals import is_refused

URDFS = Path(__file__).parents[1] / "data" / "urdf"
TORQUE = JointTorque(tolerance=5e-3)
PEAK_SPEED = 1.875 * 2 / 1.9  # rad/s, of a quintic of 2 rad in 1.9 s
LINES: dict[str, object] = {
    "line": (
        DriveLine(torque=PerJoint((150.0,)), speed=PerJoint((6.0,))),
        DriveLine(
            torque=PerJoint((300.0,)), speed=PerJoint((2.5,)), quadrants="motoring"
        ),
    ),
    "power": PerJoint((90.0, 80.0, 70.0, 60.0, 50.0, 40.0, 30.0)),
}
ARM = """
name = "arm"
[robot]
urdf = "{urdf}"
joints = ["j1", "j2", "j3", "j4"]
tip = "tool"
base = [0, 0.2, -0.6, 0]
geometry = "paper-capsules"
[limits]
{limits}
{drive}
[[constraint]]
use = "joint-position"
tolerance = 1e-3
[[constraint]]
use = "joint-velocity"
tolerance = 2e-3
[[constraint]]
use = "joint-acceleration"
tolerance = 5e-3
[[constraint]]
use = "joint-torque"
tolerance = 5e-3
"""


def arm(
    folder: Path, drive: str = "", urdf: str = "damping", limits: str = ""
) -> Problem:
    """The arm of a URDF of the tests."""
    file = folder / "problem.toml"
    path = URDFS / f"{urdf}.urdf"
    file.write_text(ARM.format(urdf=path, drive=drive, limits=limits))
    return load_problem(file)


def heavy(**changes: object) -> tuple[Problem, Robot]:
    problem = load_problem("heavy-object-drive")
    problem = replace(problem, drive=replace(problem.drive, **changes))
    return problem, load_robot(problem)


def drive_of(n: int, random: np.random.Generator, share: float) -> Drive:
    """Random drives; some joints have no dry or no viscous friction."""
    b, c = random.uniform(0, 2, (2, n)) * (random.uniform(size=(2, n)) > 0.2)
    rotors = random.uniform(0, 3, n)
    return Drive(rotors, b, c, share, 0.05, "both", np.full(n, 100.0))


def states(robot: Robot, count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Random states; half of the velocities are near or at a reversal."""
    random = np.random.default_rng(seed)
    q = random.uniform(robot.position_lower, robot.position_upper, (count, robot.n))
    dq = random.uniform(-1, 1, (count, robot.n)) * robot.velocity_limit
    slow = random.uniform(size=dq.shape) < 0.5
    dq = np.where(slow, random.uniform(-0.1, 0.1, dq.shape), dq)
    dq[::7] = 0.0
    ddq = random.uniform(-1, 1, dq.shape) * robot.acceleration_limit
    return q, dq, ddq


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_every_friction_that_may_act_is_inside_the_envelope(share: float) -> None:
    random = np.random.default_rng(1)
    drive = drive_of(8, random, share)
    dq = random.uniform(-3, 3, (8, 100_000))
    dq[:, 1::2] *= 0.02  # inside the band of the reversal speed
    dq[:, :1000] = 0.0
    sign = np.where(dq == 0, random.uniform(-1, 1, dq.shape), np.sign(dq))
    exact = drive.viscous[:, None] * dq + drive.coulomb[:, None] * sign
    acting = exact * random.uniform(share, 1, dq.shape)
    acting[:, ::3] = exact[:, ::3]  # all of it
    low, high = friction_bounds(drive, dq)
    rounding = 1e-12
    assert (low <= acting + rounding).all()
    assert (acting <= high + rounding).all()
    far = np.abs(dq) > drive.reversal_speed  # there the envelope is close
    width = drive.viscous[:, None] * drive.reversal_speed + rounding
    loose = np.where(dq > 0, high - exact, exact - low)
    assert (loose[far] <= np.broadcast_to(width, dq.shape)[far]).all()


def test_the_envelope_has_continuous_second_derivatives() -> None:
    drive = replace(drive_of(1, np.random.default_rng(0), 0.3), coulomb=np.ones(1))
    v = np.linspace(-0.2, 0.2, 40_001)[None]
    for bound in friction_bounds(drive, v):
        second = np.diff(bound[0], 2) / (v[0, 1] - v[0, 0]) ** 2
        assert np.abs(np.diff(second)).max() < 1e-2 * np.ptp(second)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize(
    ("limits", "more"), [("both", {}), ("joint", {}), ("motor", {}), ("both", LINES)]
)
def test_symbolic_and_measured_torques_agree(
    share: float, limits: str, more: dict[str, object]
) -> None:
    _, robot = heavy(friction_help=share, limits=limits, **more)
    columns, state = SymbolicState.of_symbols(robot, (), None, 0)
    conditions = TORQUE.symbolic(state)
    function = ca.Function("g", columns, [ca.vertcat(*each.g) for each in conditions])
    world, path = World(robot), PathWorld(robot)
    q, dq, ddq = states(robot, 40)
    path.set_path(q.T, dq.T, ddq.T, np.empty(0))
    along = TORQUE.measured(path)  # type: ignore[arg-type]
    expected = {"both": 3, "joint": 1, "motor": 2}[limits] + 5 * bool(more)
    assert len(conditions) == len(along) == expected
    for k, moving in enumerate(zip(q, dq, ddq, strict=True)):
        world.set_state(*moving, np.empty(0))
        symbolic = function(*moving, np.empty(0))
        symbolic = symbolic if expected > 1 else [symbolic]
        symbolic = [each.full() for each in symbolic]
        for one, other, many in zip(
            symbolic, TORQUE.measured(world), along, strict=True
        ):
            np.testing.assert_allclose(np.ravel(one), other.g, atol=1e-9)
            np.testing.assert_allclose([g[k] for g in many.g], other.g, atol=1e-9)


def test_rotors_and_friction_are_those_of_pinocchio_and_the_exact_law() -> None:
    _, robot = heavy(friction_help=1.0)
    drive, model = robot.drive, robot.model.copy()
    assert drive is not None
    np.testing.assert_allclose(drive.armature[[0, 4]], [3.38176, 1.321])
    model.armature = drive.armature
    world, data = World(robot), model.createData()
    for q, dq, ddq in zip(*states(robot, 200, seed=3), strict=True):
        world.set_state(q, dq, ddq, np.empty(0))
        low, high = world.motor_torque
        exact = pin.rnea(model, data, q, dq, ddq) + drive.viscous * dq
        np.testing.assert_allclose(world.linear_torque, exact, atol=1e-9)
        exact = exact + drive.coulomb * np.sign(dq)
        fast = np.abs(dq) > drive.reversal_speed
        np.testing.assert_allclose(low[fast], exact[fast], atol=1e-9)
        np.testing.assert_allclose(high[fast], exact[fast], atol=1e-9)
        assert (low <= exact + 1e-9).all()
        assert (exact <= high + 1e-9).all()


def motor_ratio(robot: Robot, torque: np.ndarray, dq: np.ndarray) -> float:
    """Largest share of the limits of motors that a torque uses, from their definitions (problems with LINES)."""
    limit = 0.8 * np.array([320, 320, 176, 176, 110, 40, 40])
    slow, fast = 0.8 * 150 * (1 - np.abs(dq) / 6), 0.8 * 300 * (1 - np.abs(dq) / 2.5)
    power = 0.8 * np.array([90, 80, 70, 60, 50, 40, 30])
    assert robot.drive is not None
    np.testing.assert_allclose(robot.drive.torque_limit, limit)
    driving = np.where(torque * dq > 0, np.abs(torque), 0.0)
    ratios = [
        np.abs(torque) / limit,
        np.where(slow > 0, np.abs(torque) / slow, np.inf),
        np.where(driving == 0, 0.0, np.where(fast > 0, driving / fast, np.inf)),
        torque * dq / power,
    ]
    return float(np.max(ratios))


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_lines_and_powers_bound_every_torque_that_may_act(share: float) -> None:
    """A state within the conditions is within lines and powers with any friction; far from a reversal also conversely."""
    _, robot = heavy(friction_help=share, limits="motor", **LINES)
    drive, model, random = robot.drive, robot.model.copy(), np.random.default_rng(4)
    assert drive is not None
    model.armature = drive.armature
    world, data, met = World(robot), model.createData(), [0, 0]
    every = states(robot, 3000, seed=5)
    slower = every[0], 0.6 * every[1], 0.2 * every[2]  # both verdicts occur
    for q, dq, ddq in zip(*slower, strict=True):
        world.set_state(q, dq, ddq, np.empty(0))
        rotors = pin.rnea(model, data, q, dq, ddq)
        within = all(each.violation() <= 0 for each in TORQUE.measured(world))
        sign = np.where(dq == 0, random.uniform(-1, 1, 7), np.sign(dq))
        exact = drive.viscous * dq + drive.coulomb * sign
        ratios = [
            motor_ratio(robot, rotors + part * exact, dq)
            for part in (share, random.uniform(share, 1, 7), 1.0)
        ]
        met[within] += 1
        if within:
            assert max(ratios) <= 1 + 1e-9
        elif share == 1 and (np.abs(dq) > drive.reversal_speed).all():
            # The second line bounds torques that brake, too, by more than its torque.
            line = np.abs(rotors + exact) - drive.lines[1].slope * np.abs(dq)
            assert max(ratios) > 1 or (line > drive.lines[1].torque).any()
    assert min(met) > 100


def test_lines_and_powers_are_part_of_the_record_and_of_resting_limits() -> None:
    problem, robot = heavy(**LINES)
    again, same = open_problem(record_problem(problem))
    assert again.drive == problem.drive
    drive = same.drive
    assert drive is not None
    np.testing.assert_allclose(drive.lines[0].slope, 0.8 * 150 / 6)
    assert same.drive is not None
    left = np.minimum(0.8 * 150, drive.torque_limit) - drive.resting_friction
    np.testing.assert_allclose(
        robot.holding_limit, np.minimum(robot.torque_limit, left)
    )
    text = "both sides, 2 torque-speed lines, power"
    assert judged_torque(problem.constraint, robot).endswith(text)
    plain, _ = heavy()
    assert not {"line", "power"} & record_problem(plain).content["drive"].keys()


def test_lines_alone_make_a_drive(tmp_path: Path) -> None:
    text = '[drive]\nurdf_dynamics = "ignore"\n'
    line = '[[drive.line]]\ntorque = "60 N m"\nspeed = ["40 rpm", "3 rad/s", 3, 3]\n'
    drive = load_robot(arm(tmp_path, text + line)).drive
    assert drive is not None
    assert not drive.uncertain_rows
    np.testing.assert_allclose(
        drive.lines[0].torque / drive.lines[0].slope, [40 * np.pi / 30, 3, 3, 3]
    )
    power = load_robot(arm(tmp_path, text + 'power = "0.2 kW"')).drive
    assert power is not None
    np.testing.assert_array_equal(power.power_limit, 200.0)


def test_derivatives_of_motor_torques_are_differences_across_the_reversal() -> None:
    _, robot = heavy(friction_help=0.3, **LINES)
    columns, state = SymbolicState.of_symbols(robot, (), None, 0)
    rows = ca.vertcat(*(g for each in TORQUE.symbolic(state) for g in each.g))
    g = ca.Function("g", columns, [rows])
    jacobian = ca.Function("j", columns, [ca.jacobian(rows, columns[1])])
    q, dq, ddq = (values[:10] for values in states(robot, 20, seed=5))
    h = 1e-6
    for moving in zip(q, dq, ddq, strict=True):
        expected = jacobian(*moving, np.empty(0)).full()
        for joint, step in enumerate(h * np.eye(robot.n)):
            ends = [
                g(moving[0], moving[1] + sign * step, moving[2], []).full()
                for sign in (1, -1)
            ]
            difference = np.ravel(ends[0] - ends[1]) / (2 * h)
            np.testing.assert_allclose(expected[:, joint], difference, atol=1e-4)


def test_friction_at_rest_leaves_less_to_hold_the_arm() -> None:
    _, robot = heavy()
    drive = robot.drive
    assert drive is not None
    ratio = torque_ratio(robot)
    world, still = World(robot), np.zeros(robot.n)
    for q in states(robot, 20, seed=7)[0]:
        world.set_state(q, still, still, np.empty(0))
        bounds = [
            np.abs(np.array(each.g)) / each.upper for each in TORQUE.measured(world)
        ]
        within = bool(np.concatenate(bounds).max() <= 1)
        assert (float(ratio(q)) <= 1) == within
    left = robot.torque_limit - drive.coulomb - drive.viscous * drive.reversal_speed
    np.testing.assert_allclose(robot.holding_limit, left)


def test_joints_without_friction_have_one_row_and_names_by_joint() -> None:
    _, robot = heavy(
        coulomb=PerJoint((1.0, 0, 0, 0, 0, 0, 2.0)), viscous=PerJoint((0,))
    )
    joint, highest, lowest = TORQUE.measured(World(robot))
    assert (len(joint.g), len(highest.g)) == (7, 7)
    assert lowest.parts == ("joint_1", "joint_7")
    assert lowest.unit == "N m"
    assert highest.name != lowest.name


def test_a_problem_that_ignores_friction_is_the_same_problem(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"j4 \(damping 15 .* 265% of effort"):
        unstated = arm(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ignored = arm(tmp_path, '[drive]\nurdf_dynamics = "ignore"')
    assert ignored.identity == unstated.identity
    assert ignored.structure == unstated.structure
    assert record_problem(ignored).recipe == record_problem(unstated).recipe
    assert "drive" not in record_problem(ignored).content
    robot = load_robot(ignored)
    assert robot.drive is None
    assert judged_torque(ignored.constraint, robot) == "rigid body"


def test_a_file_of_version_2_must_say_what_to_do_with_the_friction(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.warns(UserWarning, match="friction of the URDF is ignored"):
        unstated = arm(tmp_path)
    ignored = arm(tmp_path, '[drive]\nurdf_dynamics = "ignore"')
    file = tmp_path / "problem.toml"
    file.write_text("version = 2\n" + file.read_text())
    assert load_problem(file).identity == unstated.identity == ignored.identity
    assert record_problem(load_problem(file)).comparable_sha256 == (
        record_problem(unstated).comparable_sha256
    )
    text = file.read_text().replace('urdf_dynamics = "ignore"', "armature = 0.5")
    file.write_text(text)
    assert main(["show", str(file)]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "drive.urdf_dynamics: missing; the URDF has " in error
    assert "j4 (damping 15" in error
    assert 'write urdf_dynamics = "use" or "ignore" in [drive]' in error
    file.write_text(text.replace("version = 2", "version = 3"))
    assert main(["show", str(file)]) == 2


def test_the_record_of_a_problem_keeps_its_drives(tmp_path: Path) -> None:
    problem = arm(tmp_path, '[drive]\nurdf_dynamics = "use"\narmature = 0.5')
    again, robot = open_problem(record_problem(problem))
    assert again.drive == problem.drive != NO_DRIVE
    assert robot.drive is not None
    np.testing.assert_array_equal(robot.drive.viscous, 15.0)
    np.testing.assert_array_equal(robot.drive.armature, 0.5)
    assert problem.identity != arm(tmp_path, '[drive]\nurdf_dynamics = "use"').identity
    text = judged_torque(again.constraint, robot)
    assert text == "rigid body and drives, limits on both sides"


@pytest.mark.parametrize(
    ("help_", "expected"), [("0", 38.25), ("1", 37.5)], ids=["never helps", "exact"]
)
def test_friction_of_the_urdf_counts_if_it_is_used(
    tmp_path: Path, help_: str, expected: float
) -> None:
    drive = f'[drive]\nurdf_dynamics = "use"\nfriction_help = {help_}'
    robot = load_robot(arm(tmp_path, drive))
    world = World(robot)
    q = np.array([0.0, 0.2, -0.6, 0.0])
    world.set_state(q, np.array([0, 0, 0, PEAK_SPEED]), np.zeros(4), np.empty(0))
    rigid = float(world.torque[3])
    _, high = world.motor_torque
    friction = 15 * PEAK_SPEED + 8 + (0.75 if help_ == "0" else 0)
    assert high[3] - rigid == pytest.approx(friction)
    assert high[3] == pytest.approx(expected, abs=0.05)
    assert high[3] > robot.torque_limit[3] == 20.0


def test_stated_friction_replaces_that_of_the_urdf(tmp_path: Path) -> None:
    drive = '[drive]\nurdf_dynamics = "use"\ncoulomb = [1, 2, 3, 4]'
    found = load_robot(arm(tmp_path, drive)).drive
    assert found is not None
    np.testing.assert_array_equal(found.coulomb, [1, 2, 3, 4])
    np.testing.assert_array_equal(found.viscous, 15.0)


@pytest.mark.parametrize(
    ("drive", "text"),
    [
        ("gear_ratio = 100", "'rotor_inertia' and 'gear_ratio' determine the armature"),
        ("rotor_inertia = 1e-4", "give both, or 'armature'"),
        (
            "rotor_inertia = 1e-4\ngear_ratio = 100\narmature = 1",
            "is also given by 'rotor_inertia'",
        ),
        ("armature = [1, 2]", "drive.armature: needs one number, or 4"),
        ("armature = -1", "armature"),
        ("coulomb = -1", "coulomb"),
        ('viscous = "1 N m"', "expected a viscous friction"),
        ("reversal_speed = 0.001", "reversal_speed"),
        ("friction_help = 2", "friction_help"),
        ("friction_help = 0.5", "drive.friction_help: there is no friction"),
        ('limits = "motors"', "limits"),
        ("coulomb = 20", "j4: friction of 20 N m at rest leaves nothing of the motor"),
        ("power = 0", "power"),
        ('power = "5 N m"', "expected a power"),
        ('limits = "joint"\npower = 9', "power: limits motors, but 'limits' is"),
        ("[[drive.line]]\ntorque = 30", "drive.line 1.speed: missing key"),
        (
            "[[drive.line]]\ntorque = [1, 2]\nspeed = 1",
            "drive.line 1.torque: needs one",
        ),
        ("coulomb = 4\n[[drive.line]]\ntorque = 4\nspeed = 9", "j1: friction of 4 N m"),
        ("inertia = 1", "unknown key"),
    ],
)
def test_wrong_drives_are_named(tmp_path: Path, drive: str, text: str) -> None:
    stated = f'[drive]\nurdf_dynamics = "ignore"\n{drive}'
    with pytest.raises(RecipeError, match=text.replace("[", r"\[")):
        load_robot(arm(tmp_path, stated))


def test_motors_may_have_limits_of_their_own(tmp_path: Path) -> None:
    stated = '[drive]\nurdf_dynamics = "ignore"\ntorque = [50, 60, 30, 10]'
    robot = load_robot(arm(tmp_path, stated, limits="torque_scale = 0.5"))
    joint, highest = TORQUE.measured(World(robot))
    np.testing.assert_allclose(joint.upper, [50, 60, 30, 10])
    np.testing.assert_allclose(highest.upper, [25, 30, 15, 5])


def test_soft_limits_narrow_the_position_limits(tmp_path: Path) -> None:
    robot = load_robot(arm(tmp_path, urdf="soft-limits"))
    np.testing.assert_allclose(robot.position_lower, [-1, -1, -2.2, -1.8])
    np.testing.assert_allclose(robot.position_upper, [1, 1, 2.2, 1.8])
    world = World(robot)
    still = np.zeros(4)
    world.set_state(np.array([1.6, 0.2, -0.6, 0]), still, still, np.empty(0))
    (position,) = arm(tmp_path, urdf="soft-limits").constraint[0].measured(world)
    assert position.violation() == pytest.approx(0.6)
    hard = load_robot(arm(tmp_path, urdf="soft-limits", limits='soft = "ignore"'))
    np.testing.assert_allclose(hard.position_upper, [3, 2, 2.2, 1.8])
    ranges = "position = [[-2, 2], [-2, 2], [-2, 2], [-1.5, 1.5]]"
    stated = load_robot(arm(tmp_path, urdf="soft-limits", limits=ranges))
    np.testing.assert_allclose(stated.position_upper, [2, 2, 2, 1.5])


def changed(folder: Path, old: str, new: str) -> str:
    """A copy of the soft-limited arm with another text, as the name of a URDF."""
    text = (URDFS / "soft-limits.urdf").read_text()
    assert old in text
    (folder / "changed.urdf").write_text(text.replace(old, new, 1))
    return str(folder / "changed")


@pytest.mark.parametrize(
    ("soft", "upper"),
    [
        ('soft_lower_limit="0" soft_upper_limit="0"', 3.0),
        ('soft_upper_limit="0.5"', 0.5),
        ('soft_lower_limit="-5" soft_upper_limit="5"', 3.0),
    ],
    ids=["both zero", "one absent", "wider"],
)
def test_soft_limits_that_are_zero_or_absent_are_none(
    tmp_path: Path, soft: str, upper: float
) -> None:
    old = 'soft_lower_limit="-1.0" soft_upper_limit="1.0"'
    robot = load_robot(arm(tmp_path, urdf=changed(tmp_path, old, soft)))
    assert robot.position_upper[0] == upper
    assert robot.position_lower[0] == -3.0


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('soft_lower_limit="-1.0"', 'soft_lower_limit="2"', "swapped"),
        (
            'soft_lower_limit="-1.0" soft_upper_limit="1.0"',
            'soft_lower_limit="4" soft_upper_limit="5"',
            "leave nothing of its limits",
        ),
        (
            "<safety_controller",
            '<dynamics damping="-1"/><safety_controller',
            "must not be negative",
        ),
        (
            "<safety_controller",
            '<dynamics damping="1"/><dynamics damping="2"/><safety_controller',
            "a second <dynamics> in <joint>",
        ),
        ('velocity="2"', 'velocity="2" acceleration="-4"', "must not be negative"),
    ],
)
def test_wrong_elements_of_joints_are_named(
    tmp_path: Path, old: str, new: str, text: str
) -> None:
    with pytest.raises(RecipeError, match=text):
        load_robot(arm(tmp_path, urdf=changed(tmp_path, old, new)))


def test_accelerations_and_jerks_of_a_urdf_bound_the_defaults(tmp_path: Path) -> None:
    new = 'velocity="2" acceleration="4" deceleration="3" jerk="9"'
    urdf = changed(tmp_path, 'velocity="2"', new)
    robot = load_robot(arm(tmp_path, urdf=urdf))
    np.testing.assert_allclose(robot.acceleration_limit, [3, 20, 20, 20])
    np.testing.assert_allclose(robot.jerk_limit, [9, 100, 100, 100])
    stated = load_robot(arm(tmp_path, urdf=urdf, limits="acceleration = 10\njerk = 70"))
    np.testing.assert_allclose(stated.acceleration_limit, 10)
    np.testing.assert_allclose(stated.jerk_limit, 70)


def test_specs_without_terms_are_no_drives(tmp_path: Path) -> None:
    problem = replace(
        arm(tmp_path, urdf="soft-limits"), drive=DriveSpec(limits="motor")
    )
    assert load_robot(problem).drive is None


def test_the_robot_model_computes_the_same_torques() -> None:
    problem, robot = heavy()
    model, world = RobotModel(problem, backend="numpy"), World(robot)
    q, dq, ddq = states(robot, 10, seed=9)
    low, high = model.motor_torque(q, dq, ddq)
    for k, moving in enumerate(zip(q, dq, ddq, strict=True)):
        world.set_state(*moving, np.empty(0))
        np.testing.assert_allclose(
            np.array([low[k], high[k]]), world.motor_torque, atol=1e-9
        )
    rigid = RobotModel("heavy-object", backend="numpy")
    for each in rigid.motor_torque(q, dq, ddq):
        np.testing.assert_array_equal(each, rigid.inverse_dynamics(q, dq, ddq))


def test_plots_show_torques_of_both_sides() -> None:
    for limits, names in (
        ("both", {"torque", "motor torque"}),
        ("motor", {"motor torque"}),
        ("joint", {"torque"}),
    ):
        _, robot = heavy(limits=limits)
        path = PathWorld(robot)
        q, dq, ddq = states(robot, 5)
        path.set_path(q.T, dq.T, ddq.T, np.empty(0))
        shares = shares_of_limits(path)
        assert {name for name in shares if "torque" in name} == names
        if limits == "motor":
            low, high = path.motor_torque
            largest = np.maximum(np.abs(low), np.abs(high))
            assert robot.drive is not None
            expected = largest / robot.drive.torque_limit[:, None]
            np.testing.assert_allclose(np.abs(shares["motor torque"]), expected)


@pytest.mark.parametrize(
    "limit", ["power = 1", "torque = 5", "[[drive.line]]\ntorque = 5\nspeed = 3"]
)
def test_limits_of_motors_need_a_constraint_that_applies_them(
    tmp_path: Path, limit: str
) -> None:
    arm(tmp_path, '[drive]\nurdf_dynamics = "ignore"')
    file = tmp_path / "problem.toml"
    text = file.read_text().replace('use = "joint-torque"', 'use = "joint-velocity"')
    file.write_text(text.replace('"ignore"', f'"ignore"\n{limit}'))
    with is_refused(RecipeError):
        load_problem(file)
