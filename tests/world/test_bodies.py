"""Distances of a robot's shape: against Pinocchio and Coal on the URDF's own geometry, and whatever Coal answers."""

from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest

from cnpgen.errors import RecipeError
from cnpgen.problems.load import load_problem
from cnpgen.problems.problem import Problem
from cnpgen.problems.robot import load_robot
from cnpgen.robots.robot import Robot
from cnpgen.world.path import PathWorld
from cnpgen.world.state import World
from tests.examples.meshes import Meshes
from tests.examples.shaped_robot import LINKS, write_problem

ROUNDED = 1e-4  # m: by how much the prism round a cylinder may be nearer than the cylinder
TOPS = np.array([0.3, 0.9])


@pytest.fixture(scope="module")
def crane(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, Robot]:
    problem = load_problem(write_problem(tmp_path_factory.mktemp("crane")))
    return problem, load_robot(problem)


def test_distances_are_those_of_the_urdf_s_own_geometry(crane):
    problem, robot = crane
    world, random = World(robot, problem.obstacle), np.random.default_rng(3)
    reference = Meshes(problem, robot, problem.path.parent)
    zero, hits = np.zeros(robot.n), np.zeros(2)
    for q in random.uniform(robot.position_lower, robot.position_upper, (300, robot.n)):
        world.set_state(q, zero, zero, TOPS)
        found = np.array([min(world.shape_distances()), min(world.self_distances())])
        expected = np.array(reference.distances(q))
        assert ((found > 0) == (expected > 0)).all()
        apart = expected > 0
        assert (found[apart] < expected[apart] + 1e-8).all()
        assert (found[apart] > expected[apart] - ROUNDED).all()
        hits += ~apart
    assert (hits > 20).all()


def test_many_states_are_what_each_of_them_is(crane):
    problem, robot = crane
    random = np.random.default_rng(4)
    ends = random.uniform(robot.position_lower, robot.position_upper, (2, robot.n))
    path = np.linspace(*ends, 120).T
    many, one, zero = PathWorld(robot, problem.obstacle), World(robot, problem.obstacle), np.zeros(robot.n)
    many.set_path(path, 0 * path, 0 * path, TOPS)
    for what in ("shape_distances", "self_distances"):
        found, single = np.array(getattr(many, what)()), []
        for q in path.T:
            one.set_state(q.copy(), zero, zero, TOPS)
            single.append(getattr(one, what)())
        single = np.array(single).T
        assert found.shape == single.shape
        assert found.min() == pytest.approx(single.min(), abs=1e-8)
        pair, k = np.unravel_index(np.argmin(found), found.shape)
        assert single[:, k].min() == pytest.approx(found[pair, k], abs=1e-8)


def test_obstacles_move_with_their_tops(crane):
    problem, robot = crane
    world, zero = World(robot, problem.obstacle), np.zeros(robot.n)
    found = []
    for lower in (0.0, 0.1):
        world.set_state(zero, zero, zero, TOPS - [3.0, lower - 0.5])
        found.append(min(world.shape_distances()))
    assert found[0] - found[1] == pytest.approx(0.1, abs=1e-8)  # the roof over the lying arm


@pytest.mark.parametrize("answer", [-1.8e308, 0.3, np.nan])
def test_no_failure_of_coal_s_makes_bodies_look_further_apart(crane, monkeypatch, answer):
    problem, robot = crane
    world, random = World(robot, problem.obstacle), np.random.default_rng(5)
    states = random.uniform(robot.position_lower, robot.position_upper, (40, robot.n))
    zero, real, calls = np.zeros(robot.n), coal.distance, [0]

    def measured() -> np.ndarray:
        found = []
        for q in states:
            world.set_state(q, zero, zero, TOPS)
            found.append((min(world.shape_distances()), min(world.self_distances())))
        return np.array(found)

    def failing(*arguments: Any) -> float:
        calls[0] += 1
        value = real(*arguments)
        if calls[0] % 3 == 0:  # the value and its direction are wrong
            arguments[5].normal = np.array([0.0, 0.6, 0.8])
            return answer
        return value

    expected = measured()
    monkeypatch.setattr(coal, "distance", failing)
    found = measured()
    assert (found <= expected + 1e-8).all()
    assert np.isclose(found, expected, atol=1e-6).mean() > 0.9  # another tolerance is tried


def test_states_that_are_no_numbers_have_no_distances(crane):
    problem, robot = crane
    world = PathWorld(robot, problem.obstacle)
    path = np.zeros((robot.n, 5))
    path[1, 2] = np.nan
    world.set_path(path, path, path, TOPS)
    assert np.isnan(world.shape_distances()).all()
    assert np.isnan(world.self_distances()).all()


def test_what_does_not_move_is_not_measured_from_obstacles(crane):
    problem, robot = crane
    world = World(robot, problem.obstacle)
    moving = sum(len(shapes) for link, shapes in LINKS.items() if link != "base")
    assert len(world.shape_distances()) == moving * len(problem.obstacle)


@pytest.mark.parametrize("kind", [World, PathWorld])
def test_a_robot_without_a_shape_has_no_such_distances(kind):
    problem = load_problem("heavy-object")
    world = kind(load_robot(problem), problem.obstacle)
    for what in (world.shape_distances, world.self_distances):
        with pytest.raises(RecipeError, match='needs geometry = "urdf"'):
            what()


def test_the_folder_of_the_meshes_may_be_gone(tmp_path: Path):
    problem = load_problem(write_problem(tmp_path))
    text = problem.urdf_text
    (tmp_path / "crane" / "meshes" / "wedge.stl").unlink()
    assert load_robot(problem).urdf_text == text


def test_no_point_of_the_arm_moves_further_than_its_reach_allows(crane):
    problem, robot = crane
    random = np.random.default_rng(6)
    path = random.uniform(robot.position_lower, robot.position_upper, (60, robot.n)).T
    world, model, data = PathWorld(robot, problem.obstacle), robot.model, robot.model.createData()
    ways = world.reach(np.abs(path).max(axis=1)) @ np.abs(np.diff(path, axis=1))
    found = []
    for q in path.T:
        pin.forwardKinematics(model, data, q)
        pieces = [(data.oMi[robot.shape.joints[piece.link]], piece) for piece in robot.shape.pieces]
        found.append(np.concatenate([piece.vertices @ pose.rotation.T + pose.translation for pose, piece in pieces]))
    assert (np.linalg.norm(np.diff(found, axis=0), axis=2).max(axis=1) <= ways + 1e-12).all()
