"""Where the verdict looks: no further apart than the step, densely at the ends, at the right times."""

import numpy as np
import pytest

from cnpgen.judges.plans.sampling import (
    AT_ENDS,
    FEW_AT_ENDS,
    FEW_CELLS,
    FEW_PER_SPAN,
    FEWEST,
    LONGEST,
    MOST,
    few_phases,
    sample,
    time_table,
    times,
)
from cnpgen.trajectory.motion import Motion
from tests.examples.plans import load


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
@pytest.mark.parametrize("step", [1e-3, 2e-4, 1.0])
def test_samples_are_no_further_apart_than_the_step_and_dense_at_the_ends(label, step):
    motion = load(label).motion
    samples = sample(time_table(motion.rate[0], 7), step, 13)
    assert samples is not None
    assert samples.s[0] == 0
    assert samples.s[-1] == 1
    assert np.all(np.diff(samples.s) > 0)
    exact = motion.time_at(samples.s)[0]
    np.testing.assert_allclose(samples.t, exact, atol=1e-6)
    assert np.diff(exact).max() <= step
    assert len(samples.s) >= FEWEST
    for near in (samples.s, 1 - samples.s):
        assert np.sum((near > 0) & (near < 0.0501)) >= AT_ENDS
        assert np.sum((near > 0) & (near < 2e-3)) >= 10


def test_times_are_right_where_the_rate_begins_at_almost_nothing():
    motion = load("transport").motion
    rate = motion.rate.copy()
    rate[:, 0] = 1e-6
    slow = Motion(motion.path, rate)
    phases, times = time_table(rate[0], 7)
    assert times[-1] == pytest.approx(slow.duration()[0], rel=1e-5)
    assert phases[0] == 0
    assert phases[-1] == 1


@pytest.mark.parametrize("step", [1e-2, 1e-3, 1e-5])
def test_whether_a_motion_is_too_long_does_not_depend_on_the_step(step: float) -> None:
    rate = np.full(20, 1.0 / LONGEST)
    assert sample(time_table(0.99 * rate, 7), step, 13) is None
    slow = sample(time_table(1.01 * rate, 7), step, 13)
    assert slow is not None
    assert MOST < len(slow.s) < 1.1 * MOST
    assert np.diff(slow.t).max() <= 1e-2


def test_a_coarser_step_takes_fewer_samples():
    plan = load("transport")
    assert plan.judged(step=4e-3).samples < plan.judged().samples < plan.judged(step=5e-4).samples


def test_a_first_look_is_at_phases_in_every_span_near_both_ends_and_where_it_is_told() -> None:
    phases = few_phases(13, frozenset([0.1234])).s
    assert (phases[0], phases[-1]) == (0, 1)
    assert np.all(np.diff(phases) > 0)
    assert 0.1234 in phases
    inside = np.histogram(phases, np.arange(14) / 13)[0]
    assert inside.min() >= FEW_PER_SPAN
    for near in (phases, 1 - phases):
        assert np.sum((near > 0) & (near < 0.0501)) >= FEW_AT_ENDS
        assert np.sum((near > 0) & (near < 1e-3)) >= 2


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_a_table_of_few_cells_gives_the_times_as_well(label: str) -> None:
    motion, phases = load(label).motion, few_phases(13).s
    exact = motion.time_at(phases)[0]
    np.testing.assert_allclose(times(phases, time_table(motion.rate[0], 7, cells=FEW_CELLS)), exact, atol=2e-4)
