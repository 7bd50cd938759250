"""Smallest distances at every state, compared with those of single states, and the closest points of both bodies."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.solid import place_obstacles
from cnpgen.world.pair_distances import PairDistances
from cnpgen.world.path import PathWorld
from tests.examples.shaped_robot import write_problem

STATES = 40


def world_on_a_path(problem: Problem, q: np.ndarray | None = None) -> PathWorld:
    """Return a robot on a random path."""
    robot = load_robot(problem)
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    if q is None:
        ends = np.random.default_rng(3).uniform(
            robot.position_lower, robot.position_upper, (2, robot.n)
        )
        q = (ends[0] + np.linspace(0, 1, STATES)[:, None] * (ends[1] - ends[0])).T
    world.set_path(q, 0 * q, 0 * q, place_obstacles(problem.obstacle))
    return world


@pytest.mark.parametrize("kind", ["robot", "self", "object"])
def test_distances_equal_those_of_single_states_and_of_the_points(
    kind: str, tmp_path: Path
) -> None:
    problem = (
        load_problem("heavy-object")
        if kind == "object"
        else load_problem(write_problem(tmp_path))
    )
    world = world_on_a_path(problem)
    closest = world.pairs(kind).closest_points()
    single = world_on_a_path(problem)
    for k in range(0, STATES, 7):
        single.set_path(
            *(values[:, k : k + 1] for values in (world.q, world.dq, world.ddq)),
            place_obstacles(problem.obstacle),
        )
        measured = {
            "robot": single.shape_distances,
            "self": single.self_distances,
            "object": single.object_distances,
        }
        assert closest.distance[k] == pytest.approx(min(measured[kind]())[0], abs=1e-8)
    gaps = np.linalg.norm(closest.points[:, 0] - closest.points[:, 1], axis=1)
    np.testing.assert_allclose(gaps, np.abs(closest.distance), atol=1e-6)
    assert kind == "self" or len(np.unique(closest.distance.round(6))) > STATES // 2


def test_the_paper_s_capsules_are_measured_from_their_surface() -> None:
    problem = load_problem("heavy-object")
    world = world_on_a_path(problem)
    axes, surface = (
        world.pairs("robot").closest_points(radius) for radius in (0.0, 0.05)
    )
    np.testing.assert_allclose(axes.distance - surface.distance, 0.05, atol=1e-12)
    outside = surface.distance > 0
    assert outside.any()
    gaps = np.linalg.norm(surface.points[:, 0] - surface.points[:, 1], axis=1)
    np.testing.assert_allclose(gaps[outside], surface.distance[outside], atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_the_smallest_pair_of_every_state_is_found(seed: int) -> None:
    random = np.random.default_rng(seed)
    truth = random.normal(0, 1, (6, 30))
    bounds = truth - random.exponential(0.5, truth.shape)
    calls: list[tuple[int, int]] = []

    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        calls.append((pair, k))
        return float(truth[pair, k]), np.zeros(3)

    def unused(*_: object) -> np.ndarray:
        raise NotImplementedError

    distances, pairs = PairDistances(
        bounds, measure, unused, unused
    ).smallest_per_state()
    np.testing.assert_array_equal(distances, truth.min(axis=0))
    np.testing.assert_array_equal(pairs, truth.argmin(axis=0))
    assert len(calls) < truth.size
