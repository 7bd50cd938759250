"""Time parametrization and time scaling of motions with drives: viscous friction is linear, dry friction constant."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import UsageError
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.planner.planner import Planner
from cnpgen.planner.time_parametrization import make_time_parametrization
from cnpgen.planner.time_scaling import TIME_SCALE_MARGIN, make_time_scaling
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_record import record_problem
from cnpgen.robots.drive import DriveLine, DriveSpec
from cnpgen.schema.keys import PerJoint
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import columns_of, needs_compiled_code
from tests.examples.models import (
    LoadedProblem,
    boundary_of_columns,
    interpreted,
    loaded_problem_of,
)
from tests.examples.numpy_parametrization import advance, by_numpy
from tests.refusals import is_refused

DRIVE = DriveSpec(
    armature=PerJoint((3.4, 3.4, 3.4, 3.4, 1.3, 1.2)),
    viscous=PerJoint((3.0, 2.0, 1.0, 2.0, 0.0, 1.0)),
    coulomb=PerJoint((4.0, 5.0, 2.0, 4.0, 5.0, 0.0)),
    torque=PerJoint(
        (119.0, 194.0, 90.0, 79.0, 33.0, 33.0)
    ),  # times 0.8; met at the ends
)
LINE = DriveLine(torque=PerJoint((250.0,)), speed=PerJoint((2.0,)))
COUNT = 8
OBSTACLE_POSES = np.zeros((COUNT, 4))  # without effect on times


def with_drive(**changes: object) -> LoadedProblem:
    problem = replace(
        loaded_problem_of("airhockey").problem, drive=replace(DRIVE, **changes)
    )
    robot, (backend, folder) = load_robot(problem), choose_backend()
    kernels = problem_kernels(problem, robot, backend, folder)
    return LoadedProblem(record_problem(problem), problem, robot, kernels)


@pytest.fixture(scope="module")
def given() -> LoadedProblem:
    return with_drive()


@pytest.fixture(scope="module")
def time_parametrization(given):
    return by_numpy(
        make_time_parametrization(
            given.problem, given.robot, interpreted(given).kernels
        )
    )


@pytest.fixture(scope="module")
def motion(tiny) -> Motion:
    boundary = boundary_of_columns(columns_of(tiny("airhockey-replan")), COUNT)
    return Planner("airhockey-replan", backend="numpy").plan_batch(boundary).motion


def motor_torques(given, p, p1, p2, r, r1, share):
    """Compute upper and lower motor torques by Pinocchio, with friction of the direction of p', shape (2, n, K)."""
    robot, drive = given.robot, given.robot.drive
    model = robot.model.copy()
    model.armature = drive.armature
    data = model.createData()
    dq, ddq = p1 * r, p2 * r**2 + p1 * r1 * r
    torque = np.array(
        [
            pin.rnea(model, data, *state).copy()
            for state in zip(p.T, dq.T, ddq.T, strict=True)
        ]
    ).T
    b, c = drive.viscous[:, None], drive.coulomb[:, None]
    friction = b * dq + c * np.sign(dq)
    uncertain = c * np.sign(dq) + b * (dq + np.sign(dq) * drive.reversal_speed)
    ends = [
        share * friction + (1 - share) * np.where(sign * dq > 0, uncertain, 0.0)
        for sign in (1, -1)
    ]
    return np.array([torque + end for end in ends])


@pytest.mark.parametrize(
    ("share", "more"),
    [
        (0.0, {}),
        (0.4, {}),
        (1.0, {}),
        (0.4, {"line": (LINE,)}),
        (0.4, {"line": (LINE,), "viscous": PerJoint((0.0,))}),
        (
            1.0,
            {"line": (LINE,), "viscous": PerJoint((0.0,)), "coulomb": PerJoint((0.0,))},
        ),
    ],
)
def test_coefficients_are_those_of_pinocchio_with_rotors_and_friction(share, more):
    given = with_drive(friction_help=share, **more)
    random, n, count = np.random.default_rng(7), given.robot.n, 20
    found = make_time_parametrization(
        given.problem, given.robot, interpreted(given).kernels
    )
    column = random.normal(size=(3 * n + 2, count))
    p, p1, p2 = column[: 3 * n].reshape(3, n, count)
    p1 += np.sign(p1)  # far from a reversal
    column[n : 2 * n] = p1
    r, r1 = np.abs(column[3 * n :]) + 0.3
    column[3 * n :] = r, r1
    constant, square, mixed, linear = found.coefficients(
        np.concatenate([column, np.zeros((4, count))])
    )
    drive = given.robot.drive
    upper, lower = motor_torques(given, p, p1, p2, r, r1, share)
    expected = np.concatenate(
        [upper[list(drive.motor_rows)], lower[list(drive.uncertain_rows)]]
    )
    value = constant + square * r**2 + mixed * r * r1 + linear * r
    if more:  # |tau_m + s slope dq| for both signs s, after the torques
        slope = 250 * 0.8 / 2.0 * p1 * r
        joints = list(drive.motor_rows), list(drive.uncertain_rows)
        expected = np.concatenate(
            [
                expected,
                *(
                    end[rows] + sign * slope[rows]
                    for end, rows in zip((upper, lower), joints, strict=True)
                    for sign in (1, -1)
                ),
            ]
        )
    rows = slice(2 * n, 2 * n + len(expected))  # after accelerations and torques
    np.testing.assert_allclose(value[rows], expected, rtol=1e-9, atol=1e-9)
    assert not linear[: 2 * n].any()
    assert not linear[rows.stop :].any()
    assert np.abs(linear[rows]).max() > 1


def test_a_step_of_the_rates_is_exact_with_a_linear_coefficient():
    """One row, one phase: g = 0.1 + r^2 + r r' + 0.5 r from r = 1, r' = 0 along (1, 0.2)."""
    rows = [np.full((1, 1, 1), each) for each in (0.1, 1.0, 1.0, 0.5)]
    rates = np.array([1.0, 0.0]).reshape(2, 1, 1)
    along = np.array([1.0, 0.2]).reshape(2, 1, 1)
    x = advance(rows, (np.array([-np.inf]), np.array([2.4])), rates, along)[0]
    r = 1 + x
    assert 0.1 + r * r + r * 0.2 * x + 0.5 * r == pytest.approx(2.4)


def test_motions_are_fitted_to_the_limits_of_the_motors(
    given, motion, time_parametrization
):
    """The rates decrease where motors limit the motion, and then meet the limits of the exact envelope."""
    rigid = loaded_problem_of("airhockey")
    fast, _ = make_time_parametrization(
        rigid.problem, rigid.robot, interpreted(rigid).kernels
    ).parametrize(motion, OBSTACLE_POSES)
    found, meets_limits = time_parametrization.parametrize(motion, OBSTACLE_POSES)
    np.testing.assert_array_equal(found.path, motion.path)
    assert found.duration().mean() > fast.duration().mean()
    column = time_parametrization.column(found, OBSTACLE_POSES)
    violation = time_parametrization.violation(column)[0].reshape(COUNT, -1)
    assert meets_limits.sum() > COUNT / 2
    assert (violation[meets_limits] <= 1e-5).all()


def test_scaled_motions_meet_the_limits_of_the_motors(given, motion):
    """At rest friction acts in the direction of the motion that is scaled."""
    scaling = make_time_scaling(given.problem, given.robot, interpreted(given).kernels)
    fast = replace(motion, rate=1.5 * motion.rate)
    factor = scaling.factor(fast, OBSTACLE_POSES)
    slow = replace(fast, rate=fast.rate / factor[:, None])
    (violation,) = scaling.violation(scaling.column(slow, OBSTACLE_POSES))
    solved = factor < 3
    assert solved.sum() > COUNT / 2
    assert (factor[solved] > 1).any()
    assert (violation.reshape(COUNT, -1).max(axis=1)[solved] <= 1e-3).all()
    quicker = replace(fast, rate=fast.rate / (0.98 * factor[:, None]))
    (violation,) = scaling.violation(scaling.column(quicker, OBSTACLE_POSES))
    scaled = solved & (factor > 1)
    assert (violation.reshape(COUNT, -1).max(axis=1)[scaled] > 0).all()


def test_motions_are_scaled_to_powers_and_not_time_parametrized(motion):
    """The power of a scaled motion is a cubic of 1/k: the exact value is met, and a faster motion exceeds it."""
    given = with_drive(power=PerJoint((90.0, 60.0, 40.0, 30.0, 20.0, 20.0)))
    with is_refused(UsageError):
        make_time_parametrization(given.problem, given.robot, given.kernels)
    scaling = make_time_scaling(given.problem, given.robot, interpreted(given).kernels)
    assert scaling.bounds.power.sum() == 2 * given.robot.n  # both ends of friction
    alone = replace(
        scaling,
        bounds=replace(
            scaling.bounds,
            lower=np.full_like(scaling.bounds.lower, -np.inf),
            upper=np.where(scaling.bounds.power, scaling.bounds.upper, np.inf),
        ),
    )
    factor = alone.factor(motion, OBSTACLE_POSES) / (1 + TIME_SCALE_MARGIN)
    solved = (factor > 1) & (factor < 2.9)
    assert solved.sum() > COUNT / 2
    phases = alone.path.shape[1]
    for index in np.flatnonzero(solved):
        column = alone.column(motion[[index]], OBSTACLE_POSES[[index]])
        p, p1, p2 = column[: 3 * given.robot.n].reshape(3, -1, phases)
        r, r1 = column[3 * given.robot.n :][:2] / factor[index]
        upper, lower = motor_torques(given, p, p1, p2, r, r1, 0.0)
        power = (
            np.maximum(upper * p1 * r, lower * p1 * r)
            / given.robot.drive.power_limit[:, None]
        )
        assert power.max() == pytest.approx(1.0, abs=1e-6)


@needs_compiled_code
@pytest.mark.slow
def test_compiled_and_interpreted_time_parametrization_agree_with_drives(
    given, motion, time_parametrization
):
    compiled = make_time_parametrization(given.problem, given.robot, given.kernels)
    slow = replace(motion, rate=0.5 * motion.rate)  # no violation at first
    for each, agreeing in ((slow, COUNT), (motion, COUNT - 2)):
        found, expected = (
            one.parametrize(each, OBSTACLE_POSES)[0].rate
            for one in (compiled, time_parametrization)
        )
        agree = np.isclose(found, expected, rtol=1e-8).all(axis=1)
        # After a step back, rounding decides whether a bound is violated.
        assert agree.sum() >= agreeing
