"""The boundary layer: boundary conditions, gradients, plans and errors."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cnpgen
from cnpgen.errors import UsageError
from cnpgen.loader.batch_options import BatchOptions
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.plans.format import BOUNDARY
from cnpgen.robots.plausible_values import UnitError
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import needs_compiled_code, some
from tests.examples.plans_of_networks import (
    at_ends,
    boundary,
    boundary_for_layer,
    outputs,
)
from tests.refusals import is_refused

PROBLEMS = ("airhockey", "heavy-object")
GIVEN = "airhockey, accelerations given"


@pytest.fixture(scope="module")
def layers(cache_folder: Path, fastest: Any) -> dict[str, BoundaryLayer]:
    backends = {
        "airhockey": fastest,
        "heavy-object": "numpy",
    }  # compiling the others takes longer than their tests do
    free = {
        name: BoundaryLayer(name, backend=backends[name], cache_folder=cache_folder)
        for name in PROBLEMS
    }
    given = BoundaryLayer(
        "airhockey",
        goal_acceleration="given",
        backend="numpy",
        cache_folder=cache_folder,
    )
    return free | {GIVEN: given}


@pytest.mark.parametrize("problem", [*some(PROBLEMS, 1, "slow"), GIVEN])
def test_boundary_conditions_hold_for_any_network_output(
    layers: dict[str, BoundaryLayer], problem: str
) -> None:
    layer = layers[problem]
    given = boundary_for_layer(layer, 4)
    points = layer(layer.tasks(given), *outputs(layer, 4))
    assert points.path.shape == (4, 15, len(layer.problem.robot.joints))
    assert points.rate.shape == (4, 20)
    for found, expected, exact in zip(
        at_ends(points.path, points.rate),
        given.conditions().values(),
        (1e-12, 1e-10, 1e-8) * 2,
        strict=False,
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=exact)


@pytest.mark.parametrize(
    ("problem", "projection"),
    [
        ("airhockey", 0),
        ("airhockey", 1),
        (GIVEN, 1),
        *some([("heavy-object", 0), ("heavy-object", 1)], 0, "slow"),
    ],
)
def test_gradients_of_outputs_are_those_of_central_differences(
    problem: str, projection: int, layers: Any
) -> None:
    layer = (
        layers[problem]
        if projection
        else BoundaryLayer(problem, line_projection_steps=0, projection_steps=0)
    )
    tasks, given, random = (
        layer.tasks(boundary_for_layer(layer, 3)),
        outputs(layer, 3),
        np.random.default_rng(2),
    )
    points = layer(tasks, *given)
    by_path, by_rate = (
        random.normal(size=points.path.shape),
        random.normal(size=points.rate.shape),
    )

    def scalar(phi: Any, log_rate: Any) -> Any:
        found = layer(tasks, phi, log_rate)
        return (found.path * by_path).sum((1, 2)) + (found.rate * by_rate).sum(1)

    gradients = layer.vjp(tasks, *given, path_gradient=by_path, rate_gradient=by_rate)
    for _ in range(3):
        steps = [1e-6 * random.normal(size=part.shape) for part in given]
        ends = [
            scalar(
                *(part + sign * step for part, step in zip(given, steps, strict=True))
            )
            for sign in (1, -1)
        ]
        found = sum(
            (gradient * step).sum(1)
            for gradient, step in zip(gradients, steps, strict=True)
        )
        np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2, rtol=1e-5, atol=1e-9)


@needs_compiled_code
@pytest.mark.extended
def test_compiled_and_interpreted_control_points_of_transports_agree(
    layers: dict[str, BoundaryLayer], cache_folder: Path
) -> None:
    interpreted, given = layers["heavy-object"], boundary("heavy-object", 3)
    compiled = BoundaryLayer(
        "heavy-object", backend="compiled", cache_folder=cache_folder
    )
    values, gradients = (
        outputs(compiled, 3),
        {"path_gradient": np.ones((3, 15, 7)), "rate_gradient": np.ones((3, 20))},
    )
    tasks = [of.tasks(given) for of in (compiled, interpreted)]
    np.testing.assert_allclose(
        compiled(tasks[0], *values).path,
        interpreted(tasks[1], *values).path,
        rtol=0,
        atol=1e-8,
    )
    found, expected = (
        compiled.vjp(tasks[0], *values, **gradients),
        interpreted.vjp(tasks[1], *values, **gradients),
    )
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(
            one, other, rtol=1e-6, atol=1e-7
        )  # rounding, after an inverse


@pytest.mark.parametrize(
    "backend",
    some([pytest.param("compiled", marks=needs_compiled_code), "numpy"], 1, "slow"),
)
def test_an_overflowing_row_does_not_affect_other_rows(
    backend: Any, cache_folder: Path
) -> None:
    layer = BoundaryLayer("airhockey", backend=backend, cache_folder=cache_folder)
    tasks, (phi, log_rate) = layer.tasks(boundary("airhockey", 4)), outputs(layer, 4)
    ones = {"path_gradient": np.ones((4, 15, 6)), "rate_gradient": np.ones((4, 20))}
    expected, points = (
        layer.vjp(tasks, phi, log_rate, **ones),
        layer(tasks, phi, log_rate),
    )
    for value in (1000.0, -1000.0, np.nan):
        log_rate[2, 0] = value
        np.testing.assert_array_equal(
            np.delete(layer(tasks, phi, log_rate).path - points.path, 2, 0), 0
        )
        found = layer.vjp(tasks, phi, log_rate, **ones)
        for each, other in zip(found, expected, strict=True):
            assert (each[2] == 0).all()
            np.testing.assert_array_equal(np.delete(each, 2, 0), np.delete(other, 2, 0))


def test_an_input_gradient_of_nan_gives_an_output_gradient_of_nan(
    layers: dict[str, BoundaryLayer],
) -> None:
    layer = layers["airhockey"]
    by_path = np.ones((2, 15, 6))
    by_path[1] = np.nan
    by_phi, _ = layer.vjp(
        layer.tasks(boundary("airhockey", 2)),
        *outputs(layer, 2),
        path_gradient=by_path,
        rate_gradient=np.ones((2, 20)),
    )
    assert np.isfinite(by_phi[0]).all()
    assert np.isnan(by_phi[1]).any()


@pytest.mark.parametrize("problem", [GIVEN, *some(PROBLEMS, 1, "slow")])
def test_no_tasks_give_empty_control_points_and_gradients(
    layers: dict[str, BoundaryLayer], problem: str
) -> None:
    layer = layers[problem]
    tasks, given = (
        layer.tasks(boundary_for_layer(layer, 1)[:0]),
        [values[:0] for values in outputs(layer, 1)],
    )
    points = layer(tasks, *given)
    found = layer.vjp(
        tasks, *given, path_gradient=points.path, rate_gradient=points.rate
    )
    assert [values.shape for values in found] == [values.shape for values in given]


def test_plans_contain_the_control_points_and_tasks(cache_folder: Path) -> None:
    layer = BoundaryLayer(
        "heavy-object",
        line_projection_steps=0,
        projection_steps=0,
        backend="numpy",
        cache_folder=cache_folder,
    )
    given = boundary("heavy-object", 3)
    tasks, values = layer.tasks(given), outputs(layer, 3)
    plans = layer.plans(tasks, *values)
    np.testing.assert_array_equal(plans.path_control_points, layer(tasks, *values).path)
    np.testing.assert_array_equal(plans.boundary.goal_dq, given.goal_dq)
    np.testing.assert_allclose(
        plans.columns["goal_xyz"], plans.problem.tip_positions(given.goal_q), atol=1e-9
    )
    assert tasks.scene.poses.shape == (3, 2)


def test_without_projection_steps_and_outputs_the_path_is_the_papers_line() -> None:
    layer = BoundaryLayer("airhockey", line_projection_steps=0, projection_steps=0)
    points = layer(
        layer.tasks(boundary("airhockey", 2)), np.zeros((2, 60)), np.zeros((2, 20))
    )
    np.testing.assert_allclose(np.diff(points.path[:, 3:13], 2, axis=1), 0, atol=1e-12)


def test_a_boundary_layer_can_be_pickled_after_use(
    layers: dict[str, BoundaryLayer],
) -> None:
    layer = layers["airhockey"]
    tasks, values = layer.tasks(boundary("airhockey", 2)), outputs(layer, 2)
    expected = layer(tasks, *values)
    again = pickle.loads(pickle.dumps(layer))
    np.testing.assert_array_equal(
        again(again.tasks(tasks.boundary), *values).path, expected.path
    )


def test_invalid_arguments_raise_errors(layers: dict[str, BoundaryLayer]) -> None:
    layer, given = layers["airhockey"], boundary("airhockey", 2)
    tasks, (phi, log_rate) = layer.tasks(given), outputs(layer, 2)
    with is_refused(UsageError, argument="phi"):
        layer(tasks, phi[:, 1:], log_rate)
    with is_refused(UsageError, argument="log_rate"):
        layer(tasks, phi, log_rate[1:])
    with is_refused(UsageError, argument="goal_q"):
        layer.tasks(replace(given, goal_q=np.zeros((2, 7))))
    with is_refused(UsageError, argument="boundary"):
        layer.tasks(replace(given, goal_ddq=np.zeros((2, 6))))
    with is_refused(UsageError, argument="boundary"):
        layers[GIVEN].tasks(given)
    with is_refused(UsageError, argument="goal_acceleration"):
        BoundaryLayer("airhockey", goal_acceleration="none")
    with is_refused(UsageError, argument="projection_steps"):
        BoundaryLayer("airhockey", projection_steps=1.5)  # type: ignore[arg-type]
    with is_refused(UsageError, argument="path_scale"):
        BoundaryLayer("airhockey", path_scale=None)  # type: ignore[arg-type]


def test_plans_of_a_shuffled_batch_have_boundary_conditions_and_ids_of_their_rows(
    tiny: Any, layers: Any
) -> None:
    dataset = cnpgen.load_dataset(tiny("airhockey-replan"))
    rows = dataset.arrays("train", fields=[*BOUNDARY, "sample_id"])
    layer = layers["airhockey"]
    batch = next(
        iter(
            dataset.batches(
                8, fields=[*BOUNDARY, "hit_speed", "sample_id"], dtype="float64"
            )
        )
    )
    boundary = Boundary.from_batch(batch)
    tasks = layer.tasks(boundary)
    phi, log_rate = np.zeros((8, layer.path_outputs)), np.zeros((8, layer.rate_outputs))
    plans = layer.plans(tasks, phi, log_rate, sample_id=batch["sample_id"])
    assert plans.sample_id.tolist() == batch["sample_id"].tolist() != list(range(8))
    for plan in plans:
        row = int(np.flatnonzero(rows["sample_id"] == plan.sample_id[0])[0])
        for name in BOUNDARY:
            np.testing.assert_allclose(
                getattr(plan.boundary, name)[0], rows[name][row], atol=1e-12
            )


def test_boundary_conditions_are_read_from_rows_in_their_units(tiny: Any) -> None:
    dataset = cnpgen.load_dataset(tiny("airhockey-replan"))
    rows = dataset.arrays("train")
    with is_refused(UsageError, argument="normalization"):
        Boundary.from_batch(rows)
    plain = next(
        iter(
            dataset.batches(
                8, normalize=False, dtype="float64", options=BatchOptions(shuffle=False)
            )
        )
    )
    np.testing.assert_array_equal(
        Boundary.from_batch(plain).start_q, rows["start_q"][:8]
    )
    boundary = Boundary.from_batch(rows, None)
    assert boundary.goal_ddq is None
    np.testing.assert_array_equal(boundary.start_ddq, rows["start_ddq"])
    assert (
        Boundary.from_batch({**rows, "goal_ddq": rows["start_ddq"]}, None).fixed_at_goal
        == 3
    )
    with is_refused(UsageError, argument="batch"):
        Boundary.from_batch(
            {name: rows[name] for name in ("start_q", "start_dq", "goal_q")}, None
        )


def test_joint_positions_in_degrees_are_refused(layers: Any) -> None:
    given = boundary("airhockey", 4)
    degrees = replace(given, goal_q=np.degrees(given.goal_q))
    with is_refused(UnitError, argument="boundary"):
        layers["airhockey"].tasks(degrees)
    with pytest.warns(UserWarning, match="goal_q must be from"):
        layers["airhockey"].tasks(degrees, allow_large_angles=True)
