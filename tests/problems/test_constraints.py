"""Every kind of constraint: its symbolic form against its measurement, and a met and a violated case of each."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.problems.conditions import measured_needs, symbolic_needs
from cnpgen.problems.constraints.axis import Axis, Vertical
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import (
    BOUNDARY_TOLERANCES,
    Condition,
    Constraint,
)
from cnpgen.problems.constraints.joint import (
    JointAcceleration,
    JointJerk,
    JointPosition,
    JointTorque,
    JointVelocity,
    TipSpeed,
)
from cnpgen.problems.constraints.link_clearance import ObjectClearance, SelfClearance
from cnpgen.problems.constraints.plane import Line, Plane
from cnpgen.problems.constraints.pose import Pose
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.robot_spec import LimitSpec, RobotSpec
from cnpgen.robots.solid import pose_width
from cnpgen.schema.keys import Range
from cnpgen.schema.registry import CONSTRAINTS, load, names
from cnpgen.world.world import World
from tests.examples.constraints import TipSpeed as SpeedOfPlugin
from tests.examples.shipped import PROBLEMS
from tests.refusals import is_refused

# Three sliding axes, a turn about z and a lean about x: what it holds is upright unless it leans.
GANTRY_JOINTS = [
    ("slide_x", "prismatic", "0 0 3", "1 0 0"),
    ("slide_y", "prismatic", "0 0 0", "0 1 0"),
    ("slide_z", "prismatic", "0 0 -1.6", "0 0 1"),
    ("turn", "revolute", "0 0 -0.2", "0 0 1"),
    ("lean", "revolute", "0 0 -0.3", "1 0 0"),
    ("grip", "fixed", "0 0 -0.25", "1 0 0"),
]


def gantry_urdf() -> str:
    parts = ['<robot name="gantry"><link name="world"/>']
    parent = "world"
    for name, kind, xyz, axis in GANTRY_JOINTS:
        inertia = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'
        parts.append(
            f'<link name="{name}_link"><inertial><mass value="2"/>{inertia}</inertial></link>'
        )
        parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{name}_link"/>'
        )
        parts.append(f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>')
        parts.append('<limit lower="-1" upper="1" velocity="1" effort="200"/></joint>')
        parent = f"{name}_link"
    return "".join([*parts, "</robot>"])


@pytest.fixture(scope="module")
def gantry(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return gantry_problem(tmp_path_factory.mktemp("gantry"))


def gantry_problem(folder: Path) -> Problem:
    (folder / "gantry.urdf").write_text(gantry_urdf())
    joints = tuple(name for name, kind, *_ in GANTRY_JOINTS if kind != "fixed")
    spec = RobotSpec(
        urdf="gantry.urdf", joints=joints, tip="grip_link", base=(0.0,) * 5
    )
    constraints = tuple(
        item
        for item in PROBLEMS["heavy-object"].constraint
        if not isinstance(item, ObjectClearance)
    )
    path = folder / "problem.toml"
    return replace(
        PROBLEMS["heavy-object"],
        name="gantry",
        robot=spec,
        limits=LimitSpec(),
        constraint=constraints,
        path=path,
    )


class Bench:
    """A problem's robot with both views of it: the world, and a constraint's symbolic forms as CasADi functions."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.robot = problem, load_robot(problem)
        self.world = World(self.robot, problem.obstacle, problem.object_size)

    def state(
        self, q: Any, dq: Any = 0.0, ddq: Any = 0.0, obstacle_poses: Any = -5.0
    ) -> World:
        n, m = self.robot.n, pose_width(self.problem.obstacle)
        self.world.set_state(
            *(np.broadcast_to(x, n).astype(float) for x in (q, dq, ddq)),
            np.broadcast_to(obstacle_poses, m) * 1.0,
        )
        return self.world

    def random_state(self, random: np.random.Generator) -> list[np.ndarray]:
        robot = self.robot
        q = random.uniform(robot.position_lower, robot.position_upper)
        return [
            q,
            random.normal(size=robot.n),
            5 * random.normal(size=robot.n),
            random.uniform(-0.2, 0.8, len(self.problem.obstacle)),
        ]

    def symbolic(
        self, constraint: Constraint
    ) -> tuple[ca.Function, list[tuple[Condition, ...]]]:
        columns = [symbols(name, self.robot.n) for name in ("q", "dq", "ddq")] + [
            symbols("obstacle_poses", len(self.problem.obstacle))
        ]
        (q, dq, ddq, obstacle_poses), size = (
            [scalars for _, scalars in columns],
            self.problem.object,
        )
        state = SymbolicState(
            self.robot,
            q,
            dq,
            ddq,
            obstacle_poses,
            self.problem.obstacle,
            size.size if size else None,
        )
        forms = [
            constraint.symbolic(state),
            *(constraint.symbolic_at(state, end) for end in ("start", "goal")),
        ]
        outputs = [
            ca.vertcat(*(g for condition in form for g in condition.g))
            for form in forms
        ]
        return ca.Function("forms", [column for column, _ in columns], outputs), forms


@pytest.fixture(scope="module")
def benches(gantry: Problem) -> dict[str, Bench]:
    return {
        problem.name: Bench(problem)
        for problem in (PROBLEMS["airhockey"], PROBLEMS["heavy-object"], gantry)
    }


KINDS = {
    "joint-position": JointPosition(tolerance=1e-3),
    "joint-velocity": JointVelocity(tolerance=1e-3),
    "joint-acceleration": JointAcceleration(tolerance=1e-2),
    "joint-torque": JointTorque(tolerance=0.1),
    "table": Table(
        x=Range(0.6, 2.0),
        y=Range(-0.45, 0.45),
        z=0.16,
        start_band=0.005,
        tolerance=1e-3,
    ),
    "plane": Plane(
        point=(0.5, 0.1, 0.3),
        normal=(1, 2, -2),
        along=(1, 0, 0),
        u=Range(-0.3, 0.4),
        v=Range(-0.1, 0.2),
        tolerance=1e-3,
    ),
    "line": Line(
        point=(0.5, 0.1, 0.3),
        direction=(1, -2, 2),
        piece=Range(-0.3, 0.4),
        tolerance=1e-3,
    ),
    "vertical": Vertical(tolerance=0.01),
    "axis": Axis(axis=(0, 1, 1), direction=(0.5, 0, -1), tolerance=0.01),
    "pose": Pose(
        rpy=(0.3, -0.2, 1.0), x=Range(0.4, 0.4), z=Range(0.1, 0.5), tolerance=0.01
    ),
    "tip-speed": TipSpeed(limit=0.25, tolerance=0.01),
    "robot-clearance": RobotClearance(radius=0.14, tolerance=1e-3),
    "object-contact": ObjectContact(depth=1e-3, tolerance=1e-3),
}


def forms_of(constraint: Constraint) -> list[Callable[[World], tuple[Condition, ...]]]:
    return [
        constraint.measured,
        *(partial(constraint.measured_at, end=end) for end in ("start", "goal")),
    ]


def measured_forms(constraint: Constraint, world: World) -> list[tuple[Condition, ...]]:
    return [form(world) for form in forms_of(constraint)]


def values(form: tuple[Condition, ...]) -> np.ndarray:
    return np.array([g for condition in form for g in condition.g], float)


def test_every_shipped_kind_is_tested_here():
    built_in = [
        name
        for name in names(CONSTRAINTS)
        if load(CONSTRAINTS, name).__module__.startswith("cnpgen.problems.")
    ]
    elsewhere = {  # own files
        "self-clearance": SelfClearance,
        "object-clearance": ObjectClearance,
        "joint-jerk": JointJerk,
        "puck-contact": PuckContact,
    }
    kinds = {name: type(kind) for name, kind in KINDS.items()} | elsewhere
    assert {name: load(CONSTRAINTS, name) for name in built_in} == kinds


@pytest.mark.parametrize("name", [name for name in KINDS if name != "object-contact"])
@pytest.mark.parametrize("problem", ["airhockey", "heavy-object", "gantry"])
def test_symbolic_form_agrees_with_the_measurement(benches, problem, name):
    bench, random = benches[problem], np.random.default_rng(4)
    if name == "robot-clearance" and not bench.problem.obstacle:
        bench = Bench(
            replace(bench.problem, obstacle=PROBLEMS["heavy-object"].obstacle)
        )
    function, _ = bench.symbolic(KINDS[name])
    for _ in range(40):
        state = bench.random_state(random)
        found = [np.array(value).ravel() for value in function(*state)]
        bench.world.set_state(*state)
        for symbolic, measured in zip(
            found, measured_forms(KINDS[name], bench.world), strict=True
        ):
            np.testing.assert_allclose(
                symbolic, values(measured), rtol=1e-12, atol=1e-9
            )


def test_symbolic_contact_of_an_upright_object_agrees_with_the_measurement(benches):
    bench, random = benches["gantry"], np.random.default_rng(5)
    function, _ = bench.symbolic(KINDS["object-contact"])
    overlapping = 0
    for _ in range(300):
        q, dq, ddq, obstacle_poses = bench.random_state(random)
        q[:2], q[4] = (random.uniform(0.1, 0.7), random.uniform(-0.7, 0.7)), 0.0
        found = [
            np.array(value).ravel() for value in function(q, dq, ddq, obstacle_poses)
        ]
        bench.world.set_state(q, dq, ddq, obstacle_poses)
        for symbolic, measured in zip(
            found, measured_forms(KINDS["object-contact"], bench.world), strict=True
        ):
            expected = values(measured)
            np.testing.assert_allclose(
                np.minimum(symbolic, 0.0), np.minimum(expected, 0.0), atol=1e-9
            )
            assert np.all(
                symbolic <= expected + 1e-9
            )  # separation: along a face normal, not the distance
        overlapping += np.any(expected < 0)
    assert overlapping > 50


@pytest.mark.parametrize("name", list(KINDS))
def test_both_forms_state_the_same_conditions(benches, name):
    bench = benches["heavy-object"]
    _, forms = bench.symbolic(KINDS[name])
    for symbolic, measured in zip(
        forms, measured_forms(KINDS[name], bench.state(0.1)), strict=True
    ):
        for a, b in zip(symbolic, measured, strict=True):
            assert (a.name, a.unit, a.tolerance_kind, len(a.g)) == (
                b.name,
                b.unit,
                b.tolerance_kind,
                len(b.g),
            )
            np.testing.assert_array_equal(a.lower, b.lower)
            np.testing.assert_array_equal(a.upper, b.upper)
            assert len(a.g) == len(a.lower) == len(a.upper)
            assert a.tolerance_kind in BOUNDARY_TOLERANCES["float64"]


HIGHEST = {  # the highest derivative of q that the conditions of a kind depend on, at its ends where these are others
    "joint-position": [0],
    "joint-velocity": [1],
    "joint-acceleration": [2],
    "joint-torque": [2],
    "table": [0, 0, 1, 2],
    "plane": [0, 0, 1, 2],
    "line": [0, 0, 1, 2],
    "vertical": [0, 0],
    "axis": [0, 0, 1, 2],
    "pose": [0, 0, 0, 0, 1, 2, 1, 2],
    "tip-speed": [1],
    "robot-clearance": [0],
    "object-contact": [0],
    "of a plug-in": [1],
}


@pytest.mark.parametrize("name", HIGHEST)
def test_what_conditions_depend_on_is_found_out_from_both_forms(benches, name):
    bench, kind = (
        benches["heavy-object"],
        {**KINDS, "of a plug-in": SpeedOfPlugin()}[name],
    )
    (_, q), (dq_sx, dq), (ddq_sx, ddq) = (
        symbols(what, bench.robot.n) for what in ("q", "dq", "ddq")
    )
    obstacle_poses, box = (
        symbols("obstacle_poses", len(bench.problem.obstacle))[1],
        bench.problem.object,
    )
    state = SymbolicState(
        bench.robot, q, dq, ddq, obstacle_poses, bench.problem.obstacle, box.size
    )
    assert [
        symbolic_needs(each, dq_sx, ddq_sx) for each in kind.symbolic_at(state, "start")
    ] == HIGHEST[name]
    assert (
        measured_needs([partial(kind.measured_at, end="start")], bench.world)
        == HIGHEST[name]
    )
    assert (
        measured_needs([kind.measured], bench.world)
        == HIGHEST[name][: len(kind.measured(bench.world))]
    )


@pytest.mark.parametrize("name", list(KINDS))
def test_conditions_depend_on_no_higher_derivative_than_was_found(benches, name):
    bench, random = benches["heavy-object"], np.random.default_rng(6)
    needs = measured_needs(forms_of(KINDS[name]), bench.world)
    q, dq, ddq, obstacle_poses = bench.random_state(random)
    forms = []
    for order in (2, 1, 0):
        bench.world.set_state(
            q,
            dq if order > 0 else 0 * dq,
            ddq if order > 1 else 0 * ddq,
            obstacle_poses,
        )
        forms.append(
            [c for form in measured_forms(KINDS[name], bench.world) for c in form]
        )
    for full, no_ddq, still, need in zip(*forms, needs, strict=True):
        if need < 2:
            assert full.g == no_ddq.g
        if need < 1:
            assert full.g == still.g
        else:
            assert full.g != still.g


def test_a_value_that_is_no_number_anywhere_depends_on_nothing(benches):
    world = benches["airhockey"].world
    bound = np.zeros(1)
    lost = Condition("lost", "m", [np.nan], bound, bound, "position")
    assert measured_needs(
        [lambda _: (lost,), lambda w: (replace(lost, g=[w.ddq[0]]),)], world
    ) == [0, 2]
    swallowed = [
        lambda w: (replace(lost, g=[np.nan_to_num(w.dq[1])]),),
        lambda w: (
            replace(
                lost,
                g=[
                    float(
                        np.where(
                            np.abs(w.ddq[0]) > 1.5 * w.robot.acceleration_limit[0], 1, 0
                        )
                    )
                ],
            ),
        ),
        lambda w: (replace(lost, g=[np.fmax(w.q[0], 0.0)]),),
    ]
    assert measured_needs(swallowed, world) == [1, 2, 0]


# --- met and violated -------------------------------------------------------------------------------------------------


def out_of_bounds(form: tuple[Condition, ...]) -> dict[str, float]:
    """Conditions that a float64 boundary state must not break, and by how much it does."""
    broken = {}
    for condition in form:
        g = np.array(condition.g, float)
        excess = np.maximum(condition.lower - g, g - condition.upper)
        if np.any(excess > condition.tolerance("float64")):
            broken[condition.name] = condition.violation()
    return broken


def expect(
    constraint: Constraint,
    world: World,
    broken: dict[str, float],
    *,
    at: tuple[str, ...] = ("motion", "start", "goal"),
) -> None:
    forms = dict(
        zip(("motion", "start", "goal"), measured_forms(constraint, world), strict=True)
    )
    for level in at:
        found = out_of_bounds(forms[level])
        assert found == pytest.approx(broken, rel=1e-6, abs=1e-9), level


def test_joint_position_is_met_on_the_limit_and_violated_outside(benches):
    bench = benches["airhockey"]
    upper, lower = bench.robot.position_upper, bench.robot.position_lower
    expect(KINDS["joint-position"], bench.state(upper), {})
    expect(KINDS["joint-position"], bench.state(lower), {})
    expect(
        KINDS["joint-position"],
        bench.state(upper + 1e-3 * (np.arange(6) == 2)),
        {"joint position": 1e-3},
    )
    expect(
        KINDS["joint-position"],
        bench.state(lower - [0, 2e-6, 0, 0, 0, 1e-6]),
        {"joint position": 2e-6},
    )


@pytest.mark.parametrize(
    ("name", "what"), [("velocity", "dq"), ("acceleration", "ddq")]
)
def test_joint_rates_are_met_on_the_limit_and_violated_outside(benches, name, what):
    bench = benches["airhockey"]
    limit = getattr(bench.robot, f"{name}_limit")
    kind, sign = KINDS[f"joint-{name}"], np.array([1, -1, 1, -1, 1, -1])
    expect(kind, bench.state(bench.robot.home, **{what: limit * sign}), {})
    expect(
        kind,
        bench.state(bench.robot.home, **{what: sign * limit + [0, -1e-3, 0, 0, 0, 0]}),
        {f"joint {name}": 1e-3},
    )
    over = limit * (1 + 1e-9)
    expect(
        kind,
        bench.state(bench.robot.home, **{what: over}),
        {f"joint {name}": 1e-9 * limit.max()},
    )


def test_joint_torque_is_met_at_rest_and_violated_by_a_hard_acceleration(benches):
    bench = benches["heavy-object"]
    model, limit, q = bench.robot.model, bench.robot.torque_limit, np.full(7, 0.3)
    expect(KINDS["joint-torque"], bench.state(q), {})
    mass = pin.crba(model, model.createData(), q)
    gravity = pin.rnea(model, model.createData(), q, np.zeros(7), np.zeros(7))
    wanted = np.where(np.arange(7) == 3, -limit, 0.0)
    expect(
        KINDS["joint-torque"],
        bench.state(q, ddq=np.linalg.solve(mass, wanted * (1 - 1e-9) - gravity)),
        {},
    )
    expect(
        KINDS["joint-torque"],
        bench.state(q, ddq=np.linalg.solve(mass, wanted * 1.01 - gravity)),
        {"joint torque": 0.01 * limit[3]},
    )


def at_tip(robot: Robot, target: list[float]) -> np.ndarray:
    """Solve ``FK(q) = target`` from the base configuration."""
    model, data, q = robot.model, robot.model.createData(), robot.home.copy()
    frame, local = model.getFrameId(robot.tip), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for _ in range(50):
        jacobian = pin.computeFrameJacobian(model, data, q, frame, local)[:3]
        q += np.linalg.pinv(jacobian) @ (
            np.array(target) - pin.updateFramePlacement(model, data, frame).translation
        )
    return q


def vertical_gain(bench: Bench, q: np.ndarray) -> np.ndarray:
    model, local = bench.robot.model, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    return pin.computeFrameJacobian(
        model, model.createData(), q, model.getFrameId(bench.robot.tip), local
    )[2]


def test_table_is_met_on_its_edge_and_violated_beside_it(benches):
    bench, table = benches["airhockey"], KINDS["table"]
    expect(table, bench.state(at_tip(bench.robot, [0.7, 0.45, 0.16])), {})
    expect(
        table,
        bench.state(at_tip(bench.robot, [0.6 - 1e-6, 0.1, 0.16])),
        {"table rectangle": 1e-6},
    )
    expect(
        table,
        bench.state(at_tip(bench.robot, [0.8, -0.46, 0.16])),
        {"table rectangle": 0.01},
    )
    expect(
        table,
        bench.state(at_tip(bench.robot, [0.8, 0.1, 0.16 - 1e-6])),
        {"table height": 1e-6},
        at=("motion", "goal"),
    )


def test_a_motion_may_start_in_the_band_above_and_below_the_table(benches):
    bench, table = benches["airhockey"], KINDS["table"]
    for offset in (-0.005, 0.005):
        world = bench.state(at_tip(bench.robot, [0.8, 0.1, 0.16 + offset]))
        expect(table, world, {}, at=("start",))
        expect(table, world, {"table height": 0.005}, at=("motion", "goal"))
    expect(
        table,
        bench.state(at_tip(bench.robot, [0.8, 0.1, 0.166])),
        {"table height": 0.001},
        at=("start",),
    )


def test_tip_must_move_along_the_table_at_both_ends(benches):
    bench, table = benches["airhockey"], KINDS["table"]
    q = at_tip(bench.robot, [0.8, 0.1, 0.16])
    gain = vertical_gain(bench, q)
    lift = gain / (gain @ gain)  # lifts the tip by 1
    dq = np.linspace(-1, 1, 6) - lift * (gain @ np.linspace(-1, 1, 6))
    bias = bench.state(q, dq).tip_acceleration[2]
    expect(table, bench.state(q, dq, -lift * bias), {})
    expect(
        table,
        bench.state(q, dq, lift * (1e-6 - bias)),
        {"vertical acceleration": 1e-6},
        at=("start", "goal"),
    )
    expect(
        table,
        bench.state(q, 1e-6 * lift),
        {"vertical velocity": 1e-6},
        at=("start", "goal"),
    )
    expect(table, bench.state(q, 1e-6 * lift), {}, at=("motion",))


def test_vertical_is_met_by_an_upright_object_and_violated_by_a_lean(benches):
    bench, vertical = benches["gantry"], KINDS["vertical"]
    expect(vertical, bench.state([0.3, -0.2, 0.1, 0.7, 0.0]), {})
    expect(vertical, bench.state([0.3, -0.2, 0.1, 0.0, 1e-6]), {"tilt": 1e-6})
    expect(vertical, bench.state([0.3, -0.2, 0.1, 0.0, np.pi]), {"upright": 1.0})


def test_a_plane_across_z_is_the_table_and_an_axis_along_z_is_vertical(benches):
    bench, random = benches["airhockey"], np.random.default_rng(8)
    table = KINDS["table"]
    plane = Plane(
        point=(0, 0, 0.16),
        normal=(0, 0, 2),
        along=(3, 0, 0),
        u=table.x,
        v=table.y,
        start_band=0.005,
        tolerance=1,
    )
    for kind, case in ((plane, table), (Axis(tolerance=0.1), KINDS["vertical"])):
        for _ in range(5):
            world = bench.state(*bench.random_state(random)[:3])
            for general, special in zip(
                measured_forms(kind, world), measured_forms(case, world), strict=True
            ):
                for one, other in zip(
                    general, special, strict=False
                ):  # an axis that is held rests at the ends, too
                    assert one.g == other.g
                    np.testing.assert_array_equal(
                        (one.lower, one.upper), (other.lower, other.upper)
                    )


def test_a_plane_is_met_in_its_rectangle_and_violated_off_it(benches):
    bench = benches["gantry"]
    tip = bench.state([0.3, -0.2, 0.1, 0.0, 0.0]).tip_position
    normal, along = np.array([1.0, 2.0, -2.0]) / 3, np.array([2.0, 1.0, 2.0]) / 3

    def plane(at: np.ndarray) -> Plane:
        low, high = Range(-0.1, 0.2), Range(0.0, 0.3)
        return Plane(
            point=tuple(at),
            normal=(1, 2, -2),
            along=tuple(along),
            u=low,
            v=high,
            tolerance=1e-3,
        )

    expect(plane(tip), bench.world, {})
    expect(plane(tip + 0.1 * along), bench.world, {})
    expect(plane(tip + (0.1 + 1e-6) * along), bench.world, {"plane rectangle": 1e-6})
    expect(
        plane(tip + 1e-6 * np.cross(normal, along)),
        bench.world,
        {"plane rectangle": 1e-6},
    )
    expect(plane(tip - 0.02 * normal), bench.world, {"plane distance": 0.02})
    bench.state(
        [0.3, -0.2, 0.1, 0.0, 0.0], dq=[1e-3, 0, 0, 0, 0], ddq=[0, 0, 3e-3, 0, 0]
    )
    ends = {
        "velocity across the plane": 1e-3 / 3,
        "acceleration across the plane": 2e-3,
    }
    expect(plane(tip), bench.world, ends, at=("start", "goal"))
    expect(plane(tip), bench.world, {}, at=("motion",))


def test_a_line_is_met_on_its_piece_and_violated_beside_it(benches):
    bench = benches["gantry"]
    tip = bench.state([0.3, -0.2, 0.1, 0.0, 0.0], dq=[0, 2e-3, 0, 0, 0]).tip_position
    line = Line(
        point=tuple(tip), direction=(0, 2, 0), piece=Range(0.0, 0.1), tolerance=1e-3
    )
    expect(line, bench.world, {})
    expect(
        replace(line, point=(tip[0], tip[1] + 1e-6, tip[2])),
        bench.world,
        {"line piece": 1e-6},
    )
    expect(
        replace(line, point=(tip[0] + 1e-6, tip[1], tip[2] - 3e-6)),
        bench.world,
        {"line distance": 3e-6},
    )
    across = {"velocity across the line": 2e-3}
    expect(
        replace(line, direction=(1, 0, 0)), bench.world, across, at=("start", "goal")
    )


def test_an_axis_is_met_along_its_direction_or_within_its_angle_and_violated_outside(
    benches,
):
    bench, lean = benches["gantry"], np.array([0.3, -0.2, 0.1, 0.0, 0.2])
    leaning = Axis(direction=(0, -np.sin(0.2), np.cos(0.2)), tolerance=0.01)
    expect(leaning, bench.state(lean), {})
    expect(Axis(tolerance=0.01), bench.state(lean), {"tilt": np.sin(0.2)})
    expect(Axis(angle=0.2, tolerance=0.01), bench.state(lean), {})
    expect(
        Axis(angle=0.19, tolerance=0.01),
        bench.state(lean),
        {"tilt cosine": np.cos(0.19) - np.cos(0.2)},
    )
    expect(
        Axis(direction=(0, 0, -1), tolerance=0.01),
        bench.state([0.3, -0.2, 0.1, 0, 0]),
        {"upright": 1.0},
    )
    turning = bench.state(lean, dq=[0, 0, 0, 0, 0.3], ddq=[0, 0, 0, 0, -2.0])
    expect(
        leaning,
        turning,
        {"tilt rate": 0.3, "tilt acceleration": 2.0},
        at=("start", "goal"),
    )
    about_itself = bench.state(
        [0.3, -0.2, 0.1, 0.4, 0.0], dq=[1, 2, 3, 0.3, 0], ddq=[0, 0, 0, 5, 0]
    )
    expect(Axis(tolerance=0.01), about_itself, {})


def test_a_pose_is_met_in_its_orientation_and_box_and_violated_outside(benches):
    bench = benches["gantry"]
    world = bench.state([0.3, -0.2, 0.1, 0.4, 0.2])
    roll, pitch, yaw = pin.rpy.matrixToRpy(world.tip_rotation)
    x, _, z = world.tip_position
    pose = Pose(
        rpy=(roll, pitch, yaw), x=Range(x, x), z=Range(z - 0.1, z), tolerance=1e-3
    )
    expect(pose, world, {})
    expect(replace(pose, x=Range(x + 1e-6, x + 1e-6)), world, {"pose position": 1e-6})
    expect(replace(pose, z=Range(z + 1e-6, z + 1)), world, {"pose box": 1e-6})
    aside = pin.rpy.matrixToRpy(
        world.tip_rotation @ pin.rpy.rpyToMatrix(0.0, 0.01, 0.0)
    )
    expect(replace(pose, rpy=tuple(aside)), world, {"orientation": np.sin(0.01)})
    behind = pin.rpy.matrixToRpy(
        world.tip_rotation @ pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0)
    )
    expect(replace(pose, rpy=tuple(behind)), world, {"less than a quarter turn": 1.0})
    turning = bench.state(
        [0.3, -0.2, 0.1, 0.4, 0.2], dq=[0, 1, 0, 0.3, 0], ddq=[0, 0, 1, 0, 0]
    )
    expect(replace(pose, x=None), turning, {"turning": 0.3}, at=("start", "goal"))
    sliding = bench.state(
        [0.3, -0.2, 0.1, 0.4, 0.2], dq=[2.0, 1, 0, 0, 0], ddq=[3.0, 0, 1, 0, 0]
    )
    out = {"velocity out of the pose": 2.0, "acceleration out of the pose": 3.0}
    expect(pose, sliding, out, at=("start", "goal"))


def test_the_speed_of_the_tip_is_met_at_its_limit_and_violated_above(benches):
    bench, slow = benches["gantry"], TipSpeed(limit=0.5, tolerance=0.01)
    expect(slow, bench.state(0.1, dq=[0.3, 0.4, 0, 0, 0]), {})
    expect(
        slow, bench.state(0.1, dq=[0.3, 0.41, 0, 0, 0]), {"tip speed": 0.41**2 - 0.4**2}
    )
    (condition,) = slow.measured(bench.world)
    assert slow.allowed(condition) == pytest.approx([0.51**2 - 0.5**2])


@pytest.mark.parametrize(
    ("kind", "given", "message"),
    [
        (
            Plane,
            {"point": (0, 0, 0), "normal": (0, 0, 0)},
            r"normal must be a direction, which \(0, 0, 0\) is not",
        ),
        (
            Plane,
            {"point": (0, 0, 0), "normal": (0, 0, 1), "along": (0, 0, 3)},
            "along, seen in the plane, must be a dir",
        ),
        (
            Plane,
            {"point": (0, 0, 0), "normal": (0, 0, 1), "u": Range(0, 1)},
            "u and v need a direction in the plane",
        ),
        (
            Line,
            {"point": (0, 0, 0), "direction": (0, np.nan, 0)},
            "direction must be a direction",
        ),
        (Axis, {"axis": (0, 0, 0)}, "axis must be a direction"),
    ],
)
def test_directions_that_are_none_are_refused(
    kind: type[Constraint], given: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        kind(**given, tolerance=0.1)


def test_robot_clearance_is_met_at_the_radius_and_violated_closer(benches):
    bench, clearance = benches["gantry"], KINDS["robot-clearance"]
    high = [
        0.4,
        -0.45,
        1.0,
        0.3,
        0.0,
    ]  # the tip is 1.65 m above the world, over the first pedestal
    expect(clearance, bench.state(high, obstacle_poses=[1.65 - 0.14, -5.0]), {})
    expect(
        clearance,
        bench.state(high, obstacle_poses=[1.65 - 0.14 + 1e-6, -5.0]),
        {"robot clearance": 1e-6},
    )
    expect(
        clearance,
        bench.state(high, obstacle_poses=[1.8, -5.0]),
        {"robot clearance": 0.14 + 0.15},
    )


def test_object_contact_is_met_by_touching_and_violated_by_entering_deeper(benches):
    bench, contact = benches["gantry"], KINDS["object-contact"]
    high = [0.4, -0.45, 1.0, 0.3, 0.0]
    bottom = 1.65 - 0.15
    expect(contact, bench.state(high, obstacle_poses=[bottom, -5.0]), {})
    expect(contact, bench.state(high, obstacle_poses=[bottom + 1e-3, -5.0]), {})
    expect(
        contact,
        bench.state(high, obstacle_poses=[bottom + 1e-3 + 1e-6, -5.0]),
        {"object contact": 1e-6},
    )
    expect(
        contact,
        bench.state(high, obstacle_poses=[bottom + 0.05, -5.0]),
        {"object contact": 0.049},
    )


# --- conditions -------------------------------------------------------------------------------------------------------


def condition(
    g: list[float],
    lower: list[float],
    upper: list[float],
    tolerance_kind: str = "limit",
) -> Condition:
    return Condition(
        "test", "1", g, np.array(lower, float), np.array(upper, float), tolerance_kind
    )


def test_violation_is_the_worst_excess():
    assert condition([1.0, 2.0], [0.0, -np.inf], [1.0, 1.5]).violation() == 0.5
    assert condition([0.5], [0.0], [np.inf]).violation() == 0.0


def test_what_is_no_number_is_an_infinite_violation():
    assert condition([np.nan, 0.0], [0.0, 0.0], [1.0, 1.0]).violation() == np.inf


def test_tolerances_of_limits_are_relative_and_others_absolute():
    np.testing.assert_allclose(
        condition([0.0, 0.0], [-300.0, -0.5], [100.0, np.inf]).tolerance("float64"),
        [3e-10, 1e-12],
    )
    np.testing.assert_array_equal(
        condition([0.0], [-300.0], [300.0], "velocity").tolerance("float32"), [1e-5]
    )


# --- what a motion may do that a boundary state may not
# ----------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(KINDS.keys() - {"tip-speed"}))
def test_tolerance_of_a_motion_is_absolute_or_a_fraction_of_the_limit(benches, name):
    kind = KINDS[name]
    for condition in kind.judged(benches["heavy-object"].state(0.1)):
        fraction = name in {"joint-velocity", "joint-acceleration", "joint-torque"}
        expected = (
            kind.tolerance * condition.upper
            if fraction
            else np.full(len(condition.g), kind.tolerance)
        )
        np.testing.assert_array_equal(kind.allowed(condition), expected)


def test_the_verdict_limits_the_angle_of_a_tilt_and_not_its_components(benches):
    world = benches["heavy-object"].state(benches["heavy-object"].robot.home)
    tilted = pin.exp3(np.deg2rad(1.6) * np.array([1.0, 1.0, 0.0]))[
        :, 2
    ]  # 2.26 deg, 1.6 deg about x and about y
    aligned = Axis(
        direction=tuple(world.tip_rotation @ tilted), tolerance=np.deg2rad(1.8)
    )
    (angle,) = aligned.judged(world)
    assert np.rad2deg(angle.g[0]) == pytest.approx(1.6 * np.sqrt(2), rel=1e-6)
    assert angle.violation() > aligned.allowed(angle)[0]
    components, _ = aligned.measured(world)
    assert np.linalg.norm(aligned.allowed(components)) == pytest.approx(
        aligned.tolerance
    )


def test_the_time_varying_bound_admits_only_motions_down_to_the_table(benches):
    s, start = np.array([0.0, 0.1, 0.2, 0.3, 1.0]), np.array([0.8, 0.1, 0.157])
    rectangle, height = KINDS["table"].measured(
        benches["airhockey"].state(benches["airhockey"].robot.home)
    )
    np.testing.assert_allclose(
        KINDS["table"].bound_relaxation(height, s, start),
        [0.003, 0.003, 0.0015, 0.0, 0.0],
        atol=1e-15,
    )
    far = np.array(
        [[0.8, 0.1, 0.36], [0.8, 0.1, 0.1], [0.8, 0.1, 0.163]]
    )  # no further than start_band
    widths = np.array([[5e-3], [5e-3], [3e-3]]) * [1.0, 1.0, 0.5, 0.0, 0.0]
    np.testing.assert_allclose(
        KINDS["table"].bound_relaxation(height, s, far), widths, atol=1e-15
    )
    for name, kind in KINDS.items():
        for condition in (
            kind.measured(benches["heavy-object"].state(0.1))
            if name != "table"
            else (rectangle,)
        ):
            np.testing.assert_array_equal(
                kind.bound_relaxation(condition, s, start), np.zeros(5)
            )


@pytest.mark.parametrize(("constraint", "expected"), [
    (RobotClearance(tolerance=1e-3), 1e-4),
    (RobotClearance(tolerance=1e-3, distance=5e-4), 6e-4),
    (RobotClearance(tolerance=1e-3, distance=2e-3), 1e-3),
    (RobotClearance(tolerance=1e-2, radius=0.14), 1e-2),  # the paper's capsules are not the links
    (SelfClearance(tolerance=1e-3), 1e-4),
    (SelfClearance(tolerance=1e-3, distance=2e-3), 1e-3),
])  # fmt: skip
def test_tolerances_of_clearances_permit_no_penetration_of_links(constraint, expected):
    condition = Condition(
        "clearance", "m", [0.0, 0.0], np.zeros(2), np.full(2, np.inf), "position"
    )
    np.testing.assert_allclose(constraint.allowed(condition), expected, rtol=1e-12)


def test_a_condition_of_an_unknown_kind_of_tolerance_is_refused() -> None:
    with is_refused(ValueError):
        Condition("speed", "m/s", [0.0], np.zeros(1), np.ones(1), "speed")
