"""Parts of a training run: learning rate, order of rows, clipping, settings."""

import math
from types import SimpleNamespace
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.losses.margins import suggested_margins
from cnpgen.losses.metric import Metric, MetricSettings
from cnpgen.planner.network.architecture import Architecture
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.training.adam import Clipping, learning_rate
from cnpgen.training.prepare import begin_run
from cnpgen.training.settings import METRICS, Length, TrainingSettings
from cnpgen.training.training_rows import StepRows
from tests.examples.constraints import TipSpeed
from tests.refusals import is_refused


def rate(step: int) -> float:
    return learning_rate(step, 1000, peak=2e-3, final=0.01, warm_up=100)


def test_the_learning_rate_rises_to_its_peak_and_falls_as_a_cosine():
    assert rate(0) == pytest.approx(2e-5, rel=1e-3)
    assert rate(500) == pytest.approx(2e-3 * (0.01 + 0.99 * 0.5))
    assert rate(1000) == pytest.approx(2e-5)
    rates = [rate(step) for step in range(100, 1001)]
    assert max(rates) < 2e-3
    assert (np.diff(rates) < 0).all()


def test_an_epoch_contains_every_row_once_except_for_an_incomplete_batch():
    order = StepRows(103, 10, seed=5)
    epoch = np.concatenate([order.batch(step) for step in range(10)])
    assert len(np.unique(epoch)) == 100
    other = np.concatenate([order.batch(step) for step in range(10, 20)])
    assert len(np.unique(other)) == 100
    assert (epoch != other).any()


def test_the_order_of_rows_is_a_function_of_seed_and_step():
    order, again = StepRows(64, 8, seed=1), StepRows(64, 8, seed=1)
    steps = [0, 31, 7, 8, 100, 0]  # in any sequence
    for step in steps:
        np.testing.assert_array_equal(
            order.batch(step), StepRows(64, 8, seed=1).batch(step)
        )
        np.testing.assert_array_equal(order.batch(step), again.batch(step))
    assert (StepRows(64, 8, seed=2).batch(0) != order.batch(0)).any()


def test_fewer_rows_than_a_batch_are_one_batch():
    assert sorted(StepRows(5, 64, seed=0).batch(3)) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("limit", [30.0, np.inf])
def test_nothing_is_clipped_while_most_gradients_are_zero(limit):
    clipping, norms = Clipping(), np.array([0.0, 0.0, 0.0, 2.0, 5.0])
    np.testing.assert_array_equal(clipping.sample_factors(norms, limit=limit), 1.0)
    assert clipping.batch_factor(0.0, limit=limit) == 1.0
    np.testing.assert_array_equal(clipping.sample_factors(norms + 1, limit=limit), 1.0)
    assert clipping.sample == 1.0


def test_samples_are_clipped_relative_to_the_running_median():
    clipping = Clipping()
    norms = np.array([1.0, 2.0, 3.0, 4.0, 1000.0])
    np.testing.assert_allclose(
        clipping.sample_factors(norms, limit=10.0) * norms, [1, 2, 3, 4, 30]
    )
    clipping.sample_factors(norms * 10, limit=10.0)
    assert clipping.sample == pytest.approx(0.98 * 3 + 0.02 * 30)


def test_a_batch_is_clipped_relative_to_the_running_norm_which_limits_outliers():
    clipping = Clipping()
    assert clipping.batch_factor(5.0, limit=2.0) == 1.0
    assert clipping.batch == 5.0
    factor = clipping.batch_factor(5e6, limit=2.0)
    assert clipping.batch == pytest.approx(0.99 * 5 + 0.01 * 15)
    assert factor * 5e6 == pytest.approx(2 * clipping.batch)


def test_without_a_limit_nothing_is_clipped():
    clipping = Clipping()
    np.testing.assert_array_equal(
        clipping.sample_factors(np.array([1.0, 1e30]), limit=math.inf), 1.0
    )
    assert (
        clipping.batch_factor(1.0, limit=math.inf)
        == clipping.batch_factor(1e30, limit=math.inf)
        == 1.0
    )


SIZES = ("inputs", "hidden", "layers", "path_outputs", "rate_outputs")
WRONG: list[tuple[str, Any]] = [
    ("hidden", 0), ("hidden", 2.5), ("batch_size", -1), ("seed", -1), ("line_projection_steps", -1), ("nodes", "32"),
    ("learning_rate", 0.0), ("learning_rate", math.inf), ("learning_rate", "1e-3"), ("final_rate", -5),
    ("memory", 2), ("memory", 1.0), ("imitation", 1.0), ("sample_clip", math.nan), ("head_scale", -0.1),
    ("rate_bias", math.inf), ("warm_up", 1.5), ("iterations", 0), ("iterations", 21),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_invalid_settings_raise_errors_with_their_name(name, value):
    with is_refused(UsageError, argument=ANY):
        TrainingSettings(**{name: value})


def test_infinite_growth_of_weights_raises_an_error():
    with is_refused(UsageError, argument="growth"):
        TrainingSettings(metric=MetricSettings(growth=math.inf))


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"steps": 5, "epochs": 2},
        {"cpu_seconds": 0.0},
        {"cpu_seconds": math.inf},
        {"steps": 2.5},
        {"epochs": "3"},
    ],
)
def test_a_run_has_exactly_one_length(wrong):
    with is_refused(UsageError, argument=ANY):
        Length(**wrong)


def test_a_temporary_load_does_not_shorten_a_run(monkeypatch):
    """The number of steps follows from the median time of a step, so that other jobs hardly change it."""
    now, taken = [0.0], []

    def step(_state: Any, _gradient: Any) -> None:
        taken.append(len(taken))
        now[0] += 0.5 if 12 <= len(taken) < 30 else 0.001

    run = SimpleNamespace(
        learner=SimpleNamespace(
            settings=TrainingSettings(),
            architecture=Architecture(**dict.fromkeys(SIZES, 2)),
        ),
        loss=SimpleNamespace(terms=("time", "table")),
        metric=Metric([1.0], [0.0]),
        initial_parameters=None,
        step=step,
    )
    monkeypatch.setattr("cnpgen.training.prepare.time.process_time", lambda: now[0])
    assert begin_run(run, Length(cpu_seconds=10.0)).steps == pytest.approx(
        10_000, abs=1
    )  # type: ignore[arg-type]


def test_the_papers_metric_uses_the_papers_form_of_the_loss():
    forms = {
        name: TrainingSettings(metric=metric).form for name, metric in METRICS.items()
    }
    assert forms == {
        "fixed": "signed",
        "ramped": "signed",
        "learned": "paper",
        "bounded": "signed",
    }


def test_every_constraint_of_a_kind_has_the_margin_of_its_kind():
    table, torque = (object.__new__(kind) for kind in (Table, JointTorque))
    problem = object.__new__(Problem)
    constraints = (table, table, torque, torque, torque, object.__new__(TipSpeed))
    object.__setattr__(problem, "constraint", constraints)
    margins = suggested_margins(problem)
    assert margins.insets == {"table": 1e-3, "table-2": 1e-3}
    assert margins.factors == {
        "joint-torque": 0.97,
        "joint-torque-2": 0.97,
        "joint-torque-3": 0.97,
    }


def test_margins_are_those_of_the_problem_of_a_dataset():
    problem = load_problem("airhockey")
    record = record_problem(problem)
    stored = StoredProblem(record.recipe, record.urdf)  # as of dataset.problem
    assert suggested_margins(stored) == suggested_margins(problem)
    assert suggested_margins("airhockey") == suggested_margins(problem)
    assert suggested_margins(stored).factors


def test_margins_tighten_the_limits_that_they_name_and_no_others(
    monkeypatch: pytest.MonkeyPatch,
):
    from cnpgen.training import prepare
    from tests.examples.models import interpreted, loaded_problem_of

    made: list[dict[str, Any]] = []

    class Watched(prepare.PlanLoss):
        def __init__(self, *positional: Any, **named: Any) -> None:
            made.append(named)
            super().__init__(*positional, **named)

        def load_kernels(self) -> None:
            """Load nothing."""

    monkeypatch.setattr(prepare, "PlanLoss", Watched)
    given = interpreted(loaded_problem_of("airhockey"))
    prepare._loss(given, TrainingSettings(margins={"joint-acceleration": 0.9}))
    usual = suggested_margins(given.problem)
    factors = made[0]["margins"].factors
    assert factors == {**usual.factors, "joint-acceleration": 0.9}
    assert made[0]["margins"].insets == usual.insets
    with is_refused(UsageError, argument="terms"):
        prepare._loss(given, TrainingSettings(margins={"joint-speed": 0.9}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"margins": {"joint-velocity": 1.5}},
            r"margins must be in \(0, 1\] for 'joint-velocity', got 1.5",
        ),
        (
            {"expected_time": "soon"},
            "expected_time must be one of distance, reach, travel, got 'soon'",
        ),
        (
            {"iterations": 2, "features": "paper"},
            "expected features 'full' or 'no-scene', got 'paper'",
        ),
    ],
)
def test_invalid_margins_and_expected_times_raise_errors(
    changes: dict[str, Any], message: str
):
    with pytest.raises(UsageError, match=message):
        TrainingSettings(**changes)
