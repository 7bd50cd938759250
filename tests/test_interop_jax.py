"""The bridge to JAX, against JAX itself."""

# ruff: noqa: E402 - without the framework nothing else is imported
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loader_example import ALL, make

jax = pytest.importorskip("jax")

from cnpgen.errors import UsageError
from cnpgen.interop.jax import plan_loss, to_jax
from cnpgen.library import load_problem
from cnpgen.loader.batch import Batch
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from cnpgen.losses.plan_loss import PlanLoss


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(make(tmp_path_factory.mktemp("loader") / "set", shard_size=8))


def x64() -> Any:
    return jax.enable_x64(True) if hasattr(jax, "enable_x64") else jax.experimental.enable_x64()


def test_arrays_have_the_batch_s_numbers(dataset: Dataset) -> None:
    for batch in dataset.batches(8, fields=ALL):
        arrays = to_jax(batch)
        assert list(arrays) == list(ALL)
        for name, values in batch.items():
            assert isinstance(arrays[name], jax.Array)
            assert np.array_equal(arrays[name], values)
        assert arrays["start_q"].dtype == np.float32


def test_all_digits_are_kept_or_it_is_refused(dataset: Dataset) -> None:
    batch = next(iter(dataset.batches(8, fields=ALL, dtype="float64")))
    with pytest.raises(UsageError, match="would shorten float64"):
        to_jax(batch)
    large = Batch(batch.table.astype(np.float32), batch.layout, {"sample_id": batch["sample_id"] + 2**31})
    with pytest.raises(UsageError, match="would shorten the integers of sample_id"):
        to_jax(large)
    with x64():
        for given in (batch, large):
            assert all(np.array_equal(values, given[name]) for name, values in to_jax(given).items())
            assert to_jax(given)["sample_id"].dtype == np.int64


def test_a_jitted_step_takes_the_batches_of_several_epochs(dataset: Dataset) -> None:
    step = jax.jit(lambda total, batch: total + batch["start_q"].sum() + batch["goal_p"].sum())
    total, batches = 0.0, dataset.batches(10)
    for _ in range(2):
        for batch in batches:
            total = step(total, to_jax(batch))
    assert abs(total) < 1e-3  # every epoch is all rows, and their normalised mean is 0


# The loss.


@pytest.fixture(scope="module", params=["airhockey", "heavy-object"])
def problem(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def make_loss(problem: str, dtype: Any, cache_folder: Path, backend: Any) -> PlanLoss:
    return PlanLoss(load_problem(problem), dtype=dtype, nodes=12, backend=backend, cache_folder=cache_folder)


def plans(problem: str, count: int) -> dict[str, np.ndarray]:
    """Draw plans, weights and, where there are obstacles, their heights."""
    found, random = load_problem(problem), np.random.default_rng(1)
    base, spec = np.array(found.robot.base), found.trajectory
    arrays = {
        "path": base + 0.3 * random.standard_normal((count, spec.path_control_points, len(base))),
        "rate": random.uniform(1.0, 2.0, (count, spec.rate_control_points)),
        "weights": random.uniform(0.5, 2.0, len(found.constraint)),
    }
    return arrays | ({"tops": random.uniform(0.2, 0.4, (count, 2))} if problem == "heavy-object" else {})


@pytest.mark.parametrize("jitted", [True, False])
def test_the_loss_s_gradients_are_those_of_differences(
    problem: str, jitted: bool, cache_folder: Path, fastest: Any
) -> None:
    loss, given, random = (
        make_loss(problem, "float64", cache_folder, fastest),
        plans(problem, 3),
        np.random.default_rng(2),
    )
    names, scale = ("path", "rate", "weights"), np.array([0.5, 2.0, -1.0])
    others = {name: values for name, values in given.items() if name not in names}

    def value(*variables: Any) -> Any:
        path, rate, weights = variables
        return (jax.numpy.asarray(scale) * plan_loss(loss, path, rate, weights=weights, **others)[0]).sum()

    with x64():
        variables = [given[name] for name in names]
        gradient = jax.grad(value, argnums=(0, 1, 2))
        found = (jax.jit(gradient) if jitted else gradient)(*map(jax.numpy.asarray, variables))
        for index in range(3):
            direction = 1e-6 * random.standard_normal(variables[index].shape)
            ends = [
                [*variables[:index], variables[index] + step, *variables[index + 1 :]]
                for step in (direction, -direction)
            ]
            difference = float(value(*ends[0])) - float(value(*ends[1]))
            assert np.sum(found[index] * direction) == pytest.approx(difference / 2, rel=1e-5)


def test_the_loss_is_that_of_numpy(problem: str, cache_folder: Path, fastest: Any) -> None:
    loss, given = make_loss(problem, "float32", cache_folder, fastest), plans(problem, 5)
    given = {name: values.astype(np.float32) for name, values in given.items()}
    total, terms = jax.jit(lambda given, shift: plan_loss(loss, **given, shift=shift))(given, 0.25)
    expected = loss(**given, shift=0.25)
    np.testing.assert_allclose(total, expected.total, rtol=1e-5)
    np.testing.assert_allclose(terms, expected.terms, rtol=1e-5)


def test_the_terms_have_no_gradient(cache_folder: Path, fastest: Any) -> None:
    loss, given = make_loss("airhockey", "float32", cache_folder, fastest), plans("airhockey", 2)
    found = jax.grad(lambda path: plan_loss(loss, **given | {"path": path})[1].sum())(
        jax.numpy.asarray(given["path"], np.float32)
    )
    assert not found.any()


def test_a_batch_of_a_trainer_s_size_does_not_hang(cache_folder: Path, fastest: Any) -> None:
    loss = make_loss("airhockey", "float32", cache_folder, fastest)
    given = {name: values.astype(np.float32) for name, values in plans("airhockey", 512).items()}
    step = jax.jit(jax.grad(lambda path, rest: plan_loss(loss, path, **rest)[0].mean()))
    path = jax.numpy.asarray(given.pop("path"))
    for _ in range(3):
        path = path - 1e-4 * step(path, given)
    assert np.isfinite(path).all()


def test_float64_is_refused_where_jax_would_shorten_it(cache_folder: Path, fastest: Any) -> None:
    loss, given = make_loss("airhockey", "float64", cache_folder, fastest), plans("airhockey", 2)
    with pytest.raises(UsageError, match="would shorten a loss in float64"):
        plan_loss(loss, **given)
