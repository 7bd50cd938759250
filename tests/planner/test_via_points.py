"""Other lines: what the look at plans finds, which line is taken, and that plans which break nothing stay."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.planner.inference_pipeline import (
    SLOW_DURATION,
    ViaPoints,
    loaded_problem,
    make_via_points,
)
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import load_model
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World
from tests.conftest import needs_compiled_code
from tests.examples.models import quickest
from tests.examples.plans import PROBLEMS, ROBOTS, load

RETRACTED = (-0.3, -0.6, 0.2, -1.9, 0.6, 0.3, 1.2)  # rad: far from both pedestals


@pytest.fixture(scope="module")
def model() -> Model:
    found = load_model("heavy-object-anywhere")
    return replace(found, config=replace(found.config, via_points=(RETRACTED,)))


@pytest.fixture(scope="module")
def problems() -> Boundary:
    return draw_boundary_problems("heavy-object-anywhere", 2000, seed=20).boundary


def test_static_violations_agree_with_pinocchio_and_coal() -> None:
    problem, robot, plan = (
        PROBLEMS["heavy-object"],
        ROBOTS["heavy-object"],
        load("transport"),
    )
    world, random = (
        World(robot, problem.obstacle, problem.object_size),
        np.random.default_rng(0),
    )
    obstacle_poses = plan.scene.poses[0]
    on_way = plan.motion.at(np.linspace(0, 1, 6)).q[0]
    states = np.concatenate(
        [
            random.uniform(robot.position_lower, robot.position_upper, (6, robot.n)),
            on_way,
        ]
    )
    via_points = make_via_points(
        problem, quickest("heavy-object").kernels, np.empty((0, robot.n))
    )
    q, found = (
        np.ascontiguousarray(states.T[:, None], np.float32),
        np.empty((1, 1, len(states)), np.float32),
    )
    poses = np.repeat(obstacle_poses[:, None], len(states), axis=1).astype(np.float32)
    via_points.static_violation(q, poses, out=[found])
    found = found[0, 0]
    for q, violation in zip(states, found, strict=True):
        world.set_state(q, 0 * q, 0 * q, obstacle_poses)
        worst = max(
            float(
                (
                    np.maximum(each.lower - each.g, each.g - each.upper)
                    / constraint.allowed(each)
                ).max()
            )
            for constraint in problem.constraint
            for each in constraint.measured(world)
        )
        assert violation == pytest.approx(worst, rel=1e-4, abs=1e-3)
    assert (found[:6] > 1).all()
    assert (found[6:] <= 1).all()


def test_candidates_are_lines_without_violation_or_else_the_one_with_the_smallest() -> (
    None
):
    violation = np.array([0.5, 2.0, 0.9, 7.0, 3.0, 5.0, np.inf, np.inf, 4.0])
    np.testing.assert_array_equal(ViaPoints.candidates(violation, 3), [0, 2, 4, 8])


@pytest.fixture(scope="module")
def checks() -> ViaPoints:
    """Three via points, with the check of heavy-object."""
    via_points = np.array(RETRACTED) + np.array([[0.8], [0.0], [0.3]])
    return make_via_points(
        PROBLEMS["heavy-object"], quickest("heavy-object").kernels, via_points
    )


def test_the_lower_bound_decides_like_the_violation(checks: ViaPoints) -> None:
    plan, random = load("transport"), np.random.default_rng(2)
    count = 40
    path = np.repeat(plan.motion.path, count, axis=0)
    path[:, 4:-3] += random.uniform(0, 0.05, (count, 1, 1)) * random.normal(
        size=path[:, 4:-3].shape
    )
    motion = Motion(
        path, np.repeat(plan.motion.rate, count, axis=0), plan.motion.degree
    )
    poses = np.repeat(plan.scene.poses, count, axis=0)
    violation, bound = (
        checks.violation(motion, poses),
        checks.lower_bound(motion, poses),
    )
    assert 0 < (violation > 1).sum() < count
    np.testing.assert_array_equal(bound > 1, violation > 1)
    eps = np.finfo(np.float32).eps
    assert (
        bound <= violation * (1 + 64 * eps)
    ).all()  # both in single precision, of different batches


def test_the_best_lines_have_the_smallest_violations(checks: ViaPoints) -> None:
    plan = load("transport")
    tasks = BoundaryLayer("heavy-object").tasks(plan.boundary)
    assert tasks.correction is not None
    lines = tasks.take(np.zeros(6, int))
    assert lines.correction is not None
    offsets = np.array(
        [0.6, 0.0, 0.1, 0.0, 0.9, 0.3]
    )  # rad; from the projected line, of two tasks
    lines = replace(lines, correction=lines.correction + offsets[:, None, None])
    np.testing.assert_array_equal(checks.best_lines(lines, 2), [1, 2, 3, 5])


@pytest.mark.slow  # it compiles for a minute
@needs_compiled_code
def test_via_points_repair_plans_and_keep_those_without_violation(
    model: Model, problems: Boundary
) -> None:
    straight = Planner(
        replace(model, config=replace(model.config, via_points=()))
    ).plan_batch(problems)
    planner = Planner(model)
    found, inference = planner.plan_batch(problems), planner._inference
    assert inference.via_points is not None
    obstacle_poses = found.scene.poses
    before, after = (
        inference.via_points.violation(plans.motion, obstacle_poses)
        for plans in (straight, found)
    )
    same = (found.path_control_points == straight.path_control_points).all(axis=(1, 2))
    slow = (
        straight.motion.duration_bound()
        > SLOW_DURATION * inference.prepare(problems).expected_time
    )
    assert same[(before <= 1) & ~slow].all()
    nearer = ~same & (before <= 1)
    assert nearer.sum() >= 10
    assert (after[nearer] <= 1).all()
    assert (found.duration[nearer] < straight.duration[nearer]).all()
    assert found.duration[nearer].mean() < 0.8 * straight.duration[nearer].mean()
    assert (after[~same & ~nearer] < before[~same & ~nearer]).all()
    repaired = np.flatnonzero((before > 1) & (after <= 1))
    assert len(repaired) >= 10
    assert evaluate_plans(found[repaired], workers=1).valid.mean() > 0.5
    certain = repaired[
        before[repaired] > np.sqrt(2)
    ]  # the planner limits the components of the tilt, conservatively
    assert not evaluate_plans(straight[certain], workers=1).valid.any()


@needs_compiled_code
@pytest.mark.slow  # it compiles for a minute
def test_a_line_through_a_via_point_passes_near_it_and_keeps_its_ends(
    model: Model, problems: Boundary
) -> None:
    with loaded_problem(model.problem) as loaded:
        prepare = Planner(model)._inference.prepare
        lower, upper = loaded.robot.position_lower, loaded.robot.position_upper
    some, via_point = problems[:20], np.tile(RETRACTED, (20, 1))
    straight, projected = prepare(some), prepare(some, via_point)
    assert straight.correction is not None
    assert projected.correction is not None
    half = (some.start_q + some.goal_q) / 2
    before, after = (
        np.abs(half + each.correction[:, 4:6].mean(axis=1) - via_point)
        for each in (straight, projected)
    )
    assert np.median(after.max(axis=1)) < 0.6 * np.median(before.max(axis=1))
    ends = np.linspace(0, 1, 10)[:, None]
    line = (
        some.start_q[:, None]
        + (some.goal_q - some.start_q)[:, None] * ends
        + projected.correction
    )
    assert (line >= lower - 1e-9).all()
    assert (line <= upper + 1e-9).all()
