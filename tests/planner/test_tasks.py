"""Expected times: the time of the distance, and the minimum time of joints with bounded velocity and acceleration."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy

from cnpgen.errors import UsageError
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.planner.tasks import MIN_REACH_TIME_S, reaching_time
from cnpgen.trajectory.boundary import Boundary
from tests.examples.plans import ROBOTS
from tests.refusals import is_refused

STEPS = 80


def one_joint(
    q0: float, v0: float, q1: float, v1: float, *, velocity: float, acceleration: float
) -> float:
    return reaching(
        np.array([q0, v0, 0.0, q1, v1]), np.array([velocity]), np.array([acceleration])
    )


def reaching(ends: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> float:
    robot = SimpleNamespace(
        n=len(velocity), velocity_limit=velocity, acceleration_limit=acceleration
    )
    return float(reaching_time(robot, fixed_at_goal=2)(ends))


def can_reach(
    time: float,
    q0: float,
    v0: float,
    q1: float,
    v1: float,
    velocity: float,
    acceleration: float,
) -> bool:
    """Return whether piecewise constant accelerations reach the goal in a time, by a linear program."""
    dt = time / STEPS
    speeds = dt * np.tril(np.ones((STEPS, STEPS)))  # after every step
    distances = dt**2 * (STEPS - 0.5 - np.arange(STEPS))
    equal, right = np.stack([speeds[-1], distances]), [v1 - v0, q1 - q0 - v0 * time]
    unequal = np.concatenate([speeds, -speeds])
    bound = np.concatenate(
        [np.full(STEPS, velocity - v0), np.full(STEPS, velocity + v0)]
    )
    found = scipy.optimize.linprog(
        np.zeros(STEPS),
        A_ub=unequal,
        b_ub=bound,
        A_eq=equal,
        b_eq=right,
        bounds=(-acceleration, acceleration),
    )
    return bool(found.status == 0)


def test_the_reaching_time_of_a_joint_is_minimal() -> None:
    random = np.random.default_rng(0)
    for _ in range(12):
        velocity, acceleration = random.uniform(0.5, 2.0), random.uniform(5.0, 20.0)
        v0, v1 = random.uniform(-velocity, velocity, 2)
        q1 = random.uniform(-0.6, 0.6) * random.choice([0.1, 1.0])
        found = one_joint(0.0, v0, q1, v1, velocity=velocity, acceleration=acceleration)
        if found > 1.1 * MIN_REACH_TIME_S:
            assert not can_reach(0.97 * found, 0.0, v0, q1, v1, velocity, acceleration)
            assert can_reach(1.03 * found, 0.0, v0, q1, v1, velocity, acceleration)


def test_the_reaching_time_is_the_largest_of_the_joints_with_a_lower_bound() -> None:
    limits, far = (np.array([1.0, 1.0]), np.array([10.0, 10.0])), np.array([0.1, 1.0])
    ends = np.concatenate([np.zeros(6), far, np.zeros(2)])
    assert reaching(ends, *limits) == pytest.approx(
        1.0 / 1.0 + 1.0 / 10.0
    )  # cruising, and both ramps
    assert reaching(np.zeros(10), *limits) == MIN_REACH_TIME_S


def test_a_start_velocity_away_from_the_goal_takes_longer() -> None:
    towards, away = (
        one_joint(0, v, 0.3, 0.0, velocity=1.0, acceleration=10.0) for v in (0.8, -0.8)
    )
    assert away == pytest.approx(
        towards + 2 * 0.8 / 10.0
    )  # back to where it was, now the right way


def test_the_boundary_layer_supports_both_expected_times() -> None:
    random = np.random.default_rng(1)
    boundary = Boundary(*random.uniform(-0.3, 0.3, (5, 3, 6)))
    layer = BoundaryLayer(
        "airhockey",
        line_projection_steps=0,
        projection_steps=0,
        expected_time="reach",
        backend="numpy",
    )
    robot = ROBOTS["airhockey"]
    limits = robot.velocity_limit, robot.acceleration_limit
    expected = [
        reaching(ends, *limits)
        for ends in np.concatenate(list(boundary.conditions().values()), axis=1)
    ]
    np.testing.assert_allclose(
        layer.tasks(boundary).expected_time, expected, rtol=1e-12
    )
    with is_refused(UsageError, argument="expected_time"):
        BoundaryLayer("airhockey", expected_time="soon")
