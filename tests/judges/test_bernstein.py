"""Joint positions, velocities, accelerations and jerks in Bernstein form: values and maxima."""

import numpy as np
import pytest
import scipy

from cnpgen.judges.plans.bernstein import (
    LIMIT_DECISION_TOLERANCE,
    LIMIT_VALUE_TOLERANCE,
    find_maximum,
    polynomials,
)
from tests.examples.plans import load, perturbed, reference_trajectory


def value(coefficients: np.ndarray, edges: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Evaluate functions in Bernstein form with SciPy: (d + 1, S, M) at (K,) -> (M, K)."""
    return np.asarray(scipy.interpolate.BPoly(coefficients, edges)(s).T)


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_polynomials_equal_the_motion(label: str) -> None:
    plan = perturbed(load(label), 0.05, seed=1)
    spans, exact = polynomials(plan.motion, jerk=True), reference_trajectory(plan)
    for name in ("q", "dq", "ddq", "jerk"):
        found, wanted = (
            value(getattr(spans, name), spans.edges, exact.s),
            getattr(exact, name).T,
        )
        np.testing.assert_allclose(
            found, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max()
        )


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("parts", [2, 8])
def test_the_maximum_agrees_with_a_very_fine_grid(
    label: str, parts: int, seed: int
) -> None:
    spans = polynomials(perturbed(load(label), 0.05, seed=seed).motion, jerk=True)
    values = spans.ddq if seed % 2 else spans.jerk
    rows = values / np.abs(values).max() * 3
    found, row, s = find_maximum(rows, spans.edges, parts=parts)
    grid = value(rows, spans.edges, np.linspace(0, 1, 20001))
    assert (
        grid.max() - LIMIT_VALUE_TOLERANCE <= found <= grid.max() + 1e-5
    )  # resolution of the grid
    assert row == np.argmax(grid.max(axis=1))
    assert value(rows, spans.edges, np.array([s]))[row, 0] == pytest.approx(
        found, abs=1e-9
    )


def test_a_maximum_between_samples_is_found() -> None:
    """-(s - 1/pi)^2 has its maximum at 1/pi, which is not a dyadic number."""
    at = 1 / np.pi
    rows = np.reshape(
        [2 - at**2, 2 - at**2 + at, 2 - (1 - at) ** 2], (3, 1, 1)
    )  # 2 - (s - at)^2 in Bernstein form
    found, row, s = find_maximum(rows, np.array([0.0, 1.0]))
    assert (found, row, s) == (
        pytest.approx(2, abs=LIMIT_VALUE_TOLERANCE),
        0,
        pytest.approx(at, abs=0.1),
    )


@pytest.mark.parametrize("threshold", [-np.inf, 1.0])
@pytest.mark.parametrize("parts", [2, 8])
@pytest.mark.parametrize("top", [1 + 2 * LIMIT_DECISION_TOLERANCE, 1 - 1e-9])
def test_a_maximum_above_1_is_decided_exactly(
    top: float, parts: int, threshold: float
) -> None:
    at = 1 / np.pi
    rows = np.reshape([top - at**2, top - at**2 + at, top - (1 - at) ** 2], (3, 1, 1))
    found, _, _ = find_maximum(
        rows, np.array([0.0, 1.0]), threshold=threshold, parts=parts
    )
    assert found <= top
    assert found >= top - LIMIT_DECISION_TOLERANCE or top <= threshold
    assert (found > 1) == (top > 1)


def test_spans_below_the_threshold_are_not_searched() -> None:
    rows = np.reshape([0.0, 0.9, 0.0], (3, 1, 1))  # never above 0.45
    assert find_maximum(rows, np.array([0.0, 1.0]), (0.1, 0, 0.2), threshold=1.0) == (
        0.1,
        0,
        0.2,
    )


def test_the_maximum_of_a_constant_is_its_value() -> None:
    found, row, s = find_maximum(np.full((8, 4, 3), 1.5), np.linspace(0, 1, 5))
    assert found == 1.5
    assert row == 0
    assert s == 0
