"""The bridge to JAX, against JAX itself."""

# ruff: noqa: E402 - without the framework nothing else is imported
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.examples.loader import ALL, make
from tests.examples.plans_of_networks import (
    at_ends,
    boundary,
    boundary_for_layer,
    outputs,
)

jax = pytest.importorskip("jax")

from cnpgen.errors import UsageError
from cnpgen.interop.jax import control_points, plan_loss, to_jax
from cnpgen.loader.batch import Batch
from cnpgen.loader.dataset import Dataset
from cnpgen.loader.load import load_dataset
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.problems.problem_file import load_problem

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return load_dataset(make(tmp_path_factory.mktemp("loader") / "set", shard_size=8))


def x64() -> Any:
    return (
        jax.enable_x64(True)
        if hasattr(jax, "enable_x64")
        else jax.experimental.enable_x64()
    )


def test_arrays_have_the_values_of_the_batch(dataset: Dataset) -> None:
    for batch in dataset.batches(8, fields=ALL):
        arrays = to_jax(batch)
        assert list(arrays) == list(ALL)
        for name, values in batch.items():
            assert isinstance(arrays[name], jax.Array)
            assert np.array_equal(arrays[name], values)
        assert arrays["start_q"].dtype == np.float32


def test_truncation_is_refused(dataset: Dataset) -> None:
    batch = next(iter(dataset.batches(8, fields=ALL, dtype="float64")))
    with pytest.raises(UsageError, match="would truncate float64"):
        to_jax(batch)
    large = Batch(
        batch.table.astype(np.float32),
        batch.layout,
        {"sample_id": batch["sample_id"] + 2**31},
    )
    with pytest.raises(UsageError, match="would truncate the integers of sample_id"):
        to_jax(large)
    with x64():
        for given in (batch, large):
            assert all(
                np.array_equal(values, given[name])
                for name, values in to_jax(given).items()
            )
            assert to_jax(given)["sample_id"].dtype == np.int64


def test_a_jitted_step_takes_the_batches_of_several_epochs(dataset: Dataset) -> None:
    step = jax.jit(
        lambda total, batch: total + batch["start_q"].sum() + batch["goal_p"].sum()
    )
    total, batches = 0.0, dataset.batches(10)
    for _ in range(2):
        for batch in batches:
            total = step(total, to_jax(batch))
    assert abs(total) < 1e-3  # an epoch has all rows, and their normalized mean is 0


# The loss.


@pytest.fixture(scope="module", params=["airhockey", "heavy-object"])
def problem(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def make_loss(problem: str, dtype: Any, cache_folder: Path, backend: Any) -> PlanLoss:
    return PlanLoss(
        load_problem(problem),
        dtype=dtype,
        nodes=12,
        backend=backend,
        cache_folder=cache_folder,
    )


def plans(problem: str, count: int) -> dict[str, np.ndarray]:
    """Draw plans, weights and obstacle poses."""
    found, random = load_problem(problem), np.random.default_rng(1)
    base, spec = np.array(found.robot.base), found.trajectory
    arrays = {
        "path": base
        + 0.3 * random.standard_normal((count, spec.path_control_points, len(base))),
        "rate": random.uniform(1.0, 2.0, (count, spec.rate_control_points)),
        "weights": random.uniform(0.5, 2.0, len(found.constraint)),
    }
    heights, puck = (
        random.uniform(0.2, 0.4, (count, 2)),
        np.tile([1.0, 0.0, 1.07, 0.0], (count, 1)),
    )
    return arrays | {"obstacle_poses": heights if problem == "heavy-object" else puck}


@pytest.mark.parametrize("jitted", [True, False])
def test_the_gradients_of_the_loss_agree_with_differences(
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
        return (
            jax.numpy.asarray(scale)
            * plan_loss(loss, path, rate, weights=weights, **others)[0]
        ).sum()

    with x64():
        variables = [given[name] for name in names]
        gradient = jax.grad(value, argnums=(0, 1, 2))
        found = (jax.jit(gradient) if jitted else gradient)(
            *map(jax.numpy.asarray, variables)
        )
        for index in range(3):
            direction = 1e-6 * random.standard_normal(variables[index].shape)
            ends = [
                [*variables[:index], variables[index] + step, *variables[index + 1 :]]
                for step in (direction, -direction)
            ]
            difference = float(value(*ends[0])) - float(value(*ends[1]))
            assert np.sum(found[index] * direction) == pytest.approx(
                difference / 2, rel=1e-5
            )


def test_the_loss_agrees_with_numpy(
    problem: str, cache_folder: Path, fastest: Any
) -> None:
    loss, given = (
        make_loss(problem, "float32", cache_folder, fastest),
        plans(problem, 5),
    )
    given = {name: values.astype(np.float32) for name, values in given.items()}
    total, terms = jax.jit(lambda given, shift: plan_loss(loss, **given, shift=shift))(
        given, 0.25
    )
    expected = loss(**given, shift=0.25)
    np.testing.assert_allclose(total, expected.total, rtol=1e-5)
    np.testing.assert_allclose(terms, expected.terms, rtol=1e-5)


def test_the_terms_have_no_gradient(cache_folder: Path, fastest: Any) -> None:
    loss, given = (
        make_loss("airhockey", "float32", cache_folder, fastest),
        plans("airhockey", 2),
    )
    found = jax.grad(lambda path: plan_loss(loss, **given | {"path": path})[1].sum())(
        jax.numpy.asarray(given["path"], np.float32)
    )
    assert not found.any()


def test_a_batch_of_a_trainer_s_size_does_not_hang(
    cache_folder: Path, fastest: Any
) -> None:
    loss = make_loss("airhockey", "float32", cache_folder, fastest)
    given = {
        name: values.astype(np.float32)
        for name, values in plans("airhockey", 512).items()
    }
    step = jax.jit(jax.grad(lambda path, rest: plan_loss(loss, path, **rest)[0].mean()))
    path = jax.numpy.asarray(given.pop("path"))
    for _ in range(3):
        path = path - 1e-4 * step(path, given)
    assert np.isfinite(path).all()


def test_float64_is_refused_if_jax_would_truncate_it(
    cache_folder: Path, fastest: Any
) -> None:
    loss, given = (
        make_loss("airhockey", "float64", cache_folder, fastest),
        plans("airhockey", 2),
    )
    with pytest.raises(UsageError, match="would truncate a loss in float64"):
        plan_loss(loss, **given)


def test_arrays_are_denormalized_like_numpy_arrays_also_under_jit(
    dataset: Dataset,
) -> None:
    batch, normalization = (
        next(iter(dataset.batches(8, fields=ALL))),
        dataset.normalization,
    )
    assert normalization is not None
    expected = normalization.denormalize(batch)
    for function in (normalization.denormalize, jax.jit(normalization.denormalize)):
        for name, values in function(to_jax(batch)).items():
            assert isinstance(values, jax.Array)
            assert values.dtype == (np.float32 if name != "sample_id" else np.int32)
            np.testing.assert_allclose(values, expected[name], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("jitted", [True, False])
def test_an_invalid_plan_does_not_affect_others_through_grad(
    jitted: bool, cache_folder: Path, fastest: Any
) -> None:
    """Check a linear layer with four plans, one with a negative rate: it gets the gradient of the other three."""
    jnp = jax.numpy
    loss, given = (
        make_loss("airhockey", "float32", cache_folder, fastest),
        plans("airhockey", 4),
    )
    layer = 0.01 * np.random.default_rng(3).standard_normal((4, 90)).astype(np.float32)
    reductions = (
        lambda total: total.mean(),
        lambda total: jnp.nan_to_num(total).mean(),
        lambda total: jnp.where(jnp.isfinite(total), total, 0).mean(),
    )

    def mean(reduction: Any, variables: Any, rate: Any) -> Any:
        layer, weights = variables
        path = (given["path"] + (jnp.eye(4) @ layer).reshape(4, 15, 6))[: len(rate)]
        poses = given["obstacle_poses"][: len(rate)]
        return (
            reduction(
                plan_loss(loss, path, rate, weights=weights, obstacle_poses=poses)[0]
            )
            * len(rate)
            / 4
        )

    gradient = jax.grad(mean, argnums=1)
    gradient = jax.jit(gradient, static_argnums=0) if jitted else gradient
    variables = (jnp.asarray(layer), jnp.asarray(given["weights"]))
    expected = gradient(reductions[0], variables, jnp.asarray(given["rate"][:3]))
    for garbage in (-1.0, np.nan):
        rate = given["rate"].copy()
        rate[3, 4] = garbage
        for reduction in reductions:
            for found, want in zip(
                gradient(reduction, variables, jnp.asarray(rate)), expected, strict=True
            ):
                np.testing.assert_allclose(found, want, rtol=1e-4, atol=1e-6)


MISTAKES = {
    "rate must have shape (2, 20), got (1, 20)": {"rate": np.ones((1, 20))},
    "weights must have shape (6,) for joint-position": {"weights": np.ones(3)},
    "weights must be an array of numbers, got str": {"weights": "abc"},
    "there is no constraint 'tabel' (did you mean 'table'?)": {
        "weights": {"tabel": 1.0}
    },
    "start_tip must have shape (2, 3), got (3,)": {"start_tip": np.zeros(3)},
    "the shift of the quadrature nodes must be in [0, 1), got 1.5": {"shift": 1.5},
    "shift must be a finite number, got None": {"shift": None},
    "the weight of 'joint-torque' must be a number that is not negative": {
        "weights": [1, 1, 1, -1, 1, 1]
    },
}


@pytest.mark.parametrize("message", MISTAKES)
@pytest.mark.parametrize("jitted", [True, False])
def test_invalid_arguments_are_refused_when_the_function_is_traced(
    message: str, jitted: bool, cache_folder: Path, fastest: Any
) -> None:
    loss = make_loss("airhockey", "float32", cache_folder, fastest)
    given = plans("airhockey", 2) | MISTAKES[message]
    path = given.pop("path")

    def total(path: Any) -> Any:
        return plan_loss(loss, path, **given)[0]

    with pytest.raises(UsageError) as error:
        (jax.jit(total) if jitted else total)(path)
    assert str(error.value).startswith(message)


def test_missing_obstacle_poses_are_refused_when_the_function_is_traced(
    cache_folder: Path, fastest: Any
) -> None:
    loss, given = (
        make_loss("heavy-object", "float32", cache_folder, fastest),
        plans("heavy-object", 2),
    )
    del given["obstacle_poses"]
    with pytest.raises(UsageError, match="obstacle_poses is missing"):
        jax.eval_shape(lambda given: plan_loss(loss, **given)[0], given)


def test_a_shift_just_below_one_is_equivalent_to_zero(
    cache_folder: Path, fastest: Any
) -> None:
    loss, given = (
        make_loss("airhockey", "float32", cache_folder, fastest),
        plans("airhockey", 2),
    )
    step = jax.jit(lambda shift: plan_loss(loss, **given, shift=shift)[0])
    expected = plan_loss(loss, **given)[0]
    for found in (
        plan_loss(loss, **given, shift=0.99999999999)[0],
        step(0.99999999999),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_half_precision_is_accepted(cache_folder: Path, fastest: Any) -> None:
    loss, given = (
        make_loss("airhockey", "float32", cache_folder, fastest),
        plans("airhockey", 2),
    )
    path = jax.numpy.asarray(given.pop("path"), jax.numpy.bfloat16)
    total, gradient = jax.value_and_grad(
        lambda path: plan_loss(loss, path, **given)[0].sum()
    )(path)
    assert total.dtype == np.float32
    assert gradient.dtype == path.dtype
    assert np.isfinite(np.asarray(gradient, np.float32)).all()


# Control points.


@pytest.fixture(scope="module")
def layer(problem: str, cache_folder: Path, fastest: Any) -> BoundaryLayer:
    return BoundaryLayer(problem, backend=fastest, cache_folder=cache_folder)


@pytest.fixture(scope="module")
def arriving(cache_folder: Path, fastest: Any) -> BoundaryLayer:
    """Return a layer with the acceleration at the goal."""
    return BoundaryLayer(
        "airhockey",
        goal_acceleration="given",
        backend=fastest,
        cache_folder=cache_folder,
    )


def test_jitted_functions_accept_tasks_with_an_acceleration_at_the_goal(
    arriving: BoundaryLayer,
) -> None:
    given = boundary_for_layer(arriving, 2)
    with x64():
        values = map(jax.numpy.asarray, outputs(arriving, 2))
        path, rate = jax.jit(
            lambda tasks, *values: control_points(arriving, tasks, *values)
        )(arriving.tasks(given), *values)
        np.testing.assert_allclose(
            at_ends(path, rate)[5], given.goal_ddq, rtol=0, atol=1e-8
        )


def test_control_points_meet_the_boundary_conditions(layer: BoundaryLayer) -> None:
    given = boundary_for_layer(layer, 2)
    wanted = (
        given.start_q,
        given.start_dq,
        given.start_ddq,
        given.goal_q,
        given.goal_dq,
    )
    with x64():
        path, rate = control_points(
            layer, layer.tasks(given), *map(jax.numpy.asarray, outputs(layer, 2))
        )
        for found, expected, exact in zip(
            at_ends(path, rate), wanted, (1e-12, 1e-10, 1e-8) * 2, strict=False
        ):
            np.testing.assert_allclose(found, expected, rtol=0, atol=exact)
    path, rate = control_points(
        layer, layer.tasks(given), *map(jax.numpy.asarray, outputs(layer, 2))
    )
    assert path.dtype == rate.dtype == np.float32
    for found, expected, exact in zip(
        at_ends(path, rate), wanted, (1e-6, 1e-4, 1e-2) * 2, strict=False
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=exact)


@pytest.mark.parametrize("jitted", [True, False])
def test_the_gradients_of_control_points_agree_with_differences(
    layer: BoundaryLayer, jitted: bool
) -> None:
    tasks, values, random = (
        layer.tasks(boundary_for_layer(layer, 3)),
        outputs(layer, 3),
        np.random.default_rng(2),
    )

    def value(tasks: Any, *values: Any) -> Any:
        path, rate = control_points(layer, tasks, *values)
        return (path**2).sum() + (rate**3).sum()

    with x64():
        gradient = jax.grad(value, argnums=(1, 2))
        found = (jax.jit(gradient) if jitted else gradient)(
            tasks, *map(jax.numpy.asarray, values)
        )
        for index in range(2):
            direction = 1e-6 * random.standard_normal(values[index].shape)
            ends = [
                value(
                    tasks, *values[:index], values[index] + step, *values[index + 1 :]
                )
                for step in (direction, -direction)
            ]
            difference = float(ends[0]) - float(ends[1])
            assert np.sum(found[index] * direction) == pytest.approx(
                difference / 2, rel=1e-5
            )


def test_a_layer_learns_through_control_points_and_loss_despite_an_overflow(
    layer: BoundaryLayer, problem: str, cache_folder: Path, fastest: Any
) -> None:
    jnp, loss = jax.numpy, make_loss(problem, "float32", cache_folder, fastest)
    tasks, overflow = (
        layer.tasks(boundary(problem, 4)),
        np.zeros((4, layer.rate_outputs)),
    )
    overflow[3] = 1000.0
    obstacle_poses = tasks.scene.poses

    @jax.jit
    def step(network: Any, tasks: Any) -> Any:
        def mean(network: Any) -> Any:
            phi, log_rate = jnp.split(network, [layer.path_outputs], axis=1)
            path, rate = control_points(
                layer, tasks, jnp.tanh(phi), log_rate + overflow
            )
            total, _ = plan_loss(
                loss,
                path,
                rate,
                weights=loss.weights0,
                obstacle_poses=obstacle_poses,
                start_tip=tasks.start_xyz,
            )
            return total.mean(), total

        (_, total), gradient = jax.value_and_grad(mean, has_aux=True)(network)
        return network - 1e-2 * gradient / jnp.linalg.norm(gradient), total

    network, totals = jnp.zeros((4, layer.path_outputs + layer.rate_outputs)), []
    for _ in range(4):
        network, total = step(network, tasks)
        assert np.isfinite(total).tolist() == [True, True, True, False]
        totals.append(float(total[:3].sum()))
    assert np.isfinite(network).all()
    assert totals[-1] < totals[0]


def test_outputs_of_another_width_are_refused_when_the_function_is_traced(
    layer: BoundaryLayer,
) -> None:
    tasks, (phi, log_rate) = (
        layer.tasks(boundary_for_layer(layer, 2)),
        outputs(layer, 2),
    )
    with pytest.raises(
        UsageError, match=r"log_rate must have shape \(2, 20\), got \(2, 19\)"
    ):
        jax.eval_shape(
            lambda phi, log_rate: control_points(layer, tasks, phi, log_rate),
            phi,
            log_rate[:, 1:],
        )
