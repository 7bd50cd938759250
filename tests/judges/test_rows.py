"""Verification of rows: valid rows pass, and every corruption is reported under its name and in its row only."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
import scipy

from cnpgen.errors import DatasetError, RecipeError
from cnpgen.judges.rows import verify as rows_module
from cnpgen.judges.rows.hits import highest_speed
from cnpgen.judges.rows.row_report import Check, RowReport, merge
from cnpgen.judges.rows.verify import verify_rows
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import scene_of
from cnpgen.robots.robot import Robot
from cnpgen.robots.solid import solids_of
from cnpgen.world.collision_world import CollisionWorld
from cnpgen.world.world import World
from tests.examples.shipped import PROBLEMS
from tests.refusals import is_refused

Columns = dict[str, np.ndarray]
ROWS = 6
WORLD_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


# --- valid rows, made with Pinocchio and NumPy ------------------------------------------------------------------------


def jacobian(robot: Robot, q: np.ndarray) -> np.ndarray:
    frame = robot.model.getFrameId(robot.tip)
    return pin.computeFrameJacobian(
        robot.model, robot.model.createData(), q, frame, WORLD_ALIGNED
    )


def tip_pose(robot: Robot, q: np.ndarray) -> pin.SE3:
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(robot.tip)]


def inverse_kinematics(
    robot: Robot, q: np.ndarray, xyz: np.ndarray, *, upright: bool
) -> np.ndarray | None:
    """Solve for the tip position and optionally a vertical z axis by Newton's method; None outside the joint limits."""
    for _ in range(60):
        pose, J = tip_pose(robot, q), jacobian(robot, q)
        error, rows = xyz - pose.translation, J[:3]
        if upright:
            tilt = np.cross(pose.rotation[:, 2], [0, 0, 1])
            error, rows = np.append(error, tilt[:2]), J[:5]
        q = q + np.clip(np.linalg.pinv(rows) @ error, -0.3, 0.3)
    inside = np.all((robot.position_lower < q) & (q < robot.position_upper))
    return (
        q
        if inside
        and np.linalg.norm(error) < 1e-12
        and tip_pose(robot, q).rotation[2, 2] * upright >= 0
        else None
    )


def sliding_acceleration(robot: Robot, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Compute the smallest ddq that keeps the tip at its height."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q, dq, np.zeros(robot.n))
    frame = robot.model.getFrameId(robot.tip)
    bias = pin.getFrameClassicalAcceleration(
        robot.model, data, frame, WORLD_ALIGNED
    ).linear[2]
    gain = jacobian(robot, q)[2]
    return -gain * bias / (gain @ gain)


def hit_row(robot: Robot, random: np.random.Generator, *, share: float) -> Columns:
    """Draw a motion that starts near the table and hits with a fraction of the highest possible speed."""
    start_xyz = np.array(
        [
            random.uniform(0.7, 0.9),
            random.uniform(-0.2, 0.2),
            0.16 + random.uniform(-4e-3, 4e-3),
        ]
    )
    goal_xyz = np.array([random.uniform(0.8, 1.0), random.uniform(-0.2, 0.2), 0.16])
    start_q, goal_q = (
        inverse_kinematics(robot, robot.home, xyz, upright=False)
        for xyz in (start_xyz, goal_xyz)
    )
    gain = jacobian(robot, start_q)[2]
    start_dq = random.uniform(-1, 1, robot.n)
    start_dq -= gain * (gain @ start_dq) / (gain @ gain)
    start_dq *= 0.3 * (robot.velocity_limit / np.abs(start_dq)).min()
    angle = random.uniform(-0.5, 0.5)
    goal_dq = np.linalg.pinv(jacobian(robot, goal_q)[:3]) @ np.array(
        [np.cos(angle), np.sin(angle), 0.0]
    )
    speed = share * (robot.velocity_limit / np.abs(goal_dq)).min()
    return {
        "start_q": start_q,
        "start_dq": start_dq,
        "start_ddq": sliding_acceleration(robot, start_q, start_dq),
        "goal_q": goal_q,
        "goal_dq": speed * goal_dq,
        "start_xyz": start_xyz,
        "goal_xyz": goal_xyz,
        "hit_angle": np.array(angle),
        "hit_speed": np.array(speed),
    }


def carry_row(robot: Robot, random: np.random.Generator) -> Columns:
    """Draw a motion from rest over the first pedestal to rest over the second, without contact."""
    row = {name: np.zeros(7) for name in ("start_dq", "start_ddq", "goal_dq")}
    for end, side in (("start", -1), ("goal", 1)):
        row[f"{end}_xyz"] = np.array(
            [random.uniform(0.45, 0.55), side * random.uniform(0.35, 0.5), 0.4]
        )
        row[f"{end}_xyz"][2] += random.uniform(-0.1, 0.1)
    for end in ("start", "goal"):
        q = None
        while q is None or not (is_clear(robot, q, row) and holds(robot, q)):
            q = inverse_kinematics(
                robot, random.uniform(-1.5, 1.5, 7), row[f"{end}_xyz"], upright=True
            )
        row[f"{end}_q"] = q
    return row


def is_clear(robot: Robot, q: np.ndarray, row: Columns) -> bool:
    """Return whether points along the arm at steps of 1 mm have a distance of 0.145 m from both pedestals."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    corners = np.array(
        [*(data.oMi[i].translation for i in (2, 4, 6)), tip_pose(robot, q).translation]
    )
    points = np.concatenate([np.linspace(a, b, 500) for a, b in pairwise(corners)])
    for box, end in zip(
        PROBLEMS["heavy-object"].obstacle, ("start", "goal"), strict=True
    ):
        low = np.array([box.x.low, box.y.low, -9.0])
        high = np.array([box.x.high, box.y.high, row[f"{end}_xyz"][2] - 0.15])
        if np.linalg.norm(points - np.clip(points, low, high), axis=1).min() < 0.145:
            return False
    return True


def holds(robot: Robot, q: np.ndarray) -> bool:
    torque = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)
    return bool(np.all(np.abs(torque) < robot.torque_limit))


@dataclass(frozen=True)
class Case:
    robot: Robot
    columns: Columns

    def copy(self) -> Columns:
        return {name: column.copy() for name, column in self.columns.items()}


@pytest.fixture(scope="module")
def hits() -> Case:
    """Rows of which the last is at its velocity limit, and the first ends at rest."""
    robot, random = load_robot(PROBLEMS["airhockey"]), np.random.default_rng(7)
    made = [
        hit_row(robot, random, share=share) for share in (0.0, 0.2, 0.5, 0.7, 0.9, 1.0)
    ]
    return Case(
        robot, {name: np.array([row[name] for row in made]) for name in made[0]}
    )


@pytest.fixture(scope="module")
def carries() -> Case:
    robot, random = load_robot(PROBLEMS["heavy-object"]), np.random.default_rng(8)
    made = [carry_row(robot, random) for _ in range(ROWS)]
    return Case(
        robot, {name: np.array([row[name] for row in made]) for name in made[0]}
    )


def failures(report: RowReport) -> set[str]:
    return {check.name for check in report.failed}


def test_valid_hits_pass(hits):
    report = verify_rows(PROBLEMS["airhockey"], hits.robot, hits.columns)
    assert failures(report) == set()
    assert report.ok
    assert report.rows == ROWS
    assert [check.name for check in report.checks] == [
        "finite",
        "tip position",
        "joint position",
        "joint velocity",
        "joint acceleration",
        "joint torque",
        "table rectangle",
        "table height",
        "vertical velocity",
        "vertical acceleration",
        "puck distance",
        "hit direction",
        "hit speed",
    ]


def test_valid_transports_pass(carries):
    report = verify_rows(PROBLEMS["heavy-object"], carries.robot, carries.columns)
    assert failures(report) == set()
    assert {"tilt", "upright", "robot clearance", "object contact"} <= {
        check.name for check in report.checks
    }


def test_the_highest_speed_of_a_hit_agrees_with_highs(hits):
    """Includes random arms with joints that have no effect or the same effect."""
    random = np.random.default_rng(3)
    robot, angles = hits.robot, hits.columns["hit_angle"]
    for jacobians, limit in (
        (
            np.array([jacobian(robot, q)[:3] for q in hits.columns["goal_q"]]),
            robot.velocity_limit,
        ),
        (random.normal(size=(ROWS, 3, 4)), random.uniform(0.5, 2.0, 4)),
        (random.integers(-1, 2, (ROWS, 3, 7)).astype(float), np.ones(7)),
    ):
        found = highest_speed(jacobians, angles, limit)
        for J, angle, speed in zip(jacobians, angles, found, strict=True):
            along, across = (
                np.array([np.cos(angle), np.sin(angle), 0]),
                np.array([-np.sin(angle), np.cos(angle), 0]),
            )
            equations = np.array([across @ J, J[2]])
            solved = scipy.optimize.linprog(
                -along @ J,
                A_eq=equations,
                b_eq=[0, 0],
                bounds=[(-bound, bound) for bound in limit],
            )
            assert speed == pytest.approx(-solved.fun, abs=1e-9)


def test_a_wrong_highest_speed_is_reported(hits):
    columns = hits.copy()
    J = np.array([jacobian(hits.robot, q)[:3] for q in columns["goal_q"]])
    columns["hit_speed_max"] = highest_speed(
        J, columns["hit_angle"], hits.robot.velocity_limit
    )
    assert verify_rows(PROBLEMS["airhockey"], hits.robot, columns).ok
    columns["hit_speed_max"][2] += 1e-7
    report = verify_rows(PROBLEMS["airhockey"], hits.robot, columns)
    assert [(check.name, check.worst_row) for check in report.failed] == [
        ("highest hit speed", 2)
    ]


def test_the_highest_speed_is_infinite_for_an_arm_that_cannot_follow_a_line():
    flat = np.concatenate(
        [np.random.default_rng(0).normal(size=(1, 2, 4)), np.zeros((1, 1, 4))], axis=1
    )
    assert highest_speed(flat, np.zeros(1), np.ones(4)).tolist() == [np.inf]


def distance_of_arm(
    robot: Robot, q: np.ndarray, boxes: list[tuple[np.ndarray, np.ndarray]]
) -> float:
    """Compute the distances of the arm's segments from boxes as convex problems with SciPy."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    corners = [
        *(data.oMi[i].translation.copy() for i in (2, 4, 6)),
        tip_pose(robot, q).translation.copy(),
    ]

    def nearest(
        a: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> float:
        def distance(s: float) -> float:
            point = a + s * (b - a)
            return float(np.linalg.norm(point - np.clip(point, low, high)))

        return float(
            scipy.optimize.minimize_scalar(
                distance, bounds=(0, 1), method="bounded", options={"xatol": 1e-10}
            ).fun
        )

    return min(
        nearest(a, b, low, high) for a, b in pairwise(corners) for low, high in boxes
    )


@pytest.fixture(scope="module")
def diagnosed(carries) -> Case:
    """Transports with the diagnostics of their ends, from Pinocchio's gravity term and SciPy."""
    columns, robot = carries.copy(), carries.robot
    radius = next(
        each.radius
        for each in PROBLEMS["heavy-object"].constraint
        if isinstance(each, RobotClearance)
    )
    for end in ("start", "goal"):
        columns[f"{end}_torque_ratio"], columns[f"{end}_clearance"] = (
            np.empty(ROWS),
            np.empty(ROWS),
        )
    for row in range(ROWS):
        poses = scene_of(
            PROBLEMS["heavy-object"],
            columns["start_xyz"][row : row + 1],
            columns["goal_xyz"][row : row + 1],
        ).poses[0]
        boxes = [
            (
                np.array([box.x.low, box.y.low, -9.0]),
                np.array([box.x.high, box.y.high, top]),
            )
            for box, top in zip(PROBLEMS["heavy-object"].obstacle, poses, strict=True)
        ]
        for end in ("start", "goal"):
            q = columns[f"{end}_q"][row]
            torque = pin.computeGeneralizedGravity(
                robot.model, robot.model.createData(), q
            )
            columns[f"{end}_torque_ratio"][row] = np.max(
                np.abs(torque) / robot.torque_limit
            )
            columns[f"{end}_clearance"][row] = distance_of_arm(robot, q, boxes) - radius
    return Case(robot, columns)


def test_valid_diagnostics_pass(diagnosed):
    report = verify_rows(PROBLEMS["heavy-object"], diagnosed.robot, diagnosed.columns)
    assert report.ok
    assert {"holding torque ratio", "clearance"} <= {
        check.name for check in report.checks
    }


@pytest.mark.parametrize("end", ["start", "goal"])
@pytest.mark.parametrize(
    ("field", "check"),
    [("torque_ratio", "holding torque ratio"), ("clearance", "clearance")],
    ids=["torque", "arm"],
)
def test_a_wrong_diagnostic_is_reported_in_its_row_and_end(
    diagnosed, end, field, check
):
    columns = diagnosed.copy()
    columns[f"{end}_{field}"][4] += 1e-7
    report = verify_rows(PROBLEMS["heavy-object"], diagnosed.robot, columns)
    (failed,) = report.failed
    assert (failed.name, failed.n_failed, failed.worst_row, failed.worst_end) == (
        check,
        1,
        4,
        end,
    )
    assert failed.worst == pytest.approx(1e-7, rel=0.1)
    assert report.failed_rows.tolist() == [4]


def test_the_diagnostics_of_one_end_alone_are_checked(diagnosed):
    columns = diagnosed.copy()
    del (
        columns["start_clearance"],
        columns["start_torque_ratio"],
        columns["goal_torque_ratio"],
    )
    columns["goal_clearance"][2] = np.nan  # fails as not finite, and is not compared
    report = verify_rows(PROBLEMS["heavy-object"], diagnosed.robot, columns)
    assert failures(report) == {"finite"}
    assert "holding torque ratio" not in {check.name for check in report.checks}
    columns["goal_clearance"][3] += 1.0
    assert failures(
        verify_rows(PROBLEMS["heavy-object"], diagnosed.robot, columns)
    ) == {
        "finite",
        "clearance",
    }


def test_valid_rows_in_single_precision_pass_only_as_float32(hits):
    single = {name: column.astype(np.float32) for name, column in hits.columns.items()}
    limit = hits.robot.velocity_limit.astype(np.float32).astype(float)
    single["goal_dq"] = np.where(
        np.abs(single["goal_dq"]) >= limit,
        single["goal_dq"] * (1 - 1e-7),
        single["goal_dq"],
    )
    assert verify_rows(PROBLEMS["airhockey"], hits.robot, single, "float32").ok
    assert failures(verify_rows(PROBLEMS["airhockey"], hits.robot, single)) >= {
        "tip position",
        "hit direction",
    }


# --- corrupted rows ---------------------------------------------------------------------------------------------------


def lift(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Compute joint velocities that lift the tip at 1 m/s."""
    return np.linalg.pinv(jacobian(robot, q)[:3])[:, 2]


def move_start(case: Case, columns: Columns, row: int) -> None:
    columns["start_q"][row, 1] += 1e-6


def move_goal(case: Case, columns: Columns, row: int) -> None:
    columns["goal_q"][row, 3] -= 1e-6


def claim_another_place(case: Case, columns: Columns, row: int) -> None:
    columns["goal_xyz"][row, 1] += 1e-6


def leave_joint_limits(case: Case, columns: Columns, row: int) -> None:
    columns["start_q"][row, 0] = case.robot.position_upper[0] + 1e-6


def exceed_velocity(case: Case, columns: Columns, row: int) -> None:
    factor = (1 + 1e-9) / np.max(
        np.abs(columns["goal_dq"][row]) / case.robot.velocity_limit
    )
    for name in ("goal_dq", "hit_speed"):
        columns[name][row] *= factor


def exceed_acceleration(case: Case, columns: Columns, row: int) -> None:
    gain = jacobian(case.robot, columns["start_q"][row])[2]
    level = np.eye(6)[5] - gain * gain[5] / (gain @ gain)
    columns["start_ddq"][row] += level * 21.0 / level[5]


def turn_hit(case: Case, columns: Columns, row: int) -> None:
    columns["hit_angle"][row] += 1e-6


def claim_another_speed(case: Case, columns: Columns, row: int) -> None:
    columns["hit_speed"][row] -= 1e-6


def hit_backwards(case: Case, columns: Columns, row: int) -> None:
    columns["hit_angle"][row] += np.pi


def rise(case: Case, columns: Columns, row: int) -> None:
    columns["goal_dq"][row] += 1e-6 * lift(case.robot, columns["goal_q"][row])


def rise_faster(case: Case, columns: Columns, row: int) -> None:
    columns["start_ddq"][row] += 1e-6 * lift(case.robot, columns["start_q"][row])


def leave_table(case: Case, columns: Columns, row: int) -> None:
    xyz = np.array([0.6 - 1e-5, 0.0, 0.16])
    columns["start_q"][row] = inverse_kinematics(
        case.robot, case.robot.home, xyz, upright=False
    )
    columns["start_xyz"][row], columns["start_dq"][row], columns["start_ddq"][row] = (
        xyz,
        0.0,
        0.0,
    )


def put_nan(case: Case, columns: Columns, row: int) -> None:
    columns["start_ddq"][row, 2] = np.nan


def put_infinity(case: Case, columns: Columns, row: int) -> None:
    columns["hit_speed"][row] = np.inf


@pytest.mark.parametrize(
    ("corrupt", "names"),
    [
        (claim_another_place, {"tip position"}),
        (exceed_velocity, {"joint velocity"}),
        (exceed_acceleration, {"joint acceleration"}),
        (turn_hit, {"hit direction"}),
        (claim_another_speed, {"hit speed"}),
        (hit_backwards, {"hit direction", "hit speed"}),
        (rise, {"vertical velocity"}),
        (rise_faster, {"vertical acceleration"}),
        (leave_table, {"table rectangle"}),
        (put_nan, {"finite"}),
        (put_infinity, {"finite"}),
    ],
)
@pytest.mark.parametrize("row", [1, ROWS - 1])
def test_corruption_of_a_hit_is_reported_under_its_name_in_its_row(
    hits, corrupt, names, row
):
    columns = hits.copy()
    corrupt(hits, columns, row)
    report = verify_rows(PROBLEMS["airhockey"], hits.robot, columns)
    assert failures(report) == names
    assert report.failed_rows.tolist() == [row]
    assert all((check.n_failed, check.worst_row) == (1, row) for check in report.failed)


@pytest.mark.parametrize(
    ("corrupt", "names"),
    [
        (move_start, {"tip position"}),
        (move_goal, {"tip position", "table height"}),
        (leave_joint_limits, {"joint position", "tip position"}),
    ],
)
def test_moved_joints_are_reported_by_the_checks_that_depend_on_them(
    hits, corrupt, names
):
    columns = hits.copy()
    corrupt(hits, columns, 3)
    report = verify_rows(PROBLEMS["airhockey"], hits.robot, columns)
    assert failures(report) >= names
    assert report.failed_rows.tolist() == [3]


def tilt(case: Case, columns: Columns, row: int) -> None:
    turn = np.linalg.pinv(jacobian(case.robot, columns["goal_q"][row]))[:, 3]
    columns["goal_q"][row] += 1e-6 * turn


def sink_into_pedestal(case: Case, columns: Columns, row: int) -> None:
    columns["start_xyz"][row, 2] += 2e-3


def reach_through_pedestal(case: Case, columns: Columns, row: int) -> None:
    columns["start_q"][row] = [np.pi / 4, np.pi / 2, 0, 0, 0, 0, 0]
    columns["start_xyz"][row] = tip_pose(
        case.robot, columns["start_q"][row]
    ).translation
    columns["goal_xyz"][row, 2] = 0.8


@pytest.mark.parametrize(
    ("corrupt", "names"),
    [
        (tilt, {"tilt"}),
        (sink_into_pedestal, {"tip position", "object contact"}),
        (put_nan, {"finite"}),
    ],
)
def test_corruption_of_a_transport_is_reported_under_its_name_in_its_row(
    carries, corrupt, names
):
    columns = carries.copy()
    corrupt(carries, columns, 2)
    report = verify_rows(PROBLEMS["heavy-object"], carries.robot, columns)
    assert failures(report) == names
    assert report.failed_rows.tolist() == [2]


def test_an_arm_in_a_pedestal_is_reported(carries):
    columns = carries.copy()
    reach_through_pedestal(carries, columns, 4)
    report = verify_rows(PROBLEMS["heavy-object"], carries.robot, columns)
    assert failures(report) >= {"robot clearance"}
    assert report.failed_rows.tolist() == [4]
    (clearance,) = (check for check in report.checks if check.name == "robot clearance")
    assert clearance.worst == pytest.approx(0.352132, rel=1e-5)
    assert (clearance.worst_row, clearance.worst_end) == (4, "start")


# --- torque, and accelerations of the goal ----------------------------------------------------------------------------


def with_torque_limit(robot: Robot, joint: int, limit: float) -> Robot:
    return replace(
        robot,
        torque_limit=np.where(np.arange(robot.n) == joint, limit, robot.torque_limit),
    )


def holding_torque(case: Case, end: str, joint: int) -> np.ndarray:
    model = case.robot.model
    torques = [
        pin.computeGeneralizedGravity(model, model.createData(), q)[joint]
        for q in case.columns[f"{end}_q"]
    ]
    return np.abs(torques)


@pytest.mark.parametrize(("end", "other"), [("start", "goal"), ("goal", "start")])
def test_holding_torque_is_checked_at_both_ends_at_rest(carries, end, other):
    violation = [
        holding_torque(carries, end, j).max() - holding_torque(carries, other, j).max()
        for j in range(7)
    ]
    joint = int(np.argmax(violation))
    torque = holding_torque(carries, end, joint)
    report = verify_rows(
        PROBLEMS["heavy-object"],
        with_torque_limit(carries.robot, joint, torque.max() * (1 - 1e-9)),
        carries.columns,
    )
    (check,) = report.failed
    assert (check.name, check.worst_end, check.worst_row) == (
        "joint torque",
        end,
        int(torque.argmax()),
    )
    assert check.worst == pytest.approx(1e-9 * torque.max(), rel=1e-3)
    assert report.failed_rows.tolist() == [torque.argmax()]


def test_torque_at_a_moving_goal_is_checked_only_if_its_acceleration_is_stored(hits):
    columns = hits.copy()
    columns["goal_ddq"] = np.array(
        [
            sliding_acceleration(hits.robot, *pair)
            for pair in zip(columns["goal_q"], columns["goal_dq"], strict=True)
        ]
    )
    assert verify_rows(PROBLEMS["airhockey"], hits.robot, columns).ok
    columns["goal_ddq"][4] += 1e-6 * lift(hits.robot, columns["goal_q"][4])
    report = verify_rows(PROBLEMS["airhockey"], hits.robot, columns)
    assert (failures(report), report.failed_rows.tolist()) == (
        {"vertical acceleration"},
        [4],
    )
    strict = with_torque_limit(hits.robot, 1, 1.0)
    del columns["goal_ddq"]
    columns["start_q"], columns["start_xyz"] = columns["goal_q"], columns["goal_xyz"]
    columns["start_dq"], columns["start_ddq"] = (
        0 * columns["start_dq"],
        0 * columns["start_ddq"],
    )
    torque = next(
        c
        for c in verify_rows(PROBLEMS["airhockey"], strict, columns).checks
        if c.name == "joint torque"
    )
    assert torque.n_failed == ROWS


# --- reports ----------------------------------------------------------------------------------------------------------


def test_blocks_do_not_change_the_report(hits, monkeypatch):
    columns = hits.copy()
    turn_hit(hits, columns, 1)
    rise(hits, columns, 4)
    put_nan(hits, columns, 3)
    whole = verify_rows(PROBLEMS["airhockey"], hits.robot, columns)
    monkeypatch.setattr(rows_module, "VERIFICATION_BLOCK_ROWS", 2)
    blocks = verify_rows(PROBLEMS["airhockey"], hits.robot, columns)
    assert whole.to_dict() == blocks.to_dict()
    assert whole.failed_rows.tolist() == [1, 3, 4]


def test_merged_reports_are_the_report_of_all_rows(hits):
    columns = hits.copy()
    rise(hits, columns, 4)
    parts = [
        {name: column[part] for name, column in columns.items()}
        for part in (slice(0, 4), slice(4, 6))
    ]
    merged = merge(
        [verify_rows(PROBLEMS["airhockey"], hits.robot, part) for part in parts]
    )
    assert (
        merged.to_dict()
        == verify_rows(PROBLEMS["airhockey"], hits.robot, columns).to_dict()
    )


def test_no_rows_give_an_empty_report(hits):
    report = verify_rows(
        PROBLEMS["airhockey"],
        hits.robot,
        {name: column[:0] for name, column in hits.columns.items()},
    )
    assert (report.rows, report.ok, failures(report)) == (0, True, set())
    assert merge([]).ok
    assert (
        merge(
            [report, verify_rows(PROBLEMS["airhockey"], hits.robot, hits.columns)]
        ).rows
        == ROWS
    )


def test_the_report_is_valid_json_if_a_value_could_not_be_evaluated():
    check = Check("torque", "N m", np.inf, 1e-9, 1, 0, "start")
    text = json.dumps(RowReport(1, (check,), np.array([0])).to_dict(), allow_nan=False)
    assert json.loads(text)["checks"][0] == {
        "name": "torque",
        "unit": "N m",
        "worst": None,
        "tolerance": 1e-9,
        "n_failed": 1,
        "worst_row": 0,
        "worst_end": "start",
    }


def test_finite_values_that_overflow_fail(hits):
    columns = hits.copy()
    columns["start_dq"][2] = 1e300
    report = verify_rows(PROBLEMS["airhockey"], hits.robot, columns)
    assert {"joint velocity", "joint torque"} <= failures(report)
    assert report.failed_rows.tolist() == [2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda columns: columns.pop("goal_dq"), "the rows have no field goal_dq"),
        (
            lambda columns: columns.update(start_q=columns["start_q"][:, :5]),
            r"start_q must have shape \(6, 6\)",
        ),
        (
            lambda columns: columns.update(hit_angle=columns["hit_angle"][1:]),
            r"hit_angle must have shape",
        ),
        (
            lambda columns: columns.update(goal_xyz=columns["goal_xyz"][:, :2]),
            r"goal_xyz must have shape \(6, 3\)",
        ),
    ],
)
def test_rows_of_a_wrong_shape_raise_an_error(
    hits, change: Callable[[Columns], None], message
):
    columns = hits.copy()
    change(columns)
    with pytest.raises(DatasetError, match=message):
        verify_rows(PROBLEMS["airhockey"], hits.robot, columns)


@dataclass(frozen=True, kw_only=True)
class HighElbow(Constraint):
    """A constraint of a plug-in."""

    reason = "elbow too low"
    tolerance: float = 0.0
    height: float

    def symbolic(self, state):
        raise NotImplementedError

    def measured(self, world):
        return ()

    def measured_at(self, world, end):
        if end == "start":
            return ()
        return (
            Condition(
                "elbow",
                "rad",
                [float(world.q[1])],
                np.array([-9.0]),
                np.array([self.height]),
                "angle",
            ),
        )


def test_a_constraint_of_a_plug_in_is_checked(hits):
    angles = hits.columns["goal_q"][:, 1]
    problem = replace(
        PROBLEMS["airhockey"],
        constraint=(
            *PROBLEMS["airhockey"].constraint,
            HighElbow(height=float(np.sort(angles)[-2])),
        ),
    )
    report = verify_rows(problem, hits.robot, hits.columns)
    (check,) = report.failed
    assert (check.name, check.n_failed, check.worst_end) == ("elbow", 1, "goal")
    assert report.failed_rows.tolist() == [angles.argmax()]


# --- the world --------------------------------------------------------------------------------------------------------


def test_obstacle_poses_follow_the_object_or_are_fixed():
    high = replace(PROBLEMS["heavy-object"].obstacle[1], top=0.7, below="")
    problem = replace(
        PROBLEMS["heavy-object"],
        obstacle=(
            PROBLEMS["heavy-object"].obstacle[0],
            high,
            PROBLEMS["heavy-object"].obstacle[1],
        ),
    )
    poses = scene_of(
        problem,
        np.array([[0.4, -0.4, 0.5], [0.4, -0.4, 0.6]]),
        np.array([[0.4, 0.4, 0.3]] * 2),
    ).poses
    np.testing.assert_allclose(poses, [[0.35, 0.7, 0.15], [0.45, 0.7, 0.15]])


def test_the_collision_world_measures_segments_in_order_and_exactly():
    scene = CollisionWorld(None)
    scene.place(solids_of(PROBLEMS["heavy-object"].obstacle, np.array([0.5, 0.4])))
    up = (
        (0.4, -0.45, 0.6),
        (0.4, -0.45, 0.9),
    )  # over the first, 0.75 m from the second
    across = ((0.4, -0.2, 0.2), (0.4, 0.2, 0.2))  # 0.1 m from both
    inside = ((0.3, -0.4, 0.3), (0.5, 0.4, 0.1))
    beside = np.hypot(0.75, 0.2)
    expected = [0.1, beside, 0.1, 0.1, -0.1, -0.1]
    np.testing.assert_allclose(
        scene.segment_distances([up, across, inside]), expected, atol=1e-9
    )


def test_the_collision_world_measures_a_segment_of_length_zero():
    scene = CollisionWorld(None)
    scene.place(solids_of(PROBLEMS["heavy-object"].obstacle, np.array([0.5, 0.4])))
    np.testing.assert_allclose(
        scene.segment_distances([((0.4, 0.0, 0.2),) * 2]), [0.3, 0.3], atol=1e-9
    )


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 2])
@pytest.mark.parametrize("depth", [-0.1, -1e-9, 0.0, 1e-9, 1e-3, 0.1])
def test_the_collision_world_measures_the_penetration_depth_of_an_object(turn, depth):
    scene = CollisionWorld((0.2, 0.2, 0.3))
    scene.place(solids_of(PROBLEMS["heavy-object"].obstacle, np.array([0.5, -3.0])))
    position, rotation = (
        np.array([0.41, -0.44, 0.65 - depth]),
        pin.exp3(np.array([0.0, 0.0, turn])),
    )
    assert scene.object_distances(position, rotation)[0] == pytest.approx(
        -depth, abs=1e-10
    )


def test_the_distance_of_a_missing_object_raises_an_error(hits):
    with is_refused(RecipeError):
        World(
            hits.robot,
            PROBLEMS["airhockey"].obstacle,
            PROBLEMS["airhockey"].object_size,
        ).object_distances()


def test_setting_a_state_replaces_the_whole_state(carries):
    world, fresh = (
        World(
            carries.robot,
            PROBLEMS["heavy-object"].obstacle,
            PROBLEMS["heavy-object"].object_size,
        ),
        World(
            carries.robot,
            PROBLEMS["heavy-object"].obstacle,
            PROBLEMS["heavy-object"].object_size,
        ),
    )
    poses, zero = np.array([0.3, 0.4]), np.zeros(7)
    world.set_state(carries.columns["goal_q"][0], zero + 1, zero + 2, poses + 1)
    _ = (
        world.torque,
        world.tip_velocity,
        world.segment_distances(),
        world.object_distances(),
    )
    state = carries.columns["start_q"][0], zero, zero - 1, poses
    for one in (world, fresh):
        one.set_state(*state)
    for name in (
        "q",
        "dq",
        "ddq",
        "torque",
        "tip_position",
        "tip_rotation",
        "tip_velocity",
        "tip_acceleration",
    ):
        np.testing.assert_array_equal(getattr(world, name), getattr(fresh, name))
    assert world.segment_distances() == fresh.segment_distances()
    assert world.object_distances() == fresh.object_distances()
