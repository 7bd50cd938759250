"""The network: its layers against the formulas written out, its gradient against finite differences."""

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.planner.network.architecture import (
    Activations,
    Architecture,
    backward,
    forward,
    initial_parameters,
)
from tests.refusals import is_refused

SMALL = Architecture(inputs=5, hidden=7, layers=3, path_outputs=6, rate_outputs=4)


def random_parameters(architecture: Architecture, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.5, architecture.n_parameters)


def test_the_layers_share_the_vector_of_parameters_without_gap_or_overlap():
    numbers = np.arange(SMALL.n_parameters)
    found = np.concatenate(
        [part.ravel() for layer in SMALL.split(numbers) for part in layer]
    )
    np.testing.assert_array_equal(np.sort(found), numbers)
    assert (
        SMALL.n_parameters
        == (5 + 1) * 7 + 2 * (7 + 1) * 7 + (7 + 1) * 7 + (7 + 1) * 6 + (7 + 1) * 4
    )


def test_the_network_is_a_tanh_trunk_with_a_tanh_head_and_a_linear_one():
    parameters, random = random_parameters(SMALL), np.random.default_rng(1)
    x = random.normal(size=5)
    weights = SMALL.split(parameters)
    h = x
    for weight, bias in weights[:3]:
        h = np.array(
            [
                np.tanh(sum(h[i] * weight[i, j] for i in range(len(h))) + bias[j])
                for j in range(7)
            ]
        )
    (wh, bh), (wp, bp), (wr, br) = weights[3:]
    path, rate = np.tanh(np.tanh(h @ wh + bh) @ wp + bp), h @ wr + br
    given = forward(weights, x[None])
    np.testing.assert_allclose(given.path[0], path, rtol=1e-12)
    np.testing.assert_allclose(given.log_rate[0], rate, rtol=1e-12)


@pytest.mark.parametrize("layers", [1, 4])
def test_the_gradient_of_every_parameter_is_that_of_finite_differences(layers):
    architecture = Architecture(
        inputs=4, hidden=5, layers=layers, path_outputs=3, rate_outputs=2
    )
    parameters, random = random_parameters(architecture), np.random.default_rng(2)
    x, a, b = (
        random.normal(size=(6, 4)),
        random.normal(size=(6, 3)),
        random.normal(size=(6, 2)),
    )

    def scalar(parameters: np.ndarray) -> float:
        given = forward(architecture.split(parameters), x)
        return float((given.path * a).sum() + (given.log_rate * b).sum())

    gradient = np.full_like(parameters, np.nan)
    weights = architecture.split(parameters)
    out = architecture.split(gradient)
    backward(
        weights, forward(weights, x), path_gradient=a, log_rate_gradient=b, out=out
    )
    for i in range(len(parameters)):
        step = np.zeros_like(parameters)
        step[i] = 1e-6
        found = (scalar(parameters + step) - scalar(parameters - step)) / 2e-6
        assert gradient[i] == pytest.approx(found, rel=1e-6, abs=1e-8)


def test_float32_stays_float32_and_differs_from_float64_by_rounding_only():
    parameters, x = (
        random_parameters(SMALL),
        np.random.default_rng(3).normal(size=(9, 5)),
    )
    exact = forward(SMALL.split(parameters), x)
    rounded = forward(SMALL.split(parameters.astype(np.float32)), x.astype(np.float32))
    for name in ("path", "log_rate"):
        found = getattr(rounded, name)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, getattr(exact, name), atol=2e-6)


def test_rows_are_independent():
    parameters, x = (
        random_parameters(SMALL),
        np.random.default_rng(4).normal(size=(5, 5)),
    )
    together = forward(SMALL.split(parameters), x)
    for i in range(5):
        alone = forward(SMALL.split(parameters), x[i : i + 1])
        np.testing.assert_allclose(alone.path[0], together.path[i], rtol=1e-12)


def first(seed: int, **changes: float) -> Activations:
    options = {"head_scale": 0.1, "rate_bias": -0.5, **changes}
    parameters = initial_parameters(SMALL, seed=seed, **options)
    return forward(
        SMALL.split(parameters),
        np.random.default_rng(5).normal(size=(50, 5)).astype(np.float32),
    )


def test_an_untrained_network_plans_nearly_straight_at_a_nearly_constant_rate():
    given = first(0, head_scale=0.01)
    assert np.abs(given.path).max() < 0.05
    assert np.abs(given.log_rate + 0.5).max() < 0.05


def test_initial_parameters_depend_on_the_seed_only():
    np.testing.assert_array_equal(first(3).path, first(3).path)
    assert np.abs(first(3).path - first(4).path).max() > 1e-3


def test_a_network_without_layers_raises_an_error():
    with is_refused(UsageError):
        Architecture(inputs=5, hidden=7, layers=0, path_outputs=6, rate_outputs=4)
