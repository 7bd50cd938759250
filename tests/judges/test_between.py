"""Joint positions, velocities, accelerations and jerks as polynomials: the same functions, and their largest values."""

import numpy as np
import pytest
from scipy.interpolate import BPoly

from cnpgen.judges.plans.between import CLOSE, ROUGH, largest, polynomials
from tests.examples.plans import bent, course, load


def value(coefficients: np.ndarray, edges: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Functions in Bernstein form, by SciPy: (d + 1, S, M) at (K,) -> (M, K)."""
    return np.asarray(BPoly(coefficients, edges)(s).T)


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_polynomials_are_the_motion(label: str) -> None:
    plan = bent(load(label), 0.05, seed=1)
    pieces, exact = polynomials(plan.motion, jerk=True), course(plan)
    for name in ("q", "dq", "ddq", "jerk"):
        found, wanted = value(getattr(pieces, name), pieces.edges, exact.s), getattr(exact, name).T
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("parts", [2, 8])
def test_the_largest_value_is_that_of_a_very_fine_grid(label: str, parts: int, seed: int) -> None:
    pieces = polynomials(bent(load(label), 0.05, seed=seed).motion, jerk=True)
    values = pieces.ddq if seed % 2 else pieces.jerk
    rows = values / np.abs(values).max() * 3
    found, row, s = largest(rows, pieces.edges, parts=parts)
    grid = value(rows, pieces.edges, np.linspace(0, 1, 20001))
    assert grid.max() - ROUGH <= found <= grid.max() + 1e-5  # the grid's own gaps
    assert row == np.argmax(grid.max(axis=1))
    assert value(rows, pieces.edges, np.array([s]))[row, 0] == pytest.approx(found, abs=1e-9)


def test_a_peak_between_any_two_moments_of_a_grid_is_found() -> None:
    """(s - 1/pi)^2 has its largest negative at 1/pi, which no dyadic number is."""
    at = 1 / np.pi
    rows = np.reshape([2 - at**2, 2 - at**2 + at, 2 - (1 - at) ** 2], (3, 1, 1))  # 2 - (s - at)^2 in Bernstein form
    found, row, s = largest(rows, np.array([0.0, 1.0]))
    assert (found, row, s) == (pytest.approx(2, abs=ROUGH), 0, pytest.approx(at, abs=0.1))


@pytest.mark.parametrize("least", [-np.inf, 1.0])
@pytest.mark.parametrize("parts", [2, 8])
@pytest.mark.parametrize("top", [1 + 2 * CLOSE, 1 - 1e-9])
def test_whether_a_peak_is_above_1_is_known_exactly(top: float, parts: int, least: float) -> None:
    at = 1 / np.pi
    rows = np.reshape([top - at**2, top - at**2 + at, top - (1 - at) ** 2], (3, 1, 1))
    found, _, _ = largest(rows, np.array([0.0, 1.0]), least=least, parts=parts)
    assert found <= top
    assert found >= top - CLOSE or top <= least
    assert (found > 1) == (top > 1)


def test_what_is_proven_to_be_small_is_not_looked_into() -> None:
    rows = np.reshape([0.0, 0.9, 0.0], (3, 1, 1))  # never above 0.45
    assert largest(rows, np.array([0.0, 1.0]), (0.1, 0, 0.2), least=1.0) == (0.1, 0, 0.2)


def test_a_constant_is_its_own_largest_value() -> None:
    found, row, s = largest(np.full((8, 4, 3), 1.5), np.linspace(0, 1, 5))
    assert found == 1.5
    assert row == 0
    assert s == 0
