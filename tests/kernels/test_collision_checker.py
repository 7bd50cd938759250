"""Compiled collision checks: agreement with Coal in separation and in penetration, for all kinds of obstacles."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from cnpgen.kernels.collision.collision_checker import (
    CollisionChecker,
    load_collision_library,
)
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.convex_part import Contacts, turned
from cnpgen.robots.shape.hull import coal_hull
from cnpgen.robots.shape.inline import address_of
from cnpgen.robots.solid import place_obstacles
from tests.conftest import needs_compiled_code
from tests.examples.shaped_robot import WEDGE, write_problem

pytestmark = needs_compiled_code

KINDS = ("box", "sphere", "cylinder", "capsule", "mesh", "large mesh")
DIRECTIONS = np.random.default_rng(11).normal(size=(500, 3))
# Of an ellipsoid: all corners of its hull, in many blocks.
CORNERS = (
    [0.15, 0.08, 0.03] * DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
)
WITHIN = 0.05  # m
STATES = 400


@pytest.fixture(scope="module")
def library():
    backend, folder = choose_backend("compiled")
    return load_collision_library(KernelLibrary(backend, folder, "", {}))


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Robot:
    return load_robot(load_problem(write_problem(tmp_path_factory.mktemp("crane"))))


def random_obstacles(kind: str, count: int) -> list[Obstacle]:
    random = np.random.default_rng(KINDS.index(kind))
    mesh = address_of(1e-3 * WEDGE)
    sizes = {
        "box": lambda: {"size": tuple(random.uniform(0.02, 0.3, 3))},
        "sphere": lambda: {"radius": random.uniform(0.02, 0.1)},
        "cylinder": lambda: {
            "radius": random.uniform(0.02, 0.1),
            "length": random.uniform(0.02, 0.4),
        },
        "capsule": lambda: {
            "radius": random.uniform(0.02, 0.1),
            "length": random.uniform(0.02, 0.4),
        },
        "mesh": lambda: {"mesh": mesh},
        "large mesh": lambda: {"mesh": address_of(CORNERS)},
    }
    return [
        Obstacle(
            name=f"{kind}-{index}".replace(" ", "-"),
            kind=kind.removeprefix("large "),
            position=tuple(random.uniform([-0.6, -0.6, 0.0], [0.6, 0.6, 0.9])),
            rotation=(0.0, 0.0, 0.0)
            if kind == "sphere"
            else tuple(random.uniform(-3, 3, 3)),
            **sizes[kind](),
        )
        for index in range(count)
    ]


def coal_shape(obstacle: Obstacle):
    """Return the exact shape of Coal; a cylinder has the radius of the corners of the judge's prism."""
    import coal

    if obstacle.kind == "box":
        return coal.Box(*obstacle.size)
    if obstacle.kind == "sphere":
        return coal.Sphere(obstacle.radius)
    if obstacle.kind == "capsule":
        return coal.Capsule(obstacle.radius, obstacle.length)
    if obstacle.kind == "cylinder":
        return coal.Cylinder(obstacle.radius / np.cos(np.pi / 64), obstacle.length)
    return coal_hull(CORNERS if "large" in obstacle.name else 1e-3 * WEDGE)


def coal_distance(first, second) -> float:
    """Return the signed distance of two (shape, rotation, position) by Coal."""
    import coal

    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance, request.epa_tolerance = 1e-9, 1e-6
    transforms = [
        coal.Transform3s(rotation, position)
        for _, rotation, position in (first, second)
    ]
    return float(
        coal.distance(
            first[0], transforms[0], second[0], transforms[1], request, result
        )
    )


def joint_frames(robot: Robot, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    import pinocchio as pin

    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    return [(np.array(pose.rotation), np.array(pose.translation)) for pose in data.oMi]


def states_of(robot: Robot, count: int = STATES) -> np.ndarray:
    random = np.random.default_rng(3)
    return random.uniform(
        robot.position_lower, robot.position_upper, (count, robot.n)
    ).T.copy()


def by_pair(close: Contacts) -> dict[tuple[int, int], float]:
    return {
        (int(pair), int(k)): float(d)
        for pair, k, d in zip(close.pair, close.k, close.distance, strict=True)
    }


def test_poses_are_those_of_pinocchio(library, robot):
    q = states_of(robot, 50)
    poses = CollisionChecker(library, robot).joint_poses(q)
    for k, state in enumerate(q.T):
        for joint, (rotation, position) in enumerate(joint_frames(robot, state)):
            assert np.abs(poses[k, joint, :9].reshape(3, 3) - rotation).max() < 1e-12
            assert np.abs(poses[k, joint, 9:] - position).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_distances_from_obstacles_are_those_of_coal(library, robot, kind):
    obstacles = random_obstacles(kind, 20)
    checker = CollisionChecker(library, robot)
    checker.place(obstacles, place_obstacles(obstacles))
    q = states_of(robot)
    measured = by_pair(checker.close_bodies(q, WITHIN, of_obstacles=True))
    parts = [
        (part, robot.shape.joints[part.link])
        for part in robot.shape.moving_convex_parts
    ]
    shapes = [
        (coal_shape(each), turned(*each.rotation), np.array(each.position))
        for each in obstacles
    ]
    hulls, checked, failed, overlaps = (
        [coal_hull(part.vertices) for part, _ in parts],
        0,
        0,
        0,
    )
    for k, state in enumerate(q.T):
        frames = joint_frames(robot, state)
        for (index, (part, joint)), (number, shape) in product(
            enumerate(parts), enumerate(shapes)
        ):
            expected = (
                coal_distance(shape, (hulls[index], *frames[joint])) - part.radius
            )
            value = measured.get((index * len(obstacles) + number, k), np.inf)
            if expected < -5 or (
                expected < 0 and value > expected
            ):  # EPA of Coal failed or stopped early
                failed += expected < 0 and abs(value - expected) > 1e-6
                continue
            if expected < WITHIN - 1e-6 or value < WITHIN - 1e-6:
                assert abs(value - expected) < (
                    1e-6 if expected > 0 else 5e-6
                )  # the tolerance of EPA is 1e-6
                checked += 1
                overlaps += value < 0
    assert checked > 200
    assert overlaps > 40
    assert failed <= 0.01 * checked


def test_distances_of_links_are_those_of_coal(library, robot):
    checker, q = CollisionChecker(library, robot), states_of(robot)
    measured = by_pair(checker.close_bodies(q, WITHIN, of_obstacles=False))
    parts, checked = robot.shape.convex_parts, 0
    hulls = [coal_hull(part.vertices) for part in parts]
    assert {tuple(sorted(pair)) for pair in checker.link_pairs.tolist()} == {
        tuple(sorted(pair)) for pair in robot.shape.checked_pairs
    }
    for k, state in enumerate(q.T):
        frames = joint_frames(robot, state)
        for pair, (a, b) in enumerate(checker.link_pairs.tolist()):
            first, second = (
                (hulls[i], *frames[robot.shape.joints[parts[i].link]]) for i in (a, b)
            )
            expected = coal_distance(first, second) - parts[a].radius - parts[b].radius
            value = measured.get((pair, k), np.inf)
            if expected < WITHIN - 1e-6 or value < WITHIN - 1e-6:
                assert abs(value - expected) < (
                    1e-6 if expected > 0 else 5e-6
                )  # the tolerance of EPA is 1e-6
                checked += 1
    assert checked > 100


def test_points_and_normals_realize_the_distance(library, robot):
    obstacles = [each for kind in KINDS for each in random_obstacles(kind, 3)]
    checker = CollisionChecker(library, robot)
    checker.place(obstacles, place_obstacles(obstacles))
    parts = robot.shape.moving_convex_parts
    close = checker.close_bodies(states_of(robot), WITHIN, of_obstacles=True)
    assert len(close.pair) > 800
    np.testing.assert_allclose(np.linalg.norm(close.normal, axis=1), 1, atol=1e-9)
    radii = [
        obstacle.radius if obstacle.kind in ("sphere", "capsule") else 0.0
        for obstacle in obstacles
    ]
    both = np.array(
        [
            parts[p // len(obstacles)].radius + radii[p % len(obstacles)]
            for p in close.pair
        ]
    )
    along = np.einsum("ci,ci->c", close.normal, close.points[:, 1] - close.points[:, 0])
    np.testing.assert_allclose(along - both, close.distance, atol=1e-8)
    between = np.linalg.norm(close.points[:, 1] - close.points[:, 0], axis=1)
    np.testing.assert_allclose(between, np.abs(along), atol=1e-6)


def test_clear_states_are_those_with_sufficient_distances(library, robot):
    obstacles = [each for kind in KINDS for each in random_obstacles(kind, 2)]
    checker, q = CollisionChecker(library, robot), states_of(robot, 2000)
    checker.place(obstacles, place_obstacles(obstacles))
    for distance in (0.0, 0.01, -0.002):
        for of_obstacles in (True, False):
            close = checker.close_bodies(q, distance + 1e-6, of_obstacles=of_obstacles)
            smallest = np.full(q.shape[1], np.inf)
            np.minimum.at(smallest, close.k, close.distance)
            limits = (distance, None) if of_obstacles else (None, distance)
            clear = checker.clear_states(
                q, obstacle_distance=limits[0], self_distance=limits[1]
            )
            decided = np.abs(smallest - distance) > 2e-9
            assert np.array_equal(clear[decided], smallest[decided] > distance)
            assert 0 < clear.sum() < len(clear)


def test_results_do_not_depend_on_the_order_of_states(library, robot):
    obstacles = random_obstacles("cylinder", 8)
    checker, q = CollisionChecker(library, robot), states_of(robot, 500)
    checker.place(obstacles, place_obstacles(obstacles))
    order = np.random.default_rng(0).permutation(q.shape[1])
    assert np.array_equal(
        checker.clear_states(q)[order], checker.clear_states(q[:, order])
    )


def test_new_obstacles_replace_the_old_ones(library, robot):
    checker, q = CollisionChecker(library, robot), states_of(robot)
    obstacles = random_obstacles("mesh", 8)
    checker.place(obstacles, place_obstacles(obstacles))
    assert not checker.clear_states(q, self_distance=None).all()
    checker.place([], np.empty(0))
    assert checker.clear_states(q, self_distance=None).all()


def test_pairs_that_an_srdf_disables_are_not_checked(library, robot):
    q = (
        np.random.default_rng(5)
        .uniform(robot.position_lower, robot.position_upper, (STATES, robot.n))
        .T.copy()
    )
    assert robot.shape is not None
    checked = [pair for pair in robot.shape.pairs if not pair.left_out]
    clear = [
        CollisionChecker(
            library, replace(robot, shape=replace(robot.shape, pairs=pairs))
        ).clear_states(q)
        for pairs in (checked, [replace(pair, left_out="disabled") for pair in checked])
    ]
    assert not clear[0].all()
    assert clear[1].all()
