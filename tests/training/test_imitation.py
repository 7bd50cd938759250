"""Imitation: its gradient agrees with finite differences, and plans approach those of a certified dataset."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.make.certify import certified
from cnpgen.make.make_dataset import make_dataset
from cnpgen.planner.control_points import ControlPoints
from cnpgen.planner.network.architecture import initial_parameters
from cnpgen.planner.plan_requests import read_rows
from cnpgen.planner.planner import Planner
from cnpgen.training.adam import Clipping
from cnpgen.training.data import open_training_data
from cnpgen.training.step import imitation_loss
from cnpgen.training.train import train_model
from cnpgen.training.training_options import TrainingOptions
from tests.conftest import columns_of, tiny_recipe
from tests.examples.grouped import grouped
from tests.examples.models import SMALL, boundary_of_columns, learner_of
from tests.refusals import is_refused

UNCLIPPED = replace(SMALL, sample_clip=np.inf, batch_clip=np.inf)


@pytest.fixture(scope="module")
def target(tmp_path_factory) -> Path:
    """A small certified dataset of hits."""
    folder = tmp_path_factory.mktemp("certified") / "hits"
    recipe = replace(
        certified(tiny_recipe("airhockey-hit")), splits={"train": 32, "validation": 6}
    )
    make_dataset(recipe, folder, workers=1)
    return folder


def points(seed: int, count: int = 4) -> ControlPoints:
    random = np.random.default_rng(seed)
    return ControlPoints(
        random.normal(size=(count, 15, 6)), np.exp(random.normal(size=(count, 20)))
    )


def test_the_distance_is_half_the_squared_differences_of_path_points_and_log_rates():
    one, other = points(0), points(1)
    expected = 0.5 * ((one.path - other.path) ** 2).sum(axis=(1, 2))
    expected += 0.5 * (np.log(one.rate / other.rate) ** 2).sum(axis=1)
    np.testing.assert_allclose(imitation_loss(one, other).total, expected, rtol=1e-12)
    np.testing.assert_array_equal(imitation_loss(one, one).total, 0)


def test_its_gradient_is_that_of_finite_differences():
    one, other = points(0), points(1)
    value, random = imitation_loss(one, other), np.random.default_rng(2)
    by_path, by_rate = (
        random.normal(size=one.path.shape),
        random.normal(size=one.rate.shape),
    )

    def total(step: float) -> np.ndarray:
        moved = ControlPoints(one.path + step * by_path, one.rate + step * by_rate)
        return imitation_loss(moved, other).total

    found = (total(1e-6) - total(-1e-6)) / 2e-6
    gradient = (value.path_gradient * by_path).sum(axis=(1, 2)) + (
        value.rate_gradient * by_rate
    ).sum(axis=1)
    np.testing.assert_allclose(gradient, found, rtol=1e-7)


@pytest.mark.slow
def test_network_boundary_and_distance_together_have_the_gradient_of_finite_differences(
    tiny,
):
    boundary = boundary_of_columns(columns_of(tiny("airhockey-replan")), 6)
    learner, rows = learner_of(
        "airhockey", boundary, dtype="float64", settings=UNCLIPPED
    )
    rows = replace(rows, target=points(3, 6))
    parameters = initial_parameters(
        learner.architecture, seed=0, head_scale=1.0, rate_bias=-0.5
    ).astype(float)
    gradient, scratch = np.empty_like(parameters), np.empty_like(parameters)
    learner.imitation_gradient(parameters, rows, clipping=Clipping(), out=gradient)

    def mean(parameters: np.ndarray) -> float:
        return float(
            learner.imitation_gradient(
                parameters, rows, clipping=Clipping(), out=scratch
            ).mean()
        )

    for direction in np.random.default_rng(1).normal(size=(4, len(parameters))):
        step = 1e-6 * direction / np.linalg.norm(direction)
        found = mean(parameters + step) - mean(parameters - step)
        assert 2 * gradient @ step == pytest.approx(found, rel=1e-5)


def test_demonstrations_are_the_plans_of_the_rows(target):
    found, columns = open_training_data(target).demonstrations(6), columns_of(target)
    assert found is not None
    assert found.path.shape == (32, 15, 6)
    np.testing.assert_allclose(
        found.path[7].ravel(), columns["path_control_points"][7], rtol=1e-6
    )
    np.testing.assert_allclose(found.path[:, 0], columns["start_q"], atol=1e-6)
    np.testing.assert_allclose(found.rate, columns["rate_control_points"], rtol=1e-6)


@pytest.mark.slow
def test_a_run_imitates_first_and_then_minimizes_the_loss(target, tmp_path):
    settings = replace(SMALL, imitation=0.75, hidden=32, warm_up=10)
    trained = train_model(
        target, tmp_path / "m.h5", steps=400, settings=settings, check_rows=2, workers=1
    )
    lines = [json.loads(line) for line in trained.model.log.splitlines()]
    distances = [line["imitation"] for line in lines if "imitation" in line]
    assert len(distances) == 75
    assert distances[-1] < 0.1 * distances[0]
    losses = [line["step"] for line in lines if "loss" in line]
    assert losses == list(range(304, 401, 4))


@pytest.mark.slow
def test_an_interrupted_imitating_run_resumes_exactly(target, tmp_path, monkeypatch):
    from tests.training.test_training_run import CutOffError, checkpoints, cut_at

    monkeypatch.setattr(checkpoints, "MIN_INTERVAL_S", 0.0)
    monkeypatch.setattr(checkpoints, "INTERVAL_PER_WRITING_TIME", 0.0)
    settings = replace(SMALL, imitation=0.5)

    def train(name: str, **options):
        arguments = {
            "steps": 20,
            "settings": settings,
            "check_rows": 2,
            "workers": 1,
            **options,
        }
        return grouped(
            train_model, TrainingOptions, target, tmp_path / name, **arguments
        )

    whole = train("whole.h5")
    for step in (4, 9, 14):
        with pytest.raises(CutOffError):
            train("cut.h5", watch=cut_at(step))
    np.testing.assert_array_equal(
        train("cut.h5").model.parameters, whole.model.parameters
    )


def test_imitating_a_dataset_without_plans_raises_an_error(tiny, tmp_path):
    with is_refused(UsageError):
        train_model(
            tiny("airhockey-hit"),
            tmp_path / "m.h5",
            steps=4,
            settings=replace(SMALL, imitation=0.5),
        )


@pytest.mark.parametrize("wrong", [-0.1, 1.0, float("nan")])
def test_an_invalid_fraction_of_imitation_raises_an_error(wrong):
    with is_refused(UsageError, argument="imitation"):
        replace(SMALL, imitation=wrong)


def test_a_model_of_a_certified_dataset_plans_for_the_rows_of_the_plain_one(
    target, tiny, tmp_path
):
    trained = train_model(
        target, tmp_path / "m.h5", steps=4, settings=SMALL, check_rows=2, workers=1
    )
    planner = Planner(trained.model)
    asked = read_rows(tiny("airhockey-hit"), planner.model)
    assert len(planner.plan_batch(asked.boundary)) == 60
