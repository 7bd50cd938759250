"""Pacing: rates go as far as the limits, paths and ends stay, and what limits do not allow is slower."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import UsageError
from cnpgen.planner.expressions import coefficient_bounds, speed_bounds
from cnpgen.planner.pacing import MOST, Pacing, advance, make_pacing, smallest
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import make_plans
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.trajectory.motion import Motion
from tests.conftest import columns_of, needs_compiler
from tests.examples.constraints import TipSpeed
from tests.examples.jerky import jerky
from tests.examples.models import boundary_of_columns, interpreted, surroundings_of, untrained_model
from tests.planner.test_parts import LIMITS

COUNT = 8
TOPS = np.empty((COUNT, 0))


@pytest.fixture(scope="module")
def given():
    return surroundings_of("airhockey")


@pytest.fixture(scope="module")
def boundary(tiny):
    return boundary_of_columns(columns_of(tiny("airhockey-replan")), COUNT)


@pytest.fixture(scope="module")
def motion(boundary) -> Motion:
    """Plans as the network of a shipped planner has them."""
    return Planner("airhockey-replan", backend="numpy").plan_batch(boundary).motion


@pytest.fixture(scope="module")
def pacing(given):
    return make_pacing(given.problem, given.robot, interpreted(given).kernels)


def severities(given, boundary, motion: Motion) -> np.ndarray:
    """How much of what is allowed plans use at most, by the verdict; above 1 they break it."""
    plans = make_plans(given.record, boundary, path_control_points=motion.path, rate_control_points=motion.rate)
    verdicts = evaluate_plans(plans, workers=1).verdicts
    return np.array([max(verdict.margins[name].severity for name in LIMITS) for verdict in verdicts])


def quickened(motion: Motion, factor: float) -> Motion:
    """The same with rates that are larger but at the ends."""
    rate = motion.rate.copy()
    rate[:, 2:-2] *= factor
    return replace(motion, rate=rate)


def test_motions_become_faster_until_a_limit_is_met(given, boundary, motion, pacing):
    found = pacing.paced(motion, TOPS)
    fits = severities(given, boundary, motion) <= 1
    assert fits.sum() > COUNT / 2
    assert (found.duration()[fits] < 0.99 * motion.duration()[fits]).all()
    assert (severities(given, boundary, found)[fits] <= 1).all()
    assert (severities(given, boundary, quickened(found, 1.05))[fits] > 1).mean() > 0.5


def test_path_and_ends_stay(motion, pacing):
    found = pacing.paced(motion, TOPS)
    np.testing.assert_array_equal(found.path, motion.path)
    np.testing.assert_array_equal(found.rate[:, [0, 1, -2, -1]], motion.rate[:, [0, 1, -2, -1]])
    assert (found.rate[:, 2:-2] != motion.rate[:, 2:-2]).any(axis=1).all()


def test_motions_that_are_too_fast_between_their_ends_become_slower(given, boundary, motion, pacing):
    paced = pacing.paced(motion, TOPS)
    good = severities(given, boundary, paced) <= 1
    fast = quickened(paced, 1.15)
    before = severities(given, boundary, fast)
    after = severities(given, boundary, pacing.paced(fast, TOPS))
    broken = good & (before > 1)
    assert broken.sum() > COUNT / 2
    assert (after <= before).all()
    assert (after[broken] <= 1).mean() > 0.5


def test_a_motion_that_would_be_further_out_than_before_stays_as_it_was(motion, pacing):
    """The excess has the last word: here pacing itself believes in limits twice as large."""
    wide = replace(pacing, lower=2 * pacing.lower, upper=2 * pacing.upper)
    slow = quickened(pacing.paced(motion, TOPS), 0.9)
    np.testing.assert_array_equal(wide.paced(slow, TOPS).rate, slow.rate)


def test_a_motion_that_is_none_touches_no_other(motion, pacing):
    rate = motion.rate.copy()
    rate[3] = np.nan
    found, expected = pacing.paced(replace(motion, rate=rate), TOPS), pacing.paced(motion, TOPS)
    others = [0, 1, 2, *range(4, COUNT)]
    np.testing.assert_array_equal(found.rate[others], expected.rate[others])


def compiled_pacing(name: str) -> Pacing:
    given = surroundings_of(name)
    found = make_pacing(given.problem, given.robot, given.kernels)
    assert found.library is not None
    return found


@needs_compiler
def test_compiled_and_interpreted_pacing_agree(motion, pacing):
    compiled = compiled_pacing("airhockey")
    assert pacing.library is None
    for each in (motion, quickened(motion, 3.0)):
        np.testing.assert_allclose(compiled.paced(each, TOPS).rate, pacing.paced(each, TOPS).rate, rtol=1e-8)
    wide = [replace(each, lower=2 * each.lower, upper=2 * each.upper) for each in (compiled, pacing)]
    slow = quickened(pacing.paced(motion, TOPS), 0.9)
    np.testing.assert_array_equal(*(each.paced(slow, TOPS).rate for each in wide))
    np.testing.assert_array_equal(wide[0].paced(slow, TOPS).rate, slow.rate)
    broken = replace(motion, rate=np.where(np.arange(COUNT)[:, None] == 3, np.nan, motion.rate))
    found = compiled.paced(broken, TOPS).rate
    np.testing.assert_array_equal(np.delete(found, 3, axis=0), np.delete(compiled.paced(motion, TOPS).rate, 3, axis=0))
    assert np.isnan(found[3]).all()


@needs_compiler
@pytest.mark.slow
def test_compiled_and_interpreted_pacing_agree_among_obstacles(tiny):
    """Only there has a state more numbers than the motion; compiling its kernels takes some seconds."""
    given, boundary = surroundings_of("heavy-object"), boundary_of_columns(columns_of(tiny("heavy-object")), COUNT)
    plans = Planner("heavy-object", backend="numpy").plan_batch(boundary)
    tops = obstacle_tops(given.problem, plans.columns["start_xyz"], plans.columns["goal_xyz"])
    assert tops.size
    calm = make_pacing(given.problem, given.robot, interpreted(given).kernels)
    found = compiled_pacing("heavy-object").paced(plans.motion, tops).rate
    np.testing.assert_allclose(found, calm.paced(plans.motion, tops).rate, rtol=1e-8)
    assert (found != plans.motion.rate).any()


def test_coefficients_are_those_of_accelerations_torques_and_squared_shares_of_velocities(given, pacing):
    """By Pinocchio, of random paths and rates."""
    random, robot, count = np.random.default_rng(7), given.robot, 5
    data = robot.model.createData()
    column = random.normal(size=(3 * robot.n + 2, count))
    p, p1, p2, (r, r1) = *column[: 3 * robot.n].reshape(3, robot.n, count), np.abs(column[3 * robot.n :])
    rest, square, mixed = pacing.coefficients(column)
    dq, ddq = p1 * r, p2 * r**2 + p1 * r1 * r
    torque = np.array([pin.rnea(robot.model, data, *state).copy() for state in zip(p.T, dq.T, ddq.T, strict=True)]).T
    share = (np.abs(dq) / robot.velocity_limit[:, None]).max(axis=0, keepdims=True)
    expected = np.concatenate([ddq, torque, share**2])
    np.testing.assert_allclose(rest + square * r**2 + mixed * r * r1, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(pacing.upper, [*robot.acceleration_limit, *robot.torque_limit, 1.0])
    np.testing.assert_allclose(pacing.lower, [*-robot.acceleration_limit, *-robot.torque_limit, -np.inf])


def test_a_bound_of_something_else_than_a_velocity_keeps_a_row_of_its_own(given):
    """The square of the tip's speed is none that is proportional to velocities, and has no lower bound."""
    problem = replace(given.problem, constraint=(*given.problem.constraint, TipSpeed(highest=0.5)))
    bounds = speed_bounds(given.robot, problem)
    assert bounds.proportional.tolist() == [True] * 6 + [False] * 13
    lower, upper = coefficient_bounds(bounds)
    assert (lower[-2:].tolist(), upper[-2:].tolist()) == ([-np.inf, -np.inf], [0.25, 1.0])


def test_the_smallest_root_is_that_of_numpy():
    random = np.random.default_rng(4)
    room, linear, square = np.abs(random.normal(size=200)), *random.normal(size=(2, 200))
    found = smallest(room, linear, square)
    for each, *numbers in zip(found, square, linear, -room, strict=True):
        roots = np.roots(numbers)
        right = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
        assert each == pytest.approx(right.min(initial=np.inf))


def test_rates_go_on_to_the_first_bound():
    """One row, one motion, two phases: g = r^2 + r r', upper bound 1.8, from r = 1 and r' = 0 along (1, 0.2)."""
    coefficients = [np.full((1, 1, 2), each) for each in (0.0, 1.0, 1.0)]
    rates, along = np.stack([np.ones((1, 2)), np.zeros((1, 2))]), np.array([[[1.0, 0.2]], [[1.0, 0.2]]])
    bounds = np.array([-np.inf]), np.array([1.8])
    found = advance(coefficients, bounds, rates, along)[0]
    assert (1 + found) * (1 + found) + (1 + found) * found == pytest.approx(1.8)
    assert advance(coefficients, (bounds[0], np.array([9.0])), rates, along)[0] == MOST
    back = advance(coefficients, (bounds[0], np.array([0.9])), rates, along[:, :, :1].repeat(2, 2))[0]
    assert (1 + back) * (1 + back) + (1 + back) * back == pytest.approx(0.9)


def test_plans_whose_jerk_is_bounded_are_not_paced(given):
    with pytest.raises(UsageError, match="cannot be paced: its jerk is bounded"):
        make_pacing(*jerky("airhockey"), given.kernels)


def test_only_models_that_say_so_are_paced_and_no_plan_where_that_is_not_wanted(boundary):
    plain = untrained_model("airhockey", boundary)
    model = replace(plain, meaning=replace(plain.meaning, paced=True))
    paced, free, usual = (
        planner.plan_batch(boundary) for planner in (Planner(model), Planner(model, slow_down=False), Planner(plain))
    )
    np.testing.assert_array_equal(free.rate_control_points, usual.rate_control_points)
    np.testing.assert_array_equal(paced.path_control_points, usual.path_control_points)
    assert (paced.rate_control_points != usual.rate_control_points).any()
