"""Goals of hits: valid ones pass, wrong ones with the right tip positions and speeds fail."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.judges.rows.hits import (
    HitRule,
    _gradients,
    hit_rule,
    judge_goals,
    repeated_fraction,
    speed_fractions,
)
from cnpgen.judges.rows.verify import verify_rows
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from tests.conftest import columns_of

PROBLEM = load_problem("airhockey")
ROBOT = load_robot(PROBLEM)
FRAME = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
RULES = {
    "airhockey-hit": HitRule("base", 0.5),
    "airhockey-replan": HitRule("start", 0.2),
}
ROWS = 60

Columns = dict[str, np.ndarray]


def jacobian(q: np.ndarray) -> np.ndarray:
    return np.array(
        pin.computeFrameJacobian(
            ROBOT.model, ROBOT.model.createData(), q, ROBOT.tip_frame, FRAME
        )[:3]
    )


def value(q: np.ndarray, home: np.ndarray, angle: float) -> float:
    gain = jacobian(q).T @ np.array([np.cos(angle), np.sin(angle), 0.0])
    return float(gain @ gain - np.sum(((home - q) / ROBOT.rated_velocity) ** 2))


@pytest.fixture(params=RULES)
def rows(request: pytest.FixtureRequest, tiny: Callable) -> tuple[Columns, HitRule]:
    columns = {
        name: values[:ROWS].copy()
        for name, values in columns_of(tiny(request.param)).items()
    }
    return columns, RULES[request.param]


def wide(columns: Columns) -> Columns:
    return {name: values.reshape(ROWS, -1) for name, values in columns.items()}


def direction(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), np.sin(angle), 0.0]])


def test_the_gradient_agrees_with_differences_up_to_rows_of_the_jacobian() -> None:
    random = np.random.default_rng(0)
    for _ in range(5):
        q, home = (ROBOT.home + random.uniform(-0.5, 0.5, ROBOT.n) for _ in range(2))
        angle, step = random.uniform(-1, 1), 1e-6
        differences = [
            (value(q + e, home, angle) - value(q - e, home, angle)) / (2 * step)
            for e in step * np.eye(ROBOT.n)
        ]
        (J,), (gradient,) = _gradients(ROBOT, q[None], home[None], direction(angle))
        np.testing.assert_array_equal(J, jacobian(q))
        outside = np.eye(ROBOT.n) - np.linalg.pinv(J) @ J
        np.testing.assert_allclose(outside @ gradient, outside @ differences, atol=1e-8)


def test_the_goals_of_datasets_pass(rows: tuple[Columns, HitRule]) -> None:
    columns, rule = rows
    report = verify_rows(PROBLEM, ROBOT, columns, rule=rule)
    assert report.ok
    assert {"hitting configuration", "hitting velocity"} <= {
        check.name for check in report.checks
    }
    assert repeated_fraction(speed_fractions(columns), "float64") == (0, 0.0)


def test_without_a_rule_goals_are_not_checked(rows: tuple[Columns, HitRule]) -> None:
    columns, _ = rows
    names = {check.name for check in verify_rows(PROBLEM, ROBOT, columns).checks}
    assert not {"hitting configuration", "hitting velocity"} & names


def test_another_configuration_with_the_same_tip_position_is_reported(
    rows: tuple[Columns, HitRule],
) -> None:
    """The arm moves in its null space, and all dependent fields are recomputed."""
    columns, rule = rows
    for row in range(ROWS):
        q = columns["goal_q"][row].copy()
        for _ in range(20):
            step = np.linalg.svd(jacobian(q))[2][-1]
            q = q + 1e-4 * step * np.sign(step[0])
            for _ in range(3):
                pin.framesForwardKinematics(
                    ROBOT.model, data := ROBOT.model.createData(), q
                )
                q = q - np.linalg.pinv(jacobian(q)) @ (
                    data.oMf[ROBOT.tip_frame].translation - columns["goal_xyz"][row]
                )  # fmt: skip
        columns["goal_q"][row] = q
    columns = {
        name: values
        for name, values in columns.items()
        if not name.startswith(("hit_speed", "goal_dq"))
    }
    columns["goal_dq"] = np.zeros((ROWS, ROBOT.n))
    report = verify_rows(PROBLEM, ROBOT, columns, rule=HitRule(rule.near))
    (failed,) = report.failed
    assert (failed.name, failed.n_failed) == ("hitting configuration", ROWS)


def test_goals_of_another_start_are_reported(rows: tuple[Columns, HitRule]) -> None:
    columns, rule = rows
    other = HitRule("start" if rule.near == "base" else "base")
    judged = judge_goals(ROBOT, other, wide(columns), np.arange(ROWS), "float64")
    assert judged[0][0].n_failed == ROWS


def test_f_may_increase_towards_an_active_joint_limit() -> None:
    """A goal is valid if f increases towards its active limit, and invalid if f increases away from it."""
    random = np.random.default_rng(3)
    q = ROBOT.home + random.uniform(-0.2, 0.2, ROBOT.n)
    (J,), (gradient,) = _gradients(ROBOT, q[None], q[None], direction(0.3))
    columns = {"goal_q": q[None], "start_q": q[None], "hit_angle": np.array([[0.3]])}
    free = [0, 1, 3]  # as many as tip coordinates, so f cannot increase along them
    projected = (
        gradient - J.T @ np.linalg.lstsq(J[:, free].T, gradient[free], rcond=None)[0]
    )
    for outwards in (True, False):
        lower, upper = ROBOT.position_lower.copy(), ROBOT.position_upper.copy()
        for joint in set(range(ROBOT.n)) - set(free):
            (upper if (projected[joint] > 0) == outwards else lower)[joint] = q[joint]
        robot = replace(ROBOT, position_lower=lower, position_upper=upper)
        ((check, _),) = judge_goals(
            robot, HitRule("start"), columns, np.arange(1), "float64"
        )
        assert check.n_failed == (0 if outwards else 1)


def test_a_hit_that_is_not_a_fraction_of_the_fastest_is_reported(
    rows: tuple[Columns, HitRule],
) -> None:
    """The same tip speed with other joint velocities, of which it is not the largest multiple."""
    columns, rule = rows
    slow = np.flatnonzero(columns["hit_speed"] < 0.8 * columns["hit_speed_max"])
    row = int(slow[0])
    J = jacobian(columns["goal_q"][row])
    columns["goal_dq"][row] = np.linalg.pinv(J) @ (J @ columns["goal_dq"][row])
    columns["goal_dq"][row] += 0.9 * np.linalg.svd(J)[2][-1]
    report = verify_rows(PROBLEM, ROBOT, columns, rule=rule)
    assert {check.name: check.worst_row for check in report.failed} == {
        "hitting velocity": row
    }


def test_a_slower_hit_is_reported_if_all_hits_are_at_full_speed(
    rows: tuple[Columns, HitRule],
) -> None:
    columns, _ = rows
    slow = np.flatnonzero(columns["hit_speed"] < columns["hit_speed_max"])
    judged = judge_goals(
        ROBOT, HitRule(full_speed=1.0), wide(columns), np.arange(ROWS), "float64"
    )
    assert judged[0][1].tolist() == slow.tolist()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_hits_with_halved_speeds_are_reported(dtype: str) -> None:
    random = np.random.default_rng(1)
    highest = random.uniform(0.5, 2.0, 20_000)
    fraction = np.where(random.random(20_000) < 0.3, 1.0, random.random(20_000))
    speeds = {
        "hit_speed_max": highest.astype(dtype),
        "hit_speed": (fraction * highest).astype(dtype),
    }
    assert repeated_fraction(speed_fractions(speeds), dtype) == (0, 0.0)
    speeds["hit_speed"] = (speeds["hit_speed"] * 0.5).astype(dtype)
    count, value_ = repeated_fraction(speed_fractions(speeds), dtype)
    assert value_ == pytest.approx(0.5, rel=1e-6)
    assert abs(count - (fraction == 1).sum()) < 5


def test_the_rule_is_read_from_the_recorded_stages() -> None:
    stages = [
        {"use": "hitting-configuration", "near": "start"},
        {"use": "hitting-velocity", "full_speed": 0.25},
    ]
    assert hit_rule(stages) == HitRule("start", 0.25)
    assert hit_rule([{"use": "at-rest"}, {}]) == HitRule("", None)
