"""Time parametrization: rates are fitted to the limits; paths and boundary conditions stay."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import UsageError
from cnpgen.planner.expressions import coefficient_bounds, speed_bounds
from cnpgen.planner.planner import Planner
from cnpgen.planner.time_parametrization import (
    MAX_RATE_INCREASE,
    TimeParametrization,
    make_time_parametrization,
)
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import make_plans
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import columns_of, needs_compiled_code
from tests.examples.constraints import TipSpeed
from tests.examples.jerk_limits import jerk_limited
from tests.examples.models import (
    boundary_of_columns,
    interpreted,
    loaded_problem_of,
    untrained_model,
)
from tests.examples.numpy_parametrization import advance, by_numpy, smallest
from tests.planner.test_parts import LIMITS
from tests.refusals import is_refused

COUNT = 8
OBSTACLE_POSES = np.zeros((COUNT, 4))  # without effect on times


@pytest.fixture(scope="module")
def given():
    return loaded_problem_of("airhockey")


@pytest.fixture(scope="module")
def boundary(tiny):
    return boundary_of_columns(columns_of(tiny("airhockey-replan")), COUNT)


@pytest.fixture(scope="module")
def motion(boundary) -> Motion:
    """Plans of a shipped planner without time parametrization."""
    return Planner("airhockey-replan", backend="numpy").plan_batch(boundary).motion


@pytest.fixture(scope="module")
def time_parametrization(given):
    return by_numpy(
        make_time_parametrization(
            given.problem, given.robot, interpreted(given).kernels
        )
    )


def severities(given, boundary, motion: Motion) -> np.ndarray:
    """Return the largest severities of the limits of plans, by the verdict; plans above 1 are invalid."""
    plans = make_plans(
        given.record,
        boundary,
        path_control_points=motion.path,
        rate_control_points=motion.rate,
    )
    verdicts = evaluate_plans(plans, workers=1).verdicts
    return np.array(
        [max(verdict.margins[name].severity for name in LIMITS) for verdict in verdicts]
    )


def quickened(motion: Motion, factor: float) -> Motion:
    """Return the motion with larger rates except at the ends."""
    rate = motion.rate.copy()
    rate[:, 2:-2] *= factor
    return replace(motion, rate=rate)


def test_motions_are_accelerated_until_a_limit_is_active(
    given, boundary, motion, time_parametrization
):
    found, meets_limits = time_parametrization.parametrize(motion, OBSTACLE_POSES)
    fits = severities(given, boundary, motion) <= 1
    assert fits.sum() > COUNT / 2
    assert (found.duration()[fits] < 0.99 * motion.duration()[fits]).all()
    assert (severities(given, boundary, found)[fits] <= 1).all()
    assert meets_limits[fits].all()
    assert (severities(given, boundary, quickened(found, 1.05))[fits] > 1).mean() > 0.5


def test_path_and_boundary_conditions_stay(motion, time_parametrization):
    found, _ = time_parametrization.parametrize(motion, OBSTACLE_POSES)
    np.testing.assert_array_equal(found.path, motion.path)
    np.testing.assert_array_equal(
        found.rate[:, [0, 1, -2, -1]], motion.rate[:, [0, 1, -2, -1]]
    )
    assert (found.rate[:, 2:-2] != motion.rate[:, 2:-2]).any(axis=1).all()


def test_motions_with_violations_between_their_ends_become_slower(
    given, boundary, motion, time_parametrization
):
    time_parametrized, _ = time_parametrization.parametrize(motion, OBSTACLE_POSES)
    good = severities(given, boundary, time_parametrized) <= 1
    fast = quickened(time_parametrized, 1.15)
    before = severities(given, boundary, fast)
    after = severities(
        given, boundary, time_parametrization.parametrize(fast, OBSTACLE_POSES)[0]
    )
    broken = good & (before > 1)
    assert broken.sum() > COUNT / 2
    assert (after <= before).all()
    assert (after[broken] <= 1).mean() > 0.5


def test_a_motion_whose_violation_would_grow_is_unchanged(motion, time_parametrization):
    """The violation is checked afterwards: here the time parametrization uses limits twice as large."""
    wide = replace(
        time_parametrization,
        lower=2 * time_parametrization.lower,
        upper=2 * time_parametrization.upper,
    )
    slow = quickened(time_parametrization.parametrize(motion, OBSTACLE_POSES)[0], 0.9)
    np.testing.assert_array_equal(
        wide.parametrize(slow, OBSTACLE_POSES)[0].rate, slow.rate
    )


def test_a_motion_of_nan_does_not_affect_other_motions(motion, time_parametrization):
    rate = motion.rate.copy()
    rate[3] = np.nan
    (found, meets_limits), (expected, all_of_them) = (
        time_parametrization.parametrize(replace(motion, rate=rate), OBSTACLE_POSES),
        time_parametrization.parametrize(motion, OBSTACLE_POSES),
    )
    others = [0, 1, 2, *range(4, COUNT)]
    np.testing.assert_array_equal(found.rate[others], expected.rate[others])
    np.testing.assert_array_equal(meets_limits[others], all_of_them[others])
    assert not meets_limits[3]


def compiled_time_parametrization(
    name: str, *, at_rest: bool = False
) -> TimeParametrization:
    given = loaded_problem_of(name)
    return make_time_parametrization(
        given.problem, given.robot, given.kernels, at_rest=at_rest
    )


@needs_compiled_code
def test_compiled_and_interpreted_time_parametrization_agree(
    motion, time_parametrization
):
    compiled = compiled_time_parametrization("airhockey")
    for each in (motion, quickened(motion, 3.0)):
        np.testing.assert_allclose(
            compiled.parametrize(each, OBSTACLE_POSES)[0].rate,
            time_parametrization.parametrize(each, OBSTACLE_POSES)[0].rate,
            rtol=1e-8,
        )
    wide = [
        replace(each, lower=2 * each.lower, upper=2 * each.upper)
        for each in (compiled, time_parametrization)
    ]
    slow = quickened(time_parametrization.parametrize(motion, OBSTACLE_POSES)[0], 0.9)
    np.testing.assert_array_equal(
        *(each.parametrize(slow, OBSTACLE_POSES)[0].rate for each in wide)
    )
    np.testing.assert_array_equal(
        wide[0].parametrize(slow, OBSTACLE_POSES)[0].rate, slow.rate
    )
    broken = replace(
        motion, rate=np.where(np.arange(COUNT)[:, None] == 3, np.nan, motion.rate)
    )
    found = compiled.parametrize(broken, OBSTACLE_POSES)[0].rate
    np.testing.assert_array_equal(
        np.delete(found, 3, axis=0),
        np.delete(compiled.parametrize(motion, OBSTACLE_POSES)[0].rate, 3, axis=0),
    )
    assert np.isnan(found[3]).all()


@needs_compiled_code
def test_interpreted_kernels_are_called_from_compiled_code(given, motion):
    compiled = compiled_time_parametrization("airhockey")
    kernels = interpreted(given).kernels
    calling = make_time_parametrization(given.problem, given.robot, kernels)
    few = motion[:5]
    np.testing.assert_allclose(
        calling.parametrize(few, OBSTACLE_POSES[:5])[0].rate,
        compiled.parametrize(few, OBSTACLE_POSES[:5])[0].rate,
        rtol=1e-8,
    )


@needs_compiled_code
@pytest.mark.slow
def test_compiled_and_interpreted_time_parametrization_agree_from_rest_to_rest(tiny):
    """Only with obstacles a state has more values than the motion; compiling its kernels takes some seconds."""
    given, boundary = (
        loaded_problem_of("heavy-object"),
        boundary_of_columns(columns_of(tiny("heavy-object")), COUNT),
    )
    plans = Planner("heavy-object", backend="numpy").plan_batch(boundary)
    obstacle_poses = plans.scene.poses
    assert obstacle_poses.size
    kernels = interpreted(given).kernels
    interpreted_one = by_numpy(
        make_time_parametrization(given.problem, given.robot, kernels, at_rest=True)
    )
    compiled = compiled_time_parametrization("heavy-object", at_rest=True)
    slow = plans.motion.rate.copy()
    slow[:, [0, 1, -2, -1]] *= 0.5
    results = []
    for motion in (plans.motion, replace(plans.motion, rate=slow)):
        (found, meets_limits), (expected, expected_mask) = (
            each.parametrize(motion, obstacle_poses)
            for each in (compiled, interpreted_one)
        )
        agree = np.isclose(found.rate, expected.rate, rtol=1e-8).all(axis=1)
        assert (
            agree.sum() >= COUNT - 1
        )  # after a step back, rounding decides whether a bound is violated
        np.testing.assert_array_equal(meets_limits[agree], expected_mask[agree])
        assert (found.rate[:, [0, 1, -2, -1]] != motion.rate[:, [0, 1, -2, -1]]).all()
        results.append((found, meets_limits))
    (found, meets_limits), (twice, checked_again) = results
    assert meets_limits.any()
    assert not checked_again.all()
    timed = replace(plans, rate_control_points=found.rate)
    assert (
        evaluate_plans(timed, workers=1).valid[meets_limits].mean()
        >= evaluate_plans(plans, workers=1).valid.mean()
    )
    fixed = make_time_parametrization(given.problem, given.robot, kernels).parametrize(
        motion, obstacle_poses
    )[0]
    assert twice.duration().mean() < 0.99 * fixed.duration().mean()
    once = replace(interpreted_one, min_increase=np.inf).parametrize(
        motion, obstacle_poses
    )[0]
    assert twice.duration().mean() < once.duration().mean()


def test_coefficients_are_those_of_accelerations_torques_and_squared_velocity_fractions(
    given, time_parametrization
):
    """Pinocchio gives the expected values, for random paths and rates."""
    random, robot, count = np.random.default_rng(7), given.robot, 5
    data = robot.model.createData()
    column = random.normal(size=(3 * robot.n + 2, count))
    p, p1, p2, (r, r1) = (
        *column[: 3 * robot.n].reshape(3, robot.n, count),
        np.abs(column[3 * robot.n :]),
    )
    rest, square, mixed = time_parametrization.coefficients(
        np.concatenate([column, np.zeros((4, count))])
    )
    dq, ddq = p1 * r, p2 * r**2 + p1 * r1 * r
    torque = np.array(
        [
            pin.rnea(robot.model, data, *state).copy()
            for state in zip(p.T, dq.T, ddq.T, strict=True)
        ]
    ).T
    share = (np.abs(dq) / robot.velocity_limit[:, None]).max(axis=0, keepdims=True)
    expected = np.concatenate([ddq, torque, share**2])
    np.testing.assert_allclose(
        rest + square * r**2 + mixed * r * r1, expected, rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(
        time_parametrization.upper,
        [*robot.acceleration_limit, *robot.torque_limit, 1.0],
    )
    np.testing.assert_allclose(
        time_parametrization.lower,
        [*-robot.acceleration_limit, *-robot.torque_limit, -np.inf],
    )


def test_a_bound_that_is_not_proportional_to_velocities_has_its_own_row(given):
    """The square of the tip's speed is not proportional to velocities, and has no lower bound."""
    problem = replace(
        given.problem, constraint=(*given.problem.constraint, TipSpeed(highest=0.5))
    )
    bounds = speed_bounds(given.robot, problem)
    assert bounds.proportional.tolist() == [True] * 6 + [False] * 13
    lower, upper = coefficient_bounds(bounds)
    assert (lower[-2:].tolist(), upper[-2:].tolist()) == (
        [-np.inf, -np.inf],
        [0.25, 1.0],
    )


def test_the_smallest_root_is_that_of_numpy():
    random = np.random.default_rng(4)
    margin, linear, square = (
        np.abs(random.normal(size=200)),
        *random.normal(size=(2, 200)),
    )
    found = smallest(margin, linear, square)
    for each, *numbers in zip(found, square, linear, -margin, strict=True):
        roots = np.roots(numbers)
        right = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
        assert each == pytest.approx(right.min(initial=np.inf))


def test_rates_advance_to_the_first_bound():
    """One row, one motion, two phases: g = r^2 + r r', upper bound 1.8, from r = 1 and r' = 0 along (1, 0.2)."""
    coefficients = [np.full((1, 1, 2), each) for each in (0.0, 1.0, 1.0)]
    rates, along = (
        np.stack([np.ones((1, 2)), np.zeros((1, 2))]),
        np.array([[[1.0, 0.2]], [[1.0, 0.2]]]),
    )
    bounds = np.array([-np.inf]), np.array([1.8])
    found = advance(coefficients, bounds, rates, along)[0]
    assert (1 + found) * (1 + found) + (1 + found) * found == pytest.approx(1.8)
    assert (
        advance(coefficients, (bounds[0], np.array([9.0])), rates, along)[0]
        == MAX_RATE_INCREASE
    )
    back = advance(
        coefficients, (bounds[0], np.array([0.9])), rates, along[:, :, :1].repeat(2, 2)
    )[0]
    assert (1 + back) * (1 + back) + (1 + back) * back == pytest.approx(0.9)


def test_plans_with_bounded_jerk_cannot_be_time_parametrized(given):
    with is_refused(UsageError):
        make_time_parametrization(*jerk_limited("airhockey"), given.kernels)


def test_time_parametrization_is_enabled_by_the_model_and_disabled_by_the_planner(
    boundary,
):
    plain = untrained_model("airhockey", boundary)
    model = replace(plain, config=replace(plain.config, time_parametrized=True))
    time_parametrized, free, usual = (
        planner.plan_batch(boundary)
        for planner in (
            Planner(model),
            Planner(model, scale_time=False),
            Planner(plain),
        )
    )
    np.testing.assert_array_equal(free.rate_control_points, usual.rate_control_points)
    np.testing.assert_array_equal(
        time_parametrized.path_control_points, usual.path_control_points
    )
    assert (time_parametrized.rate_control_points != usual.rate_control_points).any()
