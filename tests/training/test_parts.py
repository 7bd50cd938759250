"""Schedule, order of rows, clipping and settings: each follows from little, and says what it refuses."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.losses.margins import suggested_margins
from cnpgen.losses.metric import Metric
from cnpgen.losses.metric_settings import MetricSettings
from cnpgen.planner.network.architecture import Architecture
from cnpgen.training.adam import learning_rate
from cnpgen.training.clipping import Clipping
from cnpgen.training.prepare import begin_run
from cnpgen.training.rows import StepRows
from cnpgen.training.settings import METRICS, Length, TrainingSettings


def rate(step: int) -> float:
    return learning_rate(step, 1000, peak=2e-3, final=0.01, warm_up=100)


def test_the_learning_rate_rises_to_its_peak_and_falls_as_a_cosine():
    assert rate(0) == pytest.approx(2e-5, rel=1e-3)
    assert rate(500) == pytest.approx(2e-3 * (0.01 + 0.99 * 0.5))
    assert rate(1000) == pytest.approx(2e-5)
    rates = [rate(step) for step in range(100, 1001)]
    assert max(rates) < 2e-3
    assert (np.diff(rates) < 0).all()


def test_an_epoch_sees_every_row_once_but_for_those_that_fill_no_batch():
    order = StepRows(103, 10, seed=5)
    epoch = np.concatenate([order.batch(step) for step in range(10)])
    assert len(np.unique(epoch)) == 100
    other = np.concatenate([order.batch(step) for step in range(10, 20)])
    assert len(np.unique(other)) == 100
    assert (epoch != other).any()


def test_the_order_is_arithmetic_in_seed_and_step():
    order, again = StepRows(64, 8, seed=1), StepRows(64, 8, seed=1)
    steps = [0, 31, 7, 8, 100, 0]  # in any sequence
    for step in steps:
        np.testing.assert_array_equal(order.batch(step), StepRows(64, 8, seed=1).batch(step))
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


def test_samples_are_clipped_to_so_many_running_medians():
    clipping = Clipping()
    norms = np.array([1.0, 2.0, 3.0, 4.0, 1000.0])
    np.testing.assert_allclose(clipping.sample_factors(norms, limit=10.0) * norms, [1, 2, 3, 4, 30])
    clipping.sample_factors(norms * 10, limit=10.0)
    assert clipping.sample == pytest.approx(0.98 * 3 + 0.02 * 30)


def test_a_batch_is_clipped_to_so_many_running_norms_and_one_jump_does_not_move_the_norm_far():
    clipping = Clipping()
    assert clipping.batch_factor(5.0, limit=2.0) == 1.0
    assert clipping.batch == 5.0
    factor = clipping.batch_factor(5e6, limit=2.0)
    assert clipping.batch == pytest.approx(0.99 * 5 + 0.01 * 15)
    assert factor * 5e6 == pytest.approx(2 * clipping.batch)


def test_without_a_limit_nothing_is_clipped():
    clipping = Clipping()
    np.testing.assert_array_equal(clipping.sample_factors(np.array([1.0, 1e30]), limit=math.inf), 1.0)
    assert clipping.batch_factor(1.0, limit=math.inf) == clipping.batch_factor(1e30, limit=math.inf) == 1.0


SIZES = ("inputs", "hidden", "layers", "path_outputs", "rate_outputs")
WRONG: list[tuple[str, Any]] = [
    ("hidden", 0), ("hidden", 2.5), ("batch_size", -1), ("seed", -1), ("bending_steps", -1), ("nodes", "32"),
    ("learning_rate", 0.0), ("learning_rate", math.inf), ("learning_rate", "1e-3"), ("final_rate", -5),
    ("memory", 2), ("memory", 1.0), ("imitation", 1.0), ("sample_clip", math.nan), ("head_scale", -0.1),
    ("rate_bias", math.inf), ("warm_up", 1.5),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_settings_that_cannot_be_meant_are_refused_by_name(name, value):
    with pytest.raises(UsageError, match=f"^{name} must be .*, got {value!r}"):
        TrainingSettings(**{name: value})


def test_weights_that_grow_without_end_are_refused_by_what_was_said():
    with pytest.raises(UsageError, match=r"growth must be .*, got inf"):
        TrainingSettings(metric=MetricSettings(growth=math.inf))


@pytest.mark.parametrize(
    "wrong",
    [{}, {"steps": 5, "epochs": 2}, {"cpu_seconds": 0.0}, {"cpu_seconds": math.inf}, {"steps": 2.5}, {"epochs": "3"}],
)
def test_a_run_has_one_length(wrong):
    with pytest.raises(UsageError, match=r"how long|(steps|epochs|cpu_seconds) must be .*, got "):
        Length(**wrong)


def test_a_busy_moment_does_not_make_a_run_short(monkeypatch):
    """Steps are counted out by how long they usually take, not by what other jobs do to some of the measured ones."""
    now, taken = [0.0], []

    def step(_state: Any, _gradient: Any) -> None:
        taken.append(len(taken))
        now[0] += 0.5 if 12 <= len(taken) < 30 else 0.001

    run = SimpleNamespace(
        learner=SimpleNamespace(settings=TrainingSettings(), architecture=Architecture(**dict.fromkeys(SIZES, 2))),
        names=("time", "table"),
        metric=Metric([1.0], [0.0]),
        first=None,
        step=step,
    )
    monkeypatch.setattr("cnpgen.training.prepare.time.process_time", lambda: now[0])
    assert begin_run(run, Length(cpu_seconds=10.0)).steps == pytest.approx(10_000, abs=1)  # type: ignore[arg-type]


def test_the_paper_s_form_of_the_loss_goes_with_the_paper_s_metric():
    forms = {name: TrainingSettings(metric=metric).form for name, metric in METRICS.items()}
    assert forms == {"fixed": "signed", "ramped": "signed", "learned": "paper", "bounded": "signed"}


def test_every_constraint_of_a_kind_has_the_margin_of_its_kind():
    margins = suggested_margins(("time", "table", "table-2", "joint-torque-3", "keep-out-2"))
    assert margins.insets == {"table": 1e-3, "table-2": 1e-3}
    assert margins.factors == {"joint-torque-3": 0.97}


def test_margins_tighten_the_limits_that_they_name_and_no_others(monkeypatch: pytest.MonkeyPatch):
    from cnpgen.training import prepare
    from tests.examples.models import interpreted, surroundings_of

    made: list[dict[str, Any]] = []

    class Watched(prepare.PlanLoss):
        def __init__(self, *positional: Any, **named: Any) -> None:
            made.append(named)
            super().__init__(*positional, **named)

        def load_kernels(self) -> None:
            """Not now."""

    monkeypatch.setattr(prepare, "PlanLoss", Watched)
    given = interpreted(surroundings_of("airhockey"))
    prepare._loss(given, TrainingSettings(margins={"joint-acceleration": 0.9}))
    usual = suggested_margins(Watched(given.problem, backend="numpy").terms)
    factors = made[1]["margins"].factors
    assert factors == {**usual.factors, "joint-acceleration": 0.9}
    assert made[1]["margins"].insets == usual.insets
    with pytest.raises(UsageError, match="no such term"):
        prepare._loss(given, TrainingSettings(margins={"joint-speed": 0.9}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"margins": {"joint-velocity": 1.5}}, r"margin of 'joint-velocity' must be in \(0, 1\], got 1.5"),
        ({"expected_time": "soon"}, "expected_time must be one of distance, reach, got 'soon'"),
    ],
)
def test_margins_and_expected_times_that_cannot_be_meant_are_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UsageError, match=message):
        TrainingSettings(**changes)
