"""Schedule, order of rows, clipping and settings: each follows from little, and says what it refuses."""

import math

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.training.clipping import Clipping
from cnpgen.training.order import Order
from cnpgen.training.schedule import learning_rate
from cnpgen.training.settings import Length, TrainingSettings


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
    order = Order(103, 10, seed=5)
    epoch = np.concatenate([order.batch(step) for step in range(10)])
    assert len(np.unique(epoch)) == 100
    other = np.concatenate([order.batch(step) for step in range(10, 20)])
    assert len(np.unique(other)) == 100
    assert (epoch != other).any()


def test_the_order_is_arithmetic_in_seed_and_step():
    order, again = Order(64, 8, seed=1), Order(64, 8, seed=1)
    steps = [0, 31, 7, 8, 100, 0]  # in any sequence
    for step in steps:
        np.testing.assert_array_equal(order.batch(step), Order(64, 8, seed=1).batch(step))
        np.testing.assert_array_equal(order.batch(step), again.batch(step))
    assert (Order(64, 8, seed=2).batch(0) != order.batch(0)).any()


def test_fewer_rows_than_a_batch_are_one_batch():
    assert sorted(Order(5, 64, seed=0).batch(3)) == [0, 1, 2, 3, 4]


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


@pytest.mark.parametrize("wrong", [{"hidden": 0}, {"batch_size": -1}, {"learning_rate": 0.0}, {"sample_clip": np.nan}])
def test_settings_that_cannot_be_meant_are_refused_by_name(wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(UsageError, match=f"{name} must be .*, got {value}"):
        TrainingSettings(**wrong)


@pytest.mark.parametrize("wrong", [{}, {"steps": 5, "epochs": 2}, {"cpu_seconds": 0.0}])
def test_a_run_has_one_length(wrong):
    with pytest.raises(UsageError, match=r"how long|above 0"):
        Length(**wrong)
