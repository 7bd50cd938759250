"""Distances of a robot's link geometry: comparison with the URDF's geometry, and wrong results of Coal."""

from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.robot import Robot
from cnpgen.world.certified import convex_body, lowest_products
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.examples.meshes import Meshes
from tests.examples.shaped_robot import LINKS, write_problem
from tests.refusals import is_refused

PRISM_ERROR_M = 1e-4  # between a cylinder and the prism around it
OBSTACLE_POSES = np.array([0.3, 0.9])


@pytest.fixture(scope="module")
def crane(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, Robot]:
    problem = load_problem(write_problem(tmp_path_factory.mktemp("crane")))
    return problem, load_robot(problem)


def test_distances_agree_with_the_urdf_s_own_geometry(crane):
    problem, robot = crane
    world, random = World(robot, problem.obstacle), np.random.default_rng(3)
    reference = Meshes(problem, robot, problem.path.parent)
    zero, hits = np.zeros(robot.n), np.zeros(2)
    for q in random.uniform(robot.position_lower, robot.position_upper, (300, robot.n)):
        world.set_state(q, zero, zero, OBSTACLE_POSES)
        found = np.array([min(world.shape_distances()), min(world.self_distances())])
        expected = np.array(reference.distances(q))
        assert ((found > 0) == (expected > 0)).all()
        clear = expected > 0
        assert (found[clear] < expected[clear] + 1e-8).all()
        assert (found[clear] > expected[clear] - PRISM_ERROR_M).all()
        hits += ~clear
    assert (hits > 20).all()


def test_many_states_agree_with_single_states(crane):
    problem, robot = crane
    random = np.random.default_rng(4)
    ends = random.uniform(robot.position_lower, robot.position_upper, (2, robot.n))
    path = np.linspace(*ends, 120).T
    many, one, zero = (
        PathWorld(robot, problem.obstacle),
        World(robot, problem.obstacle),
        np.zeros(robot.n),
    )
    many.set_path(path, 0 * path, 0 * path, OBSTACLE_POSES)
    for what in ("shape_distances", "self_distances"):
        found, single = np.array(getattr(many, what)()), []
        for q in path.T:
            one.set_state(q.copy(), zero, zero, OBSTACLE_POSES)
            single.append(getattr(one, what)())
        single = np.array(single).T
        assert found.shape == single.shape
        assert found.min() == pytest.approx(single.min(), abs=1e-8)
        pair, k = np.unravel_index(np.argmin(found), found.shape)
        assert single[:, k].min() == pytest.approx(found[pair, k], abs=1e-8)


def test_obstacles_move_with_their_poses(crane):
    problem, robot = crane
    world, zero = World(robot, problem.obstacle), np.zeros(robot.n)
    found = []
    for lower in (0.0, 0.1):
        world.set_state(zero, zero, zero, OBSTACLE_POSES - [3.0, lower - 0.5])
        found.append(min(world.shape_distances()))
    assert found[0] - found[1] == pytest.approx(
        0.1, abs=1e-8
    )  # the roof over the horizontal arm


@pytest.mark.parametrize("answer", [-1.8e308, 0.3, np.nan])
def test_no_failure_of_coal_overestimates_a_distance(crane, monkeypatch, answer):
    problem, robot = crane
    world, random = World(robot, problem.obstacle), np.random.default_rng(5)
    states = random.uniform(robot.position_lower, robot.position_upper, (40, robot.n))
    zero, real, calls = np.zeros(robot.n), coal.distance, [0]

    def measured() -> np.ndarray:
        found = []
        for q in states:
            world.set_state(q, zero, zero, OBSTACLE_POSES)
            found.append((min(world.shape_distances()), min(world.self_distances())))
        return np.array(found)

    def failing(*arguments: Any) -> float:
        calls[0] += 1
        value = real(*arguments)
        if calls[0] % 3 == 0:  # return a wrong value and direction
            arguments[5].normal = np.array([0.0, 0.6, 0.8])
            return answer
        return value

    expected = measured()
    monkeypatch.setattr(coal, "distance", failing)
    found = measured()
    assert (found <= expected + 1e-8).all()
    assert (
        np.isclose(found, expected, atol=1e-6).mean() > 0.9
    )  # another tolerance is tried


def test_states_that_are_not_finite_have_no_distances(crane):
    problem, robot = crane
    world = PathWorld(robot, problem.obstacle)
    path = np.zeros((robot.n, 5))
    path[1, 2] = np.nan
    world.set_path(path, path, path, OBSTACLE_POSES)
    assert np.isnan(world.shape_distances()).all()
    assert np.isnan(world.self_distances()).all()


def test_fixed_links_are_not_measured_from_obstacles(crane):
    problem, robot = crane
    world = World(robot, problem.obstacle)
    moving = sum(len(shapes) for link, shapes in LINKS.items() if link != "base")
    assert len(world.shape_distances()) == moving * len(problem.obstacle)


@pytest.mark.parametrize("kind", [World, PathWorld])
def test_a_robot_without_link_geometry_has_no_such_distances(kind):
    problem = load_problem("heavy-object")
    world = kind(load_robot(problem), problem.obstacle)
    for measure in (world.shape_distances, world.self_distances):
        with is_refused(RecipeError):
            measure()


def test_the_meshes_are_not_needed_after_loading(tmp_path: Path):
    problem = load_problem(write_problem(tmp_path))
    text = problem.urdf_text
    (tmp_path / "crane" / "meshes" / "wedge.stl").unlink()
    assert load_robot(problem).urdf_text == text


def test_no_point_of_the_arm_moves_by_more_than_the_motion_bound(crane):
    problem, robot = crane
    random = np.random.default_rng(6)
    path = random.uniform(robot.position_lower, robot.position_upper, (60, robot.n)).T
    world, model, data = (
        PathWorld(robot, problem.obstacle),
        robot.model,
        robot.model.createData(),
    )
    bounds = world.motion_bounds(np.abs(path).max(axis=1)) @ np.abs(
        np.diff(path, axis=1)
    )
    found = []
    for q in path.T:
        pin.forwardKinematics(model, data, q)
        pieces = [
            (data.oMi[robot.shape.joints[piece.link]], piece)
            for piece in robot.shape.convex_parts
        ]
        found.append(
            np.concatenate(
                [
                    piece.vertices @ pose.rotation.T + pose.translation
                    for pose, piece in pieces
                ]
            )
        )
    assert (
        np.linalg.norm(np.diff(found, axis=0), axis=2).max(axis=1) <= bounds + 1e-12
    ).all()


@pytest.mark.parametrize(
    ("corners", "directions"), [(3, 5), (1000, 300), (70, 70_000), (1, 0)]
)
def test_smallest_products_in_blocks_are_those_of_the_whole(
    corners: int, directions: int
) -> None:
    random = np.random.default_rng(3)
    points, along = (
        random.normal(size=(corners, 3)),
        random.normal(size=(3, directions)),
    )
    expected = np.einsum("ni,ik->nk", points, along).min(axis=0)
    np.testing.assert_allclose(
        lowest_products(points, along), expected, rtol=1e-12, atol=1e-14
    )


@pytest.mark.parametrize("shape", ["ball", "box", "flat"])
def test_corners_of_cells_of_directions_have_the_smallest_products_of_all(
    shape: str,
) -> None:
    random = np.random.default_rng(4)
    points = random.normal(size=(3000, 3))
    if shape == "ball":
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    elif shape == "box":
        points = np.clip(points, -1, 1) * [3.0, 1.0, 0.2]
    else:
        points[:, 2] = 0.0
    directions = random.normal(size=(3, 5000))
    directions[:, :6] = np.concatenate([np.eye(3), -np.eye(3)], axis=1)
    # On the edges between cells of directions.
    directions[:, 6:200] = random.choice([-1, -0.875, 0.125, 1, 0.375], (3, 194))
    directions /= np.linalg.norm(directions, axis=0)
    body = convex_body(points)
    expected = (points @ directions).min(axis=0)
    for _ in range(2):  # the second time with kept candidates
        np.testing.assert_allclose(
            body.lowest_products(directions), expected, rtol=1e-13, atol=1e-14
        )
    assert body.lowest_products(directions[:, :0]).shape == (0,)
    assert np.isnan(body.lowest_products(np.full((3, 2), np.nan))).all()
