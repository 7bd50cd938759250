"""Best-first search of distances, and masks of states at a sufficient distance."""

from typing import Any

import numpy as np
import pytest

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.world.pair_distances import MAX_DEVIATION, RESOLUTION, PairDistances
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.examples.shaped_robot import write_problem

NO_DIRECTION = np.full(3, np.nan)
UNUSED: Any = None


def searched(
    truth: np.ndarray, bounds: np.ndarray, directions: bool = True
) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Search known distances; a direction raises the bounds of its pair to the truth minus a cone."""
    calls: list[tuple[int, int]] = []

    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        calls.append((pair, k))
        return float(truth[pair, k]), np.array(
            [1.0, 0.0, float(k)]
        ) if directions else NO_DIRECTION

    def separation(pair: int, direction: np.ndarray, states: np.ndarray) -> np.ndarray:
        return truth[pair, states] - 1e-3 * np.abs(states - direction[2])

    return np.array(
        PairDistances(bounds, measure, separation, UNUSED).smallest()
    ), calls


@pytest.mark.parametrize("directions", [True, False])
@pytest.mark.parametrize("seed", range(15))
def test_the_smallest_distance_is_found_at_its_place(
    seed: int, directions: bool
) -> None:
    random = np.random.default_rng(seed)
    pairs, states = random.integers(1, 6), random.integers(1, 300)
    truth = np.cumsum(random.normal(0, 0.01, (pairs, states)), axis=1) + random.uniform(
        -0.2, 0.2, (pairs, 1)
    )
    bounds = truth - random.exponential(0.05, truth.shape)
    found, calls = searched(truth, bounds, directions)
    assert found.shape == truth.shape
    assert abs(found.min() - truth.min()) <= RESOLUTION
    index = np.unravel_index(np.argmin(found), found.shape)
    assert found[index] == truth[index]
    assert index in calls
    assert len(set(calls)) == len(calls)
    for pair, k in calls:
        assert found[pair, k] == truth[pair, k]
    assert np.all(found <= np.maximum(truth, np.nextafter(found.min(), 1)) + 1e-15)


def test_directions_avoid_most_measurements() -> None:
    truth = 0.3 + 0.2 * np.cos(np.linspace(0, 9, 2000))[None]
    _, calls = searched(truth, np.full(truth.shape, -1.0))
    assert len(calls) < 200


def test_directions_are_applied_only_where_the_distance_could_be_smaller() -> None:
    truth, applied = (
        0.3 + 0.2 * np.cos(np.linspace(0, 9, 400))[None],
        list[np.ndarray](),
    )
    bounds = truth - 0.1

    def separation(pair: int, direction: np.ndarray, states: np.ndarray) -> np.ndarray:
        applied.append(states)
        return bounds[pair, states]

    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        return float(truth[pair, k]), np.array([1.0, 0.0, 0.0])

    PairDistances(bounds, measure, separation, UNUSED).smallest()
    for states in applied:
        assert bounds[0, states].max() < truth[0, bounds[0].argmin()]
    assert 0 < len(applied[0]) < 200


def test_one_measurement_is_enough_if_all_distances_are_equal() -> None:
    found, calls = searched(np.zeros((3, 500)), np.zeros((3, 500)), directions=False)
    assert len(calls) == 1
    assert np.all(np.delete(found.ravel(), np.argmin(found)) > 0)


def test_a_distance_that_cannot_be_measured_ends_the_search() -> None:
    truth = np.array([[0.3, np.nan, 0.2]])
    found, calls = searched(truth, np.array([[0.2, 0.1, 0.15]]))
    assert calls == [(0, 1)]
    assert np.isnan(found[0, 1])


def test_the_search_without_pairs_returns_no_distances() -> None:
    assert PairDistances(np.zeros((0, 7)), UNUSED, UNUSED, UNUSED).smallest() == []


OBSTACLE_POSES = np.array([0.3, 0.9])


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    problem = load_problem(write_problem(tmp_path_factory.mktemp("crane")))
    return problem, load_robot(problem)


@pytest.mark.parametrize("what", ["shape", "self"])
def test_clear_states_agree_with_single_states(crane, what, monkeypatch):
    problem, robot = crane
    q = np.random.default_rng(3).uniform(
        robot.position_lower, robot.position_upper, (400, robot.n)
    )
    world, zero = World(robot, problem.obstacle), np.zeros(robot.n)
    nearest = []
    for state in q:
        world.set_state(state, zero, zero, OBSTACLE_POSES)
        nearest.append(min(getattr(world, f"{what}_distances")()))
    path, still = PathWorld(robot, problem.obstacle), np.zeros((robot.n, len(q)))
    path.set_path(np.ascontiguousarray(q.T), still, still, OBSTACLE_POSES)
    bodies, calls = path._placed_bodies(), []
    real = type(bodies)._measure
    monkeypatch.setattr(
        type(bodies), "_measure", lambda *x: (calls.append(1), real(*x))[1]
    )
    clear = path.pairs("robot" if what == "shape" else "self").clear_states
    for least in (-0.01, 0.0, 0.02):
        expected = np.array(nearest) >= least
        assert 0.02 < expected.mean() < 0.98
        calls.clear()
        np.testing.assert_array_equal(clear(least), expected)
        assert len(calls) < (~expected).sum() + 0.5 * expected.sum()


def test_one_direction_resolves_all_states_that_it_bounds():
    distances, calls = np.linspace(0.0, 1.0, 101), []

    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        calls.append(k)
        return distances[k], np.array([1.0, 0.0, 0.0])

    bounds = np.full((1, 101), -1.0)
    found = PairDistances(
        bounds, measure, lambda pair, direction, states: distances[states], UNUSED
    ).clear_states(0.5)
    np.testing.assert_array_equal(found, distances >= 0.5)
    assert (
        calls == list(range(50))
    )  # states that are not clear are measured, and the first clear one resolves the others


@pytest.mark.parametrize(
    ("distance", "direction"),
    [(np.nan, [1.0, 0, 0]), (-np.inf, [np.nan] * 3)],
    ids=["no number", "no direction"],
)
def test_a_state_that_cannot_be_measured_is_not_clear_and_resolves_no_others(
    distance, direction
):
    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        return (distance, np.array(direction)) if k == 1 else (0.3, np.full(3, np.nan))

    pairs = PairDistances(
        np.full((1, 3), -1.0),
        measure,
        lambda *where: np.full(len(where[2]), 0.05),
        UNUSED,
    )
    found = pairs.clear_states(0.1)
    np.testing.assert_array_equal(found, [True, False, True])


def test_no_direction_is_measured_for_an_interval_in_which_a_point_may_be_anywhere():
    measured: list[int] = []

    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        measured.append(k)
        return 0.5, np.array([1.0, 0.0, 0.0])

    def separation(pair: int, direction: np.ndarray, states: np.ndarray) -> np.ndarray:
        return np.full(len(states), 0.5)

    pairs = PairDistances(np.full((1, 4), -1.0), measure, separation, UNUSED)
    deviations = np.array([MAX_DEVIATION, 5e303, 0.1])
    bounds = pairs.interval_bounds(np.zeros(1), np.zeros(3), deviations)
    assert (bounds[:2] < 0).all()
    assert bounds[2] == pytest.approx(0.4)
    assert set(measured) <= {2, 3}
