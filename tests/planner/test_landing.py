"""The landing: plans are on the manifold behind it, boundary control points stay, gradients are exact."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.planner.control_points import control_points
from cnpgen.planner.kit import make_kit
from cnpgen.planner.landing import make_landing
from cnpgen.planner.preparation import ends_of, lanes, rows
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from tests.conftest import columns_of, needs_compiler, some
from tests.examples.models import (
    accelerated,
    boundary_of_columns,
    interpreted,
    landing_of,
    meaning_of,
    quickest,
    surroundings_of,
)
from tests.planner.test_parts import heights, worst_tilt

DATASETS = {"airhockey": "airhockey-replan", "heavy-object": "heavy-object"}


FIXED = [("airhockey", 2), ("airhockey", 3), ("heavy-object", 2)]  # control points at the goal


def nearby(tiny, name: str, count: int = 8, fixed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Paths near the manifold, as a network gives them, and heights of obstacles."""
    given, boundary = quickest(name, fixed), drawn(tiny, name, count, fixed)
    kit = make_kit(given, meaning_of(1, 0), slow_down=False, fixed_at_goal=fixed)
    tasks, spec = kit.prepare(boundary), given.problem.trajectory
    rate = np.repeat(1 / tasks.expected_time[:, None], 20, axis=1)
    interior = anchor_line(boundary, rate, spec) + tasks.correction
    interior += 0.05 * np.random.default_rng(0).uniform(-1, 1, interior.shape)
    return assemble(boundary, interior, rate, spec), kit.prepare.tops(tasks.start_xyz, tasks.goal_xyz)


def drawn(tiny, name: str, count: int, fixed: int) -> Boundary:
    """Boundary conditions with an acceleration at the goal where it fixes three control points."""
    boundary = boundary_of_columns(columns_of(tiny(DATASETS[name])), count)
    return boundary if fixed == 2 else accelerated(boundary)


@pytest.mark.parametrize("fixed", some([2, 3], 1, "slow"))
def test_a_plan_near_the_table_is_on_it_behind_the_landing(tiny, fixed):
    path, tops = nearby(tiny, "airhockey", fixed=fixed)
    before, after = heights(path), heights(landing_of("airhockey", fixed).land(path, tops))
    assert np.median(before) > 0.01
    assert np.median(after) < 0.05 * np.median(before)
    assert (after < 0.3 * before).all()


@pytest.mark.slow
def test_an_object_that_is_nearly_upright_is_so_behind_the_landing(tiny):
    path, tops = nearby(tiny, "heavy-object", 4)
    landed = landing_of("heavy-object").land(path, tops)
    before, after = ([worst_tilt("heavy-object", each) for each in paths] for paths in (path, landed))
    assert np.median(before) > 0.03
    assert np.max(after) < 0.2 * np.median(before)


@pytest.mark.parametrize(("name", "fixed"), some(FIXED, 1, "slow"))
def test_boundary_control_points_stay_and_the_given_path_is_not_changed(tiny, name, fixed):
    path, tops = nearby(tiny, name, fixed=fixed)
    given, ends = path.copy(), [0, 1, 2, *range(15 - fixed, 15)]
    landed = landing_of(name, fixed).land(path, tops)
    np.testing.assert_array_equal(path, given)
    np.testing.assert_array_equal(landed[:, ends], path[:, ends])
    assert (landed[:, 3 : 15 - fixed] != path[:, 3 : 15 - fixed]).any(axis=(0, 2)).all()
    assert landing_of(name, fixed).land(path.astype(np.float32), tops).dtype == np.float32


@pytest.mark.slow
def test_a_landing_within_the_joint_limits_ends_on_them_at_most_and_its_gradients_are_exact(tiny):
    path, tops = nearby(tiny, "airhockey")
    given = interpreted(surroundings_of("airhockey"))
    low, high = landing_of("airhockey").land(path, tops)[:, 3:13].min(axis=(0, 1)), given.robot.position_upper
    robot = replace(given.robot, position_lower=low + 0.02)  # so that some control points are put back
    kernels = replace(given.kernels, identity="narrow", arguments={**given.kernels.arguments, "robot": robot})
    landing = make_landing(given.problem, kernels, steps=1, within_limits=True)
    landed, random = landing.land(path, tops)[:, 3:13], np.random.default_rng(1)
    assert (landed >= robot.position_lower - 1e-12).all()
    assert (landed <= high).all()
    assert (np.abs(landed - robot.position_lower) < 1e-12).any()
    gradient, direction = random.normal(size=(2, *path.shape))
    above, below = (landing.land(path + step * direction, tops) for step in (1e-6, -1e-6))
    found = ((above - below) * gradient).sum(axis=(1, 2)) / 2e-6
    np.testing.assert_allclose(
        (landing.pull_back(path, tops, gradient) * direction).sum(axis=(1, 2)), found, rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize(("name", "fixed"), some(FIXED, 1, "slow"))
def test_gradients_behind_the_landing_are_taken_back_exactly(tiny, name, fixed):
    path, tops = nearby(tiny, name, 3, fixed)
    landing, random = landing_of(name, fixed), np.random.default_rng(1)
    gradient = random.normal(size=path.shape)
    back = landing.pull_back(path, tops, gradient)
    for direction in random.normal(size=(6, *path.shape)):
        step = 1e-6 * direction
        high, low = (landing.land(path + sign * step, tops) for sign in (1, -1))
        found = ((high - low) * gradient).sum(axis=(1, 2)) / 2e-6
        np.testing.assert_allclose((back * direction).sum(axis=(1, 2)), found, rtol=1e-5, atol=1e-6)


@needs_compiler
@pytest.mark.extended
def test_the_landing_of_transports_is_the_same_compiled_and_interpreted(tiny):
    path, tops = nearby(tiny, "heavy-object", 3)
    given, gradient = surroundings_of("heavy-object"), np.random.default_rng(1).normal(size=path.shape)
    compiled, interpreted = make_landing(given.problem, given.kernels, steps=1), landing_of("heavy-object")
    np.testing.assert_allclose(compiled.land(path, tops), interpreted.land(path, tops), rtol=0, atol=1e-8)
    found, expected = (each.pull_back(path, tops, gradient) for each in (compiled, interpreted))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)  # rounding, after an inverse


def test_a_plan_that_is_not_finite_does_not_touch_the_others(tiny):
    path, tops = nearby(tiny, "airhockey")
    landing, broken = landing_of("airhockey"), path.copy()
    broken[2, 5] = np.nan
    found, expected = landing.land(broken, tops), landing.land(path, tops)
    others = [0, 1, *range(3, 8)]
    np.testing.assert_array_equal(found[others], expected[others])
    assert np.isnan(found[2]).any()


@pytest.mark.parametrize(("name", "fixed"), some(FIXED, 1, "slow"))
def test_the_planners_kernel_gives_the_paths_that_training_sees(tiny, name, fixed):
    given, boundary = quickest(name, fixed), drawn(tiny, name, 8, fixed)
    kit = make_kit(given, meaning_of(1, 1), slow_down=False, fixed_at_goal=fixed)
    tasks, random = kit.prepare(boundary), np.random.default_rng(2)
    phi, log_rate = random.uniform(-1, 1, (8, (12 - fixed) * given.robot.n)), random.normal(0, 0.3, (8, 20))
    points = control_points(tasks, phi, log_rate, scale=0.1, spec=given.problem.trajectory)
    tops = kit.prepare.tops(tasks.start_xyz, tasks.goal_xyz)
    expected = landing_of(name, fixed).land(points.path, tops)
    offsets = 0.1 * phi + tasks.correction.reshape(8, -1)
    (found,) = kit.path(ends_of(boundary), lanes(offsets), lanes(points.rate), lanes(tops))
    np.testing.assert_allclose(rows(found, given.robot.n), expected, atol=1e-10)


@pytest.mark.parametrize(("name", "fixed"), some(FIXED[1:], 0, "slow"))
def test_the_bent_line_is_the_papers_line_bent(tiny, name, fixed):
    given, boundary = quickest(name, fixed), drawn(tiny, name, 5, fixed)
    kit = make_kit(given, meaning_of(1, 0), slow_down=False, fixed_at_goal=fixed)
    tasks = kit.prepare(boundary)
    rate, spec = np.repeat(1 / tasks.expected_time[:, None], 20, axis=1), given.problem.trajectory
    line = anchor_line(boundary, rate, spec)
    tops = kit.prepare.tops(tasks.start_xyz, tasks.goal_xyz)
    bent = landing_of(name, fixed).land(assemble(boundary, line, rate, spec), tops)
    np.testing.assert_allclose(tasks.correction, bent[:, 3 : 15 - fixed] - line, atol=1e-12)
