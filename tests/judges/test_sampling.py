"""Samples of the verdict: steps in time, dense at the ends, at the right times."""

import numpy as np
import pytest

from cnpgen.judges.plans.sampling import (
    EARLY_EXIT_CELLS,
    EARLY_EXIT_PER_END,
    EARLY_EXIT_PER_SPAN,
    MAX_DURATION_S,
    MAX_TIME_SAMPLES,
    MIN_SAMPLES,
    SAMPLES_PER_END,
    early_exit_phases,
    sample,
    time_table,
    times,
)
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.plans import load


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
@pytest.mark.parametrize("step", [1e-3, 2e-4, 1.0])
def test_samples_respect_the_step_and_are_dense_at_the_ends(label, step):
    motion = load(label).motion
    samples = sample(time_table(motion.rate[0], 7), step, 13)
    assert samples is not None
    assert samples.s[0] == 0
    assert samples.s[-1] == 1
    assert np.all(np.diff(samples.s) > 0)
    exact = motion.time_at(samples.s)[0]
    np.testing.assert_allclose(samples.t, exact, atol=1e-6)
    assert np.diff(exact).max() <= step
    assert len(samples.s) >= MIN_SAMPLES
    for near in (samples.s, 1 - samples.s):
        assert np.sum((near > 0) & (near < 0.0501)) >= SAMPLES_PER_END
        assert np.sum((near > 0) & (near < 2e-3)) >= 10


def test_times_are_correct_if_the_rate_starts_close_to_zero():
    motion = load("transport").motion
    rate = motion.rate.copy()
    rate[:, 0] = 1e-6
    slow = Motion(motion.path, rate)
    phases, times = time_table(rate[0], 7)
    assert times[-1] == pytest.approx(slow.duration()[0], rel=1e-5)
    assert phases[0] == 0
    assert phases[-1] == 1


@pytest.mark.parametrize("step", [1e-2, 1e-3, 1e-5])
def test_the_maximum_duration_does_not_depend_on_the_step(step: float) -> None:
    rate = np.full(20, 1.0 / MAX_DURATION_S)
    assert sample(time_table(0.99 * rate, 7), step, 13) is None
    slow = sample(time_table(1.01 * rate, 7), step, 13)
    assert slow is not None
    assert MAX_TIME_SAMPLES < len(slow.s) < 1.1 * MAX_TIME_SAMPLES
    assert np.diff(slow.t).max() <= 1e-2


def test_a_coarser_step_takes_fewer_samples():
    plan = load("transport")
    assert (
        plan.judged(step=4e-3).samples
        < plan.judged().samples
        < plan.judged(step=5e-4).samples
    )


def test_early_exit_phases_are_in_every_span_near_both_ends_and_at_additional_phases() -> (
    None
):
    phases = early_exit_phases(13, frozenset([0.1234])).s
    assert (phases[0], phases[-1]) == (0, 1)
    assert np.all(np.diff(phases) > 0)
    assert 0.1234 in phases
    inside = np.histogram(phases, np.arange(14) / 13)[0]
    assert inside.min() >= EARLY_EXIT_PER_SPAN
    for near in (phases, 1 - phases):
        assert np.sum((near > 0) & (near < 0.0501)) >= EARLY_EXIT_PER_END
        assert np.sum((near > 0) & (near < 1e-3)) >= 2


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_a_table_of_few_cells_gives_the_same_times(label: str) -> None:
    motion, phases = load(label).motion, early_exit_phases(13).s
    exact = motion.time_at(phases)[0]
    np.testing.assert_allclose(
        times(phases, time_table(motion.rate[0], 7, cells=EARLY_EXIT_CELLS)),
        exact,
        atol=2e-4,
    )
