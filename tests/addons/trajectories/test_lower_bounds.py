"""Lower bounds hold for every curve: never above a true derivative, equal to optima of linear programs, and tight."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import linprog

from cnpgen.addons.trajectories.lower_bounds import (
    first_derivatives,
    second_derivatives,
    second_derivatives_with_velocities,
    swing_velocities,
    third_derivatives,
)

RATES = np.array([3.0, 5.0])


def wave(t: np.ndarray, order: int = 0) -> np.ndarray:
    """Return derivatives of a motion of two joints, shape (K, 2)."""
    return np.asarray(
        RATES**order * np.sin(RATES * t[:, None] + 0.3 + order * np.pi / 2)
    )


def largest(found) -> np.ndarray:
    """Return the largest bound of each joint's absolute derivative."""
    return np.max([np.maximum(b.low, -b.high).max(axis=0) for b in found], axis=0)


@pytest.mark.parametrize("rate", [10, 30, 100, 500])
@pytest.mark.parametrize("noise", [0.0, 5e-5, 1e-3])
@pytest.mark.parametrize("jitter", [0.0, 2e-3])
def test_bounds_are_never_above_the_derivatives_of_the_motion(
    rate: int, noise: float, jitter: float
) -> None:
    random = np.random.default_rng(rate)
    t = np.arange(int(3 * rate)) / rate
    at = t + jitter * random.uniform(-1, 1, t.shape)
    q, dq = (wave(at, k) + noise * random.uniform(-1, 1, (len(t), 2)) for k in range(2))
    limit = 1 + 1e-9
    assert (largest(first_derivatives(t, q, noise, jitter)) <= RATES * limit).all()
    assert (largest(swing_velocities(t, q, noise, jitter)) <= RATES * limit).all()
    assert (largest(second_derivatives(t, q, noise, jitter)) <= RATES**2 * limit).all()
    moved = noise + RATES.max() * jitter  # positions differ by at most V d
    assert (largest(third_derivatives(t, q, moved)) <= RATES**3 * limit).all()
    errors = moved, noise + RATES.max() ** 2 * jitter
    both = second_derivatives_with_velocities(t, q, dq, errors)
    assert (largest(both) <= RATES**2 * limit).all()


def test_bounds_of_exact_samples_are_close_to_the_largest_derivatives() -> None:
    t = np.arange(300) / 100
    found = [
        largest(first_derivatives(t, wave(t), 0.0)) / RATES,
        largest(second_derivatives(t, wave(t), 0.0)) / RATES**2,
        largest(third_derivatives(t, wave(t), 0.0)) / RATES**3,
    ]
    assert (np.array(found) > 0.99).all()


def test_a_parabola_has_its_acceleration_at_irregular_times() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.05, 50))
    q = 3.5 * t[:, None] ** 2
    assert largest(second_derivatives(t, q, 0.0)) == pytest.approx(7.0, rel=1e-6)
    assert largest(third_derivatives(t, q, 0.0)) < 1e-3


def test_samples_whose_order_jitter_hides_bound_no_acceleration() -> None:
    t = np.arange(50) * 2e-3
    q = np.where(np.arange(50)[:, None] % 2, 1e-3, 0.0)
    short = next(iter(second_derivatives(t, q, 0.0, 1.1e-3)))
    assert np.isinf(short.low).all()
    assert np.isinf(short.high).all()


def test_a_sample_aside_needs_the_velocity_of_the_way_to_it_and_back() -> None:
    t, q = np.arange(9) / 30, np.zeros((9, 1))
    q[4] = 0.4
    # At least 0.4 rad to and fro within two spans and both jitters, with an error each.
    least = 2 * (0.4 - 2e-2) / (2 / 30 + 1 / 30)
    assert largest(swing_velocities(t, q, 1e-2, 1 / 60)) == pytest.approx(least)
    assert largest(first_derivatives(t, q, 1e-2, 1 / 60)) < 0.76 * least


def smallest_acceleration(t: np.ndarray, q: np.ndarray, noise: float) -> float:
    """Return the smallest sup |ddq| of curves through positions, by a linear program.

    Accelerations are constant in ten parts of every span, so the optimum is at least
    that of all curves.
    """
    grid = np.unique(np.concatenate([np.linspace(a, b, 11) for a, b in pairwise(t)]))
    h, size = np.diff(grid), len(grid) - 1
    rest = np.maximum(t[:, None] - grid[:-1], 0.0)
    after = np.maximum(t[:, None] - grid[1:], 0.0)
    rows = np.column_stack([np.ones_like(t), t, (rest**2 - after**2) / 2, 0 * t])
    bound = np.column_stack([np.zeros((size, 2)), np.eye(size), -np.ones(size)])
    below = bound * np.concatenate([[1, 1], -np.ones(size), [1]])
    solution = linprog(
        np.eye(size + 3)[-1],
        A_ub=np.concatenate([rows, -rows, bound, below]),
        b_ub=np.concatenate([q + noise, noise - q, np.zeros(2 * size)]),
        bounds=[(None, None)] * (size + 2) + [(0, None)],
    )
    assert solution.status == 0, h
    return float(solution.x[-1])


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("fault", [0.0, 0.05])
def test_the_bound_is_at_most_the_smallest_acceleration_of_a_linear_program(
    noise: float, fault: float
) -> None:
    t = np.arange(13) / 30
    q = wave(t)[:, :1] + noise * np.random.default_rng(1).uniform(-1, 1, (13, 1))
    q[6] += fault
    bound = float(largest(second_derivatives(t, q, noise))[0])
    optimum = smallest_acceleration(t, q[:, 0], noise)
    assert bound <= optimum * (1 + 1e-6)
    assert bound >= 0.5 * optimum if fault else bound > 0


def test_positions_and_velocities_need_the_acceleration_of_the_fastest_switch() -> None:
    # Bang-bang motion: +A for 0.3 s, then -A for 0.7 s, is the only one within A.
    limit, switch = 4.0, 0.3
    dq1 = limit * (switch - 0.7)
    q1 = limit * (switch**2 / 2 + switch * 0.7 - 0.7**2 / 2)
    t, q, dq = np.array([0.0, 1.0]), np.array([[0.0], [q1]]), np.array([[0.0], [dq1]])
    found = largest(second_derivatives_with_velocities(t, q, dq, (0.0, 0.0)))
    assert found == pytest.approx(limit, rel=1e-9)
