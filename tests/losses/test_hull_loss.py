"""The loss of distances from obstacles that samples place: values, gradients, and what it does not depend on."""

import numpy as np
import pytest

from cnpgen.kernels.collision.clearance_loss import ClearanceLoss
from cnpgen.kernels.collision.collision_checker import (
    CollisionChecker,
    load_collision_library,
)
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.plans.scene_plans import shape_of, with_capacity
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.scenes.scene_problem import make_mesh
from cnpgen.robots.observation.primitives import scene_primitives
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.solid import number_slices, place_obstacles
from tests.conftest import needs_compiled_code
from tests.examples.clearance_reference import ClearanceLossReference
from tests.examples.shaped_robot import write_problem

pytestmark = needs_compiled_code

SCENE = (
    Obstacle(
        name="wall",
        kind="box",
        position=(0.5, 0.0, 0.15),
        size=(0.1, 0.5, 0.3),
        rotation=(0, 0, 0.3),
    ),
    Obstacle(name="ball", kind="sphere", position=(0.3, 0.35, 0.55), radius=0.08),
    Obstacle(
        name="post",
        kind="cylinder",
        position=(0.4, -0.3, 0.3),
        radius=0.05,
        length=0.6,
        rotation=(0.2, 0, 0),
    ),
    make_mesh(
        "rock",
        0.1 * CUBE[1:] + 0.05,
        np.array((0.1, -0.4, 0.4)),
        turned(0.3, 0.4, 0.5),
        place="",
    ),
    Obstacle(
        name="rail",
        kind="capsule",
        position=(0.2, 0.4, 0.4),
        radius=0.03,
        length=0.4,
        rotation=(0, 1.0, 0),
    ),
)
REQUIRED = 0.05


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return load_problem(write_problem(tmp_path_factory.mktemp("crane")))


def states(robot, count: int) -> np.ndarray:
    random = np.random.default_rng(0)
    return random.uniform(robot.position_lower, robot.position_upper, (count, robot.n))


def test_losses_of_states_are_those_of_measured_distances(problem):
    robot, kernels = load_robot(problem), KernelLibrary(*choose_backend("compiled"), "")
    q, bodies = states(robot, 200), scene_primitives([SCENE])
    losses, gradients = ClearanceLoss(load_collision_library(kernels), robot)(
        q[:, :, None], bodies, REQUIRED
    )
    checker = CollisionChecker(load_collision_library(kernels), robot)
    checker.place(SCENE, place_obstacles(SCENE))
    close = checker.close_bodies(q.T, REQUIRED, of_obstacles=True)
    expected = np.bincount(close.k, (REQUIRED - close.distance) ** 2 / 2, minlength=200)
    assert (expected > 0).mean() > 0.1
    np.testing.assert_allclose(
        losses[:, 0], expected, rtol=2e-2, atol=1e-5
    )  # cylinders there contain the judges' prism
    step, e = np.random.default_rng(1).normal(size=q.shape), 1e-6
    loss = ClearanceLoss(load_collision_library(kernels), robot)
    above, below = (
        loss((q + s * e * step)[:, :, None], bodies, REQUIRED)[0] for s in (1, -1)
    )
    numeric, analytic = (
        (above - below)[:, 0] / (2 * e),
        (gradients[:, :, 0] * step).sum(axis=1),
    )
    assert (
        np.percentile(np.abs(numeric - analytic), 95) < 1e-6
    )  # normals of deep contacts may jump


def test_losses_of_states_are_those_of_pinocchio_and_coal(problem):
    robot, kernels = load_robot(problem), KernelLibrary(*choose_backend("compiled"), "")
    q, obstacles = (
        states(robot, 120).T.reshape(1, robot.n, 120),
        scene_primitives([SCENE] * 100 + [SCENE[:2]] * 20),
    )
    q[0, 0, 7] = np.nan
    losses, gradients = ClearanceLoss(load_collision_library(kernels), robot)(
        q, obstacles, REQUIRED
    )
    expected, derivatives = ClearanceLossReference(robot)(q, obstacles, REQUIRED)
    assert (expected > 0).mean() > 0.1
    np.testing.assert_allclose(losses, expected, rtol=1e-4, atol=1e-7)
    error = np.abs(gradients - derivatives).max(axis=1)
    assert np.nanpercentile(error, 95) < 1e-4  # normals of deep contacts may differ
    assert np.isnan([losses[0, 7], expected[0, 7]]).all()


def test_with_interpreted_kernels_the_loss_of_plans_is_the_same(problem):
    full = with_capacity(
        problem.with_obstacles(()), dict.fromkeys(map(shape_of, SCENE), 1)
    )
    poses, (path, rate) = np.stack([scene_poses(full, SCENE)] * 4), plans(full, 4)
    values = [
        PlanLoss(full, dtype="float64", nodes=16, backend=backend)
        for backend in ("compiled", "numpy")
    ]
    compiled, interpreted = (
        loss(path, rate, weights=loss.weights0, obstacle_poses=poses) for loss in values
    )
    np.testing.assert_allclose(interpreted.terms, compiled.terms, rtol=1e-4, atol=1e-7)
    difference = np.abs(interpreted.path_gradient - compiled.path_gradient).max()
    assert difference < 1e-2 * np.abs(compiled.path_gradient).max()


def scene_poses(full, obstacles) -> np.ndarray:
    """Return poses with each obstacle at the first parked one of its kind."""
    poses, free = place_obstacles(full.obstacle), list(range(len(full.obstacle)))
    for obstacle in obstacles:
        index = next(i for i in free if full.obstacle[i].kind == obstacle.kind)
        free.remove(index)
        poses[number_slices(full.obstacle)[index]] = place_obstacles([obstacle])
    return poses


def plans(full, count: int) -> tuple[np.ndarray, np.ndarray]:
    random, robot, spec = np.random.default_rng(2), load_robot(full), full.trajectory
    ends = states(robot, 2 * count).reshape(2, count, 1, robot.n)
    path = (
        ends[0]
        + (ends[1] - ends[0]) * np.linspace(0, 1, spec.path_control_points)[:, None]
    )
    path += 0.05 * random.normal(size=path.shape)
    return path, np.exp(0.2 * random.normal(size=(count, spec.rate_control_points)))


def test_the_loss_sees_the_obstacles_of_each_sample(problem):
    full = with_capacity(
        problem.with_obstacles(()), dict.fromkeys(map(shape_of, SCENE), 2)
    )
    assert full.has_sample_obstacles
    loss, (path, rate) = PlanLoss(full, dtype="float64", nodes=32), plans(full, 20)
    term, weights = loss.terms.index("robot-clearance"), loss.weights0
    poses = np.stack(
        [scene_poses(full, SCENE if index % 2 else ()) for index in range(20)]
    )
    value = loss(path, rate, weights=weights, obstacle_poses=poses)
    assert (value.terms[::2, term] == 0).all()
    assert (value.terms[1::2, term] > 0).any()
    random, e = np.random.default_rng(3), 1e-6
    changes = random.normal(size=path.shape), random.normal(size=rate.shape)
    above, below = (
        loss(
            path + s * e * changes[0],
            rate + s * e * changes[1],
            weights=weights,
            obstacle_poses=poses,
        ).total
        for s in (1, -1)
    )
    analytic = np.einsum("ijk,ijk->i", value.path_gradient, changes[0])
    analytic += np.einsum("ij,ij->i", value.rate_gradient, changes[1])
    np.testing.assert_allclose(
        (above - below) / (2 * e), analytic, rtol=1e-3, atol=1e-3
    )
    invalid = np.where(np.arange(20)[:, None] == 3, -1.0, rate)
    total = loss(path, invalid, weights=weights, obstacle_poses=poses).total
    assert np.isnan(total[3])
    np.testing.assert_array_equal(np.delete(total, 3), np.delete(value.total, 3))


def test_kernels_are_those_of_the_problem_without_obstacles(problem):
    full = with_capacity(problem, {"box": 3})
    assert full.for_planning.identity == problem.with_obstacles(()).identity
    assert problem.for_planning is problem
