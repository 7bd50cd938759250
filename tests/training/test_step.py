"""A training step: the gradient of network, boundary conditions and loss against finite differences; clipping."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.planner.network.architecture import initial_parameters
from cnpgen.training.adam import Clipping, start_adam
from cnpgen.training.step import Learner
from cnpgen.training.training_rows import Rows
from tests.conftest import columns_of, some
from tests.examples.models import SMALL, accelerated, boundary_of_columns, learner_of

UNCLIPPED = replace(SMALL, sample_clip=np.inf, batch_clip=np.inf)
NAMES = {"airhockey-replan": "airhockey", "heavy-object": "heavy-object"}


def prepared(
    tiny, dataset: str, count: int = 6, *, fixed: int = 2
) -> tuple[Learner, Rows, np.ndarray]:
    boundary = boundary_of_columns(columns_of(tiny(dataset)), count)
    boundary = boundary if fixed == 2 else accelerated(boundary)
    learner, rows = learner_of(
        NAMES[dataset], boundary, dtype="float64", settings=UNCLIPPED
    )
    parameters = initial_parameters(
        learner.architecture, seed=0, head_scale=1.0, rate_bias=-0.5
    )
    return learner, rows, parameters.astype(float)


def weighted(
    learner: Learner, parameters: np.ndarray, rows: Rows, weights: np.ndarray
) -> float:
    """Return the mean loss of a batch."""
    terms = learner.gradient(
        parameters,
        rows,
        weights,
        shift=0.3,
        clipping=Clipping(),
        out=np.empty_like(parameters),
    )
    return float(np.mean(terms[:, 0] + terms[:, 1:] @ weights))


@pytest.mark.parametrize(
    ("dataset", "directions"),
    [
        ("airhockey-replan", 3),
        pytest.param("heavy-object", 1, marks=pytest.mark.extended),
    ],
)
def test_the_gradient_of_network_boundary_and_loss_together_is_that_of_finite_differences(
    tiny, dataset, directions
):
    learner, rows, parameters = prepared(tiny, dataset)
    names = learner.loss.terms[1:]
    for active in range(-1, len(names)):  # the task loss alone, then every term with it
        weights = np.zeros(len(names))
        if active >= 0:
            weights[active] = {"table": 1e3, "vertical": 1e3}.get(names[active], 1.0)
        gradient = np.empty_like(parameters)
        learner.gradient(
            parameters, rows, weights, shift=0.3, clipping=Clipping(), out=gradient
        )
        for direction in np.random.default_rng(1).normal(
            size=(directions, len(parameters))
        ):
            step = 1e-6 * direction / np.linalg.norm(direction)
            high, low = (
                weighted(learner, parameters + sign * step, rows, weights)
                for sign in (1, -1)
            )
            found = (high - low) / (2 * np.linalg.norm(step))
            expected = gradient @ step / np.linalg.norm(step)
            assert expected == pytest.approx(
                found, rel=2e-5, abs=1e-7 * np.linalg.norm(gradient)
            ), names[active]


@pytest.mark.parametrize("fixed", some([3, 2], 0, "slow"))
def test_derivatives_by_single_parameters_agree_with_finite_differences(tiny, fixed):
    learner, rows, parameters = prepared(tiny, "airhockey-replan", fixed=fixed)
    weights, gradient = np.ones(len(learner.loss.terms) - 1), np.empty_like(parameters)
    learner.gradient(
        parameters, rows, weights, shift=0.3, clipping=Clipping(), out=gradient
    )
    for i in np.random.default_rng(2).integers(0, len(parameters), 20):
        step = np.zeros_like(parameters)
        step[i] = 1e-5
        high, low = (
            weighted(learner, parameters + sign * step, rows, weights)
            for sign in (1, -1)
        )
        assert gradient[i] == pytest.approx(
            (high - low) / 2e-5, rel=1e-4, abs=1e-6 * np.linalg.norm(gradient)
        )


@pytest.mark.slow
def test_a_plan_with_a_loss_of_nan_does_not_affect_the_gradient_of_others(tiny):
    learner, rows, parameters = prepared(tiny, "heavy-object")
    poses = np.where(np.arange(6)[:, None] == 2, np.nan, rows.tasks.scene.poses)
    broken = replace(
        rows, tasks=replace(rows.tasks, scene=replace(rows.tasks.scene, poses=poses))
    )
    weights, gradient = np.ones(len(learner.loss.terms) - 1), np.empty_like(parameters)
    terms = learner.gradient(
        parameters, broken, weights, shift=0.3, clipping=Clipping(), out=gradient
    )
    assert np.isnan(terms[2]).all()
    expected = np.empty_like(parameters)
    others = rows.take(np.array([0, 1, 3, 4, 5]))
    learner.gradient(
        parameters, others, weights, shift=0.3, clipping=Clipping(), out=expected
    )
    np.testing.assert_allclose(gradient, expected * 5 / 6, rtol=1e-7, atol=1e-10)


@pytest.mark.slow
def test_the_gradient_of_a_sample_is_clipped_to_the_limit(tiny):
    learner, rows, parameters = prepared(tiny, "heavy-object")
    clipped = replace(learner, settings=replace(UNCLIPPED, sample_clip=1.0))
    alone, weights = [], np.full(len(learner.loss.terms) - 1, 1e3)
    for i in range(len(rows)):
        gradient = np.empty_like(parameters)
        learner.gradient(
            parameters,
            rows.take(np.array([i])),
            weights,
            shift=0.3,
            clipping=Clipping(),
            out=gradient,
        )
        alone.append(gradient)
    together = np.empty_like(parameters)
    clipped.gradient(
        parameters, rows, weights, shift=0.3, clipping=Clipping(), out=together
    )
    whole = np.mean(alone, axis=0)
    assert np.linalg.norm(together) < np.linalg.norm(whole)
    assert together @ whole > 0


def test_a_gradient_that_is_not_finite_changes_no_parameter(tiny):
    learner, _, parameters = prepared(tiny, "airhockey-replan")
    adam, before = start_adam(parameters), parameters.copy()
    learner.update(adam, Clipping(), np.full_like(parameters, np.nan), rate=1e-3)
    np.testing.assert_array_equal(adam.parameters, before)
    assert adam.step == 1  # a run still ends after its number of steps
