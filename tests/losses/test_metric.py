"""The metric: the published update by hand, schedules, bounds, and exact restoration of states."""

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.losses.metric import (
    BOUNDED,
    PUBLISHED,
    Metric,
    MetricSettings,
    alpha_step,
    average_loss,
    suggested_weights,
)
from cnpgen.problems.constraints.axis import Axis, Vertical
from cnpgen.problems.constraints.plane import Line, Plane
from cnpgen.problems.constraints.pose import Pose
from cnpgen.problems.constraints.table import Table
from tests.examples.constraints import TipSpeed
from tests.examples.losses import loss
from tests.refusals import is_refused

E = math.e


def problem_with(*kinds: type) -> Any:
    """Return a stand-in of a problem with constraints of these classes, which have no values."""
    return SimpleNamespace(constraint=tuple(object.__new__(kind) for kind in kinds))


def test_the_published_update_of_three_terms_by_hand():
    """Check alpha_i += gamma log(mean L_i / C_i) for ratios of 10, 1 and 1/100."""
    alpha = alpha_step(
        [0.0, 1.0, -2.0], [6e-2, 5e-4, 1e-8], [6e-3, 5e-4, 1e-6], gamma=0.01
    )
    np.testing.assert_allclose(
        alpha, [0.01 * math.log(10), 1.0, -2.0 - 0.01 * math.log(100)], rtol=1e-14
    )


def test_a_metric_learns_after_epochs_as_published():
    """Check two batches of two plans per epoch: means 2 and 4, then 1 and 1; the budget is 1/e and gamma 1/2."""
    metric = Metric(
        [1.0], [1 / E], MetricSettings(kind="learned", gamma=0.5, growth=1.0)
    )
    metric.observe([[9.0, 1.0], [9.0, 3.0]], 0.0)
    metric.observe([[9.0, 4.0], [9.0, 4.0]], 0.1)
    assert metric.weights(0.1).tolist() == [1.0]
    metric.end_epoch(0.2)
    first = 0.5 * (math.log(3.0) + 1)
    assert metric.alpha == pytest.approx([first], rel=1e-14)
    metric.observe([[9.0, 1.0]], 0.3)
    metric.end_epoch(0.4)
    assert metric.weights(0.4) == pytest.approx([math.exp(first + 0.5)], rel=1e-14)


def test_a_metric_learns_after_batches_if_configured():
    metric = Metric(
        [1.0, 1.0],
        [1.0, 1.0],
        MetricSettings(kind="learned", gamma=1.0, growth=1.0, every="batch"),
    )
    metric.observe([[0.0, E, 1 / E]], 0.0)
    assert metric.alpha == pytest.approx([1.0, -1.0])
    metric.end_epoch(0.1)
    assert metric.alpha == pytest.approx([1.0, -1.0])


def test_steps_are_clipped_as_published_and_a_term_without_loss_decreases_by_the_maximum():
    alpha = alpha_step([0.0, 0.0, 0.0], [1e30, 0.0, 1e-30], [1.0, 1.0, 1.0], gamma=0.01)
    np.testing.assert_allclose(alpha, [0.1, -0.1, -0.1], rtol=1e-14)


def test_terms_without_a_budget_and_means_that_are_nan_change_nothing():
    alpha = alpha_step(
        [0.5, 0.5, 0.5], [3.0, np.nan, np.inf], [0.0, 1.0, 1.0], gamma=0.1
    )
    assert alpha.tolist() == [0.5, 0.5, 0.5]


@pytest.mark.parametrize(
    ("average", "expected"),
    [("mean", [14.5, 2.0]), ("median", [5.5, 2.0]), ("trimmed", [5.0, 2.0])],
)
def test_averages_of_ten_plans_with_one_outlier(average, expected):
    terms = np.stack([[1.0, 2, 3, 4, 5, 6, 7, 8, 9, 100], np.full(10, 2.0)], axis=1)
    assert average_loss(terms, average).tolist() == expected
    assert (
        average_loss(
            np.concatenate([terms, [[np.nan, 1.0]], [[1.0, np.inf]]]), average
        ).tolist()
        == expected
    )


@pytest.mark.parametrize("kind", ["fixed", "ramped", "learned"])
def test_a_term_of_weight_zero_is_omitted_and_learns_nothing(kind):
    settings = MetricSettings(
        kind=kind, every="batch", growth=2.0, lowest=1e-3, gamma=1.0
    )
    metric = Metric([0.0, 1.0], [1.0, 1.0], settings)
    metric.observe([[9.0, E, E]], 0.0)
    assert metric.weights(0.0).tolist() == [
        0.0,
        pytest.approx(E if kind == "learned" else 1.0),
    ]
    again = Metric([0.0, 1.0], [1.0, 1.0], settings)
    again.load_state(json.loads(json.dumps(metric.state(), allow_nan=False)))
    assert again.weights(0.5).tolist() == metric.weights(0.5).tolist()


def test_a_factor_of_budgets_is_that_of_every_budget():
    settings = MetricSettings(
        kind="learned", every="batch", growth=1.0, gamma=1.0, budget_factor=0.1
    )
    metric = Metric([1.0, 1.0], [1.0, 0.0], settings)
    metric.observe([[9.0, 1.0, 7.0]], 0.0)
    assert metric.weights(0.0) == pytest.approx([10.0, 1.0])


def test_a_batch_without_valid_plans_changes_nothing():
    metric = Metric([2.0], [1.0], MetricSettings(kind="learned", every="batch"))
    before = metric.state()
    metric.observe(np.full((4, 2), np.nan), 0.1)
    metric.observe(np.zeros((0, 2)), 0.1)
    metric.end_epoch(0.2)
    assert metric.state() == before


def test_ramped_weights_grow_geometrically_between_the_ends_of_the_ramp():
    metric = Metric(
        [2.0, 30.0], [0.0, 0.0], MetricSettings(growth=100.0, ramp=(0.2, 0.6))
    )
    for progress, factor in [(0.0, 1), (0.2, 1), (0.4, 10), (0.6, 100), (1.0, 100)]:
        np.testing.assert_allclose(
            metric.weights(progress), np.array([2.0, 30.0]) * factor, rtol=1e-13
        )


@pytest.mark.parametrize("kind", ["fixed", "ramped"])
def test_only_learned_weights_depend_on_losses(kind):
    metric = Metric([2.0], [1.0], MetricSettings(kind=kind, every="batch"))
    before = metric.weights(0.5)
    metric.observe([[1.0, 1e3]], 0.5)
    metric.end_epoch(0.5)
    assert metric.weights(0.5).tolist() == before.tolist()
    assert (metric.weights(1.0) > metric.weights(0.0)).all() == (kind == "ramped")


def test_learned_weights_stay_within_their_bounds_and_are_constant_at_the_end():
    settings = MetricSettings(
        kind="learned",
        every="batch",
        gamma=5.0,
        growth=1.0,
        lowest=0.1,
        highest=8.0,
        frozen=0.5,
    )
    metric = Metric([1.0, 1.0], [1.0, 1.0], settings)
    metric.observe([[0.0, 1e9, 1e-9]], 0.49)
    np.testing.assert_allclose(metric.weights(0.49), [8.0, 0.1], rtol=1e-13)
    metric.observe([[0.0, 1e-9, 1e9]], 0.5)
    np.testing.assert_allclose(metric.weights(0.5), [8.0, 0.1], rtol=1e-13)


def test_budgets_of_a_learned_metric_shrink_with_the_ramp():
    settings = MetricSettings(
        kind="learned", every="batch", gamma=1.0, growth=100.0, ramp=(0.0, 0.5)
    )
    metric = Metric([1.0], [1.0], settings)
    metric.observe([[0.0, 1.0]], 0.0)
    assert metric.weights(0.0) == pytest.approx([1.0])
    metric.observe([[0.0, 1.0]], 0.25)
    assert metric.weights(0.25) == pytest.approx([10.0])


@pytest.mark.parametrize(
    "settings",
    [PUBLISHED, BOUNDED, MetricSettings()],
    ids=["published", "bounded", "ramped"],
)
@pytest.mark.parametrize("cut", [0, 3, 7])
def test_a_restored_metric_continues_with_identical_bits(settings, cut):
    def run(metric: Metric, batches: range) -> None:
        for k in batches:
            metric.observe(np.random.default_rng(k).lognormal(size=(16, 4)), k / 10)
            if k % 4 == 3:
                metric.end_epoch(k / 10)

    def fresh() -> Metric:
        return Metric([1.0, 1e-2, 1e4], [1e-3, 0.0, 1.0], settings)

    whole, first, second = fresh(), fresh(), fresh()
    run(whole, range(10))
    run(first, range(cut))
    second.load_state(json.loads(json.dumps(first.state())))
    run(second, range(cut, 10))
    assert second.state() == whole.state()
    assert second.weights(1.0).tolist() == whole.weights(1.0).tolist()


@pytest.mark.parametrize(
    "state",
    [
        {},
        {"alpha": [1.0], "sum": [0.0], "count": 0},
        {"alpha": "x", "sum": 0, "count": 0},
    ],
)
def test_the_state_of_another_metric_is_refused(state):
    with is_refused(UsageError, argument="state"):
        Metric([1.0, 1.0], [1.0, 1.0]).load_state(state)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"kind": "learnt"},
            r"kind must be one of fixed, ramped, learned, got 'learnt' \(did you mean",
        ),
        ({"every": "step"}, "every must be one of epoch, batch, got 'step'"),
        ({"average": "mode"}, "average must be one of mean, median, trimmed"),
        ({"gamma": 0.0}, "gamma of a metric must be above 0, got 0.0"),
        ({"growth": float("nan")}, "growth must be a finite number, got nan"),
        (
            {"lowest": 2.0, "highest": 1.0},
            "lowest must be at most highest = 1.0, got 2.0",
        ),
        ({"ramp": (0.5, 0.5)}, "must begin at 0 or later and before it ends"),
    ],
)
def test_invalid_settings_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        MetricSettings(**options)


@pytest.mark.parametrize(
    ("weights", "budgets", "message"),
    [
        ([1.0], [1.0, 2.0], r"one shape \(m,\), got \(1,\) and \(2,\)"),
        ([-1.0], [1.0], r"must be finite and not negative, got \[-1.0\]"),
        ([1.0], [-1.0], r"must be finite and not negative, got \[-1.0\]"),
    ],
)
def test_invalid_weights_and_budgets_are_refused(weights, budgets, message):
    with pytest.raises(UsageError, match=message):
        Metric(weights, budgets)


@pytest.mark.parametrize("name", ["airhockey", "heavy-object"])
def test_suggested_weights_are_positive_and_cover_every_term(name):
    of = loss(name)
    weights = suggested_weights(of.problem, of.weights0)
    assert weights.shape == of.weights0.shape
    assert (weights > 0).all()
    assert suggested_weights(problem_with(Table, TipSpeed), [1.0, 3.0]).tolist() == [
        1e4,
        300.0,
    ]


def test_all_tip_manifolds_have_the_suggested_weight_of_the_similar_shipped_one() -> (
    None
):
    """Check that planes have the weight of the table and axes that of 'vertical'."""
    table, plane, line, pose, vertical, axis = suggested_weights(
        problem_with(Table, Plane, Line, Pose, Vertical, Axis), np.ones(6)
    )
    assert plane == line == pose == table
    assert axis == vertical
