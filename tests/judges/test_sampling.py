"""Where the verdict looks: no further apart than the step, densely at the ends, at the right times."""

import numpy as np
import pytest

from cnpgen.judges.plans.sampling import AT_ENDS, CELLS, FEW_CELLS, FEWEST, LONGEST, MOST, sample, time_table
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


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_a_first_look_takes_fewer_samples_but_not_near_the_ends(label: str) -> None:
    motion = load(label).motion
    few, all_of_them = (
        sample(time_table(motion.rate[0], 7, cells=cells), 1e-3, 13, sparse=sparse)
        for cells, sparse in ((FEW_CELLS, True), (CELLS, False))
    )
    assert few is not None
    assert all_of_them is not None
    assert 0.2 < len(few.s) / len(all_of_them.s) < 0.5
    exact = motion.time_at(few.s)[0]
    np.testing.assert_allclose(few.t, exact, atol=2e-5)
    assert np.diff(exact).max() <= 4e-3
    for near in (few.s, 1 - few.s):
        assert np.sum((near > 0) & (near < 0.0501)) >= AT_ENDS  # torques have peaks there that fewer do not show
