"""The projection: paths are on the manifold afterwards, boundary control points stay, gradients are exact."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.planner.control_points import control_points, make_projection
from cnpgen.planner.inference_pipeline import make_inference_pipeline
from cnpgen.planner.tasks import ends_of, lanes, rows
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from tests.conftest import columns_of, needs_compiled_code, some
from tests.examples.models import (
    accelerated,
    boundary_of_columns,
    config_of,
    interpreted,
    loaded_problem_of,
    projection_of,
    quickest,
)
from tests.planner.test_parts import heights, worst_tilt

DATASETS = {"airhockey": "airhockey-replan", "heavy-object": "heavy-object"}


FIXED = [
    ("airhockey", 2),
    ("airhockey", 3),
    ("heavy-object", 2),
]  # control points at the goal


def nearby(
    tiny, name: str, count: int = 8, fixed: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """Return paths near the manifold, like those of a network, and obstacle poses."""
    given, boundary = quickest(name, fixed), drawn(tiny, name, count, fixed)
    inference = make_inference_pipeline(
        given, config_of(1, 0), scale_time=False, fixed_at_goal=fixed
    )
    tasks, spec = inference.prepare(boundary), given.problem.trajectory
    rate = np.repeat(1 / tasks.expected_time[:, None], 20, axis=1)
    interior = anchor_line(boundary, rate, spec) + tasks.correction
    interior += 0.05 * np.random.default_rng(0).uniform(-1, 1, interior.shape)
    return assemble(boundary, interior, rate, spec), tasks.scene.poses


def drawn(tiny, name: str, count: int, fixed: int) -> Boundary:
    """Return boundary conditions, with an acceleration at the goal if it fixes three control points."""
    boundary = boundary_of_columns(columns_of(tiny(DATASETS[name])), count)
    return boundary if fixed == 2 else accelerated(boundary)


@pytest.mark.parametrize("fixed", some([2, 3], 1, "slow"))
def test_projection_moves_a_path_near_the_table_onto_it(tiny, fixed):
    path, obstacle_poses = nearby(tiny, "airhockey", fixed=fixed)
    before, after = (
        heights(path),
        heights(projection_of("airhockey", fixed).project(path, obstacle_poses)),
    )
    assert np.median(before) > 0.01
    assert np.median(after) < 0.05 * np.median(before)
    assert (after < 0.3 * before).all()


@pytest.mark.slow
def test_projection_moves_a_nearly_upright_object_upright(tiny):
    path, obstacle_poses = nearby(tiny, "heavy-object", 4)
    projected = projection_of("heavy-object").project(path, obstacle_poses)
    before, after = (
        [worst_tilt("heavy-object", each) for each in paths]
        for paths in (path, projected)
    )
    assert np.median(before) > 0.03
    assert np.max(after) < 0.2 * np.median(before)


@pytest.mark.parametrize(("name", "fixed"), some(FIXED, 1, "slow"))
def test_projection_keeps_boundary_control_points_and_its_argument(tiny, name, fixed):
    path, obstacle_poses = nearby(tiny, name, fixed=fixed)
    given, ends = path.copy(), [0, 1, 2, *range(15 - fixed, 15)]
    projected = projection_of(name, fixed).project(path, obstacle_poses)
    np.testing.assert_array_equal(path, given)
    np.testing.assert_array_equal(projected[:, ends], path[:, ends])
    assert (
        (projected[:, 3 : 15 - fixed] != path[:, 3 : 15 - fixed]).any(axis=(0, 2)).all()
    )
    assert (
        projection_of(name, fixed)
        .project(path.astype(np.float32), obstacle_poses)
        .dtype
        == np.float32
    )


@pytest.mark.slow
def test_a_projection_within_joint_limits_stays_within_them_and_has_exact_gradients(
    tiny,
):
    path, obstacle_poses = nearby(tiny, "airhockey")
    given = interpreted(loaded_problem_of("airhockey"))
    low, high = (
        projection_of("airhockey")
        .project(path, obstacle_poses)[:, 3:13]
        .min(axis=(0, 1)),
        given.robot.position_upper,
    )
    robot = replace(
        given.robot, position_lower=low + 0.02
    )  # so that some control points are clipped
    kernels = replace(
        given.kernels,
        identity="narrow",
        arguments={**given.kernels.arguments, "robot": robot},
    )
    projection = make_projection(given.problem, kernels, steps=1, within_limits=True)
    projected, random = (
        projection.project(path, obstacle_poses)[:, 3:13],
        np.random.default_rng(1),
    )
    assert (projected >= robot.position_lower - 1e-12).all()
    assert (projected <= high).all()
    assert (np.abs(projected - robot.position_lower) < 1e-12).any()
    gradient, direction = random.normal(size=(2, *path.shape))
    above, below = (
        projection.project(path + step * direction, obstacle_poses)
        for step in (1e-6, -1e-6)
    )
    found = ((above - below) * gradient).sum(axis=(1, 2)) / 2e-6
    np.testing.assert_allclose(
        (projection.vjp(path, obstacle_poses, gradient) * direction).sum(axis=(1, 2)),
        found,
        rtol=1e-4,
        atol=1e-5,
    )


@pytest.mark.parametrize(("name", "fixed"), some(FIXED, 1, "slow"))
def test_the_vjp_of_the_projection_agrees_with_finite_differences(tiny, name, fixed):
    path, obstacle_poses = nearby(tiny, name, 3, fixed)
    projection, random = projection_of(name, fixed), np.random.default_rng(1)
    gradient = random.normal(size=path.shape)
    back = projection.vjp(path, obstacle_poses, gradient)
    for direction in random.normal(size=(6, *path.shape)):
        step = 1e-6 * direction
        high, low = (
            projection.project(path + sign * step, obstacle_poses) for sign in (1, -1)
        )
        found = ((high - low) * gradient).sum(axis=(1, 2)) / 2e-6
        np.testing.assert_allclose(
            (back * direction).sum(axis=(1, 2)), found, rtol=1e-5, atol=1e-6
        )


@needs_compiled_code
@pytest.mark.extended
def test_compiled_and_interpreted_projections_of_transports_agree(tiny):
    path, obstacle_poses = nearby(tiny, "heavy-object", 3)
    given, gradient = (
        loaded_problem_of("heavy-object"),
        np.random.default_rng(1).normal(size=path.shape),
    )
    compiled, interpreted = (
        make_projection(given.problem, given.kernels, steps=1),
        projection_of("heavy-object"),
    )
    np.testing.assert_allclose(
        compiled.project(path, obstacle_poses),
        interpreted.project(path, obstacle_poses),
        rtol=0,
        atol=1e-8,
    )
    found, expected = (
        each.vjp(path, obstacle_poses, gradient) for each in (compiled, interpreted)
    )
    np.testing.assert_allclose(
        found, expected, rtol=1e-6, atol=1e-7
    )  # rounding, after an inverse


def test_a_path_that_is_not_finite_does_not_affect_other_paths(tiny):
    path, obstacle_poses = nearby(tiny, "airhockey")
    projection, broken = projection_of("airhockey"), path.copy()
    broken[2, 5] = np.nan
    found, expected = (
        projection.project(broken, obstacle_poses),
        projection.project(path, obstacle_poses),
    )
    others = [0, 1, *range(3, 8)]
    np.testing.assert_array_equal(found[others], expected[others])
    assert np.isnan(found[2]).any()


@pytest.mark.parametrize(("name", "fixed"), some(FIXED, 1, "slow"))
def test_the_planners_kernel_and_training_give_the_same_paths(tiny, name, fixed):
    given, boundary = quickest(name, fixed), drawn(tiny, name, 8, fixed)
    inference = make_inference_pipeline(
        given, config_of(1, 1), scale_time=False, fixed_at_goal=fixed
    )
    tasks, random = inference.prepare(boundary), np.random.default_rng(2)
    phi, log_rate = (
        random.uniform(-1, 1, (8, (12 - fixed) * given.robot.n)),
        random.normal(0, 0.3, (8, 20)),
    )
    points = control_points(
        tasks, phi, log_rate, scale=0.1, spec=given.problem.trajectory
    )
    obstacle_poses = tasks.scene.poses
    expected = projection_of(name, fixed).project(points.path, obstacle_poses)
    offsets = 0.1 * phi + tasks.correction.reshape(8, -1)
    (found,) = inference.path(
        ends_of(boundary), lanes(offsets), lanes(points.rate), lanes(obstacle_poses)
    )
    np.testing.assert_allclose(rows(found, given.robot.n), expected, atol=1e-10)


@pytest.mark.parametrize(("name", "fixed"), some(FIXED[1:], 0, "slow"))
def test_the_projected_line_is_the_projection_of_the_papers_line(tiny, name, fixed):
    given, boundary = quickest(name, fixed), drawn(tiny, name, 5, fixed)
    inference = make_inference_pipeline(
        given, config_of(1, 0), scale_time=False, fixed_at_goal=fixed
    )
    tasks = inference.prepare(boundary)
    rate, spec = (
        np.repeat(1 / tasks.expected_time[:, None], 20, axis=1),
        given.problem.trajectory,
    )
    line = anchor_line(boundary, rate, spec)
    obstacle_poses = tasks.scene.poses
    projected = projection_of(name, fixed).project(
        assemble(boundary, line, rate, spec), obstacle_poses
    )
    np.testing.assert_allclose(
        tasks.correction, projected[:, 3 : 15 - fixed] - line, atol=1e-12
    )
