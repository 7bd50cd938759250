"""Measuring only where it can matter: the smallest distance is found, whatever the distances are."""

import numpy as np
import pytest

from cnpgen.world.sweep import RESOLUTION, sweep

NOWHERE = np.full(3, np.nan)


def searched(
    truth: np.ndarray, bounds: np.ndarray, directions: bool = True
) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Sweep distances that are known; a direction raises the bounds of its pair to the truth less a cone."""
    calls: list[tuple[int, int]] = []

    def measure(pair: int, k: int) -> tuple[float, np.ndarray]:
        calls.append((pair, k))
        return float(truth[pair, k]), np.array([1.0, 0.0, float(k)]) if directions else NOWHERE

    def separate(pair: int, direction: np.ndarray) -> np.ndarray:
        return truth[pair] - 1e-3 * np.abs(np.arange(truth.shape[1]) - direction[2])

    return sweep(bounds, measure, separate), calls


@pytest.mark.parametrize("directions", [True, False])
@pytest.mark.parametrize("seed", range(15))
def test_the_smallest_distance_is_found_and_stands_where_it_is(seed: int, directions: bool) -> None:
    random = np.random.default_rng(seed)
    pairs, states = random.integers(1, 6), random.integers(1, 300)
    truth = np.cumsum(random.normal(0, 0.01, (pairs, states)), axis=1) + random.uniform(-0.2, 0.2, (pairs, 1))
    bounds = truth - random.exponential(0.05, truth.shape)
    found, calls = searched(truth, bounds, directions)
    assert found.shape == truth.shape
    assert abs(found.min() - truth.min()) <= RESOLUTION
    where = np.unravel_index(np.argmin(found), found.shape)
    assert found[where] == truth[where]
    assert where in calls
    assert len(set(calls)) == len(calls)
    for pair, k in calls:
        assert found[pair, k] == truth[pair, k]
    assert np.all(found <= np.maximum(truth, np.nextafter(found.min(), 1)) + 1e-15)


def test_directions_save_most_measurements() -> None:
    truth = 0.3 + 0.2 * np.cos(np.linspace(0, 9, 2000))[None]
    _, calls = searched(truth, np.full(truth.shape, -1.0))
    assert len(calls) < 200


def test_where_all_distances_are_equal_one_measurement_is_enough() -> None:
    found, calls = searched(np.zeros((3, 500)), np.zeros((3, 500)), directions=False)
    assert len(calls) == 1
    assert np.all(np.delete(found.ravel(), np.argmin(found)) > 0)


def test_a_distance_that_cannot_be_measured_is_told_and_ends_the_search() -> None:
    truth = np.array([[0.3, np.nan, 0.2]])
    found, calls = searched(truth, np.array([[0.2, 0.1, 0.15]]))
    assert calls == [(0, 1)]
    assert np.isnan(found[0, 1])


def test_without_pairs_there_are_no_distances() -> None:
    assert sweep(np.zeros((0, 7)), lambda *_: (0.0, NOWHERE), lambda *_: NOWHERE).shape == (0, 7)
