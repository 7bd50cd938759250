"""Adam against the published formulas."""

import numpy as np
import pytest

from cnpgen.training import adam as module
from cnpgen.training.adam import start_adam


def published(
    first: np.ndarray, gradients: list[np.ndarray], rate: float
) -> np.ndarray:
    """Return the result of Algorithm 1 of Kingma and Ba, with its default constants."""
    x, m, v = first.copy(), np.zeros_like(first), np.zeros_like(first)
    for t, g in enumerate(gradients, 1):
        m = 0.9 * m + 0.1 * g
        v = 0.999 * v + 0.001 * g**2
        x = x - rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
    return x


@pytest.mark.parametrize("block", [1 << 17, 7])
def test_steps_equal_the_published_algorithm_for_any_block_size(monkeypatch, block):
    monkeypatch.setattr(module, "PARAMETERS_PER_BLOCK", block)
    random = np.random.default_rng(0)
    first, gradients = (
        random.normal(size=50),
        [random.normal(size=50) for _ in range(30)],
    )
    adam = start_adam(first.copy())
    for gradient in gradients:
        adam.update(gradient, rate=0.01)
    np.testing.assert_allclose(
        adam.parameters, published(first, gradients, 0.01), rtol=1e-9
    )
    assert adam.step == 30


def test_the_average_follows_the_parameters_quickly_at_first_and_slowly_later():
    adam = start_adam(np.zeros(1))
    expected, random = 0.0, np.random.default_rng(1)
    for step in range(1, 60):
        adam.update(random.normal(size=1) - 1, rate=0.1, memory=0.9)
        keep = min(0.9, (1 + step) / (10 + step))
        expected = keep * expected + (1 - keep) * adam.parameters[0]
        assert adam.average[0] == pytest.approx(expected, rel=1e-9)


def test_float32_stays_float32():
    adam = start_adam(np.ones(5, np.float32))
    adam.update(np.ones(5, np.float32), rate=1e-3)
    assert {
        adam.parameters.dtype,
        adam.average.dtype,
        adam.first.dtype,
        adam.second.dtype,
    } == {np.dtype(np.float32)}
    np.testing.assert_allclose(adam.parameters, 1 - 1e-3, rtol=1e-5)
