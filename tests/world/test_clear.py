"""Which of many states have bodies far enough apart: the answer of one state after the other, with fewer questions."""

import numpy as np
import pytest

from cnpgen.problems.load import load_problem
from cnpgen.problems.robot import load_robot
from cnpgen.world.clear import clear_states
from cnpgen.world.path import PathWorld
from cnpgen.world.state import World
from tests.examples.shaped_robot import write_problem

TOPS = np.array([0.3, 0.9])


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    problem = load_problem(write_problem(tmp_path_factory.mktemp("crane")))
    return problem, load_robot(problem)


@pytest.mark.parametrize("what", ["shape", "self"])
def test_many_states_at_once_are_found_clear_as_one_by_one(crane, what, monkeypatch):
    problem, robot = crane
    q = np.random.default_rng(3).uniform(robot.position_lower, robot.position_upper, (400, robot.n))
    world, zero = World(robot, problem.obstacle), np.zeros(robot.n)
    nearest = []
    for state in q:
        world.set_state(state, zero, zero, TOPS)
        nearest.append(min(getattr(world, f"{what}_distances")()))
    path, still = PathWorld(robot, problem.obstacle), np.zeros((robot.n, len(q)))
    path.set_path(np.ascontiguousarray(q.T), still, still, TOPS)
    bodies, asked = path._placed_bodies(), []
    real = type(bodies)._measure
    monkeypatch.setattr(type(bodies), "_measure", lambda *x: (asked.append(1), real(*x))[1])
    question = path.clear_of_obstacles if what == "shape" else path.clear_of_itself
    for least in (-0.01, 0.0, 0.02):
        expected = np.array(nearest) >= least
        assert 0.02 < expected.mean() < 0.98
        asked.clear()
        np.testing.assert_array_equal(question(least), expected)
        assert len(asked) < (~expected).sum() + 0.5 * expected.sum()


def test_one_direction_settles_all_states_that_it_bounds():
    distances, asked = np.linspace(0.0, 1.0, 101), []

    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        asked.append(k)
        return distances[k], np.array([1.0, 0.0, 0.0])

    bounds = np.full((1, 101), -1.0)
    found = clear_states(bounds, 0.5, measure, lambda pair, direction, which: distances[which])
    np.testing.assert_array_equal(found, distances >= 0.5)
    assert asked == list(range(50))  # those that are not clear are measured, and the first settles the others


@pytest.mark.parametrize(
    ("distance", "direction"), [(np.nan, [1.0, 0, 0]), (-np.inf, [np.nan] * 3)], ids=["no number", "no direction"]
)
def test_a_state_that_cannot_be_measured_is_not_clear_and_settles_nothing_else(distance, direction):
    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        return (distance, np.array(direction)) if k == 1 else (0.3, np.full(3, np.nan))

    found = clear_states(np.full((1, 3), -1.0), 0.1, measure, lambda pair, away, which: np.full(len(which), 0.05))
    np.testing.assert_array_equal(found, [True, False, True])
