"""States at single moments: those of ``Motion.at``, for every motion its own, also at the ends and at the knots."""

import numpy as np
import pytest

from cnpgen.trajectory.moment import states_at_times
from tests.trajectory.test_motion import draw_motion


@pytest.mark.parametrize("degree", [3, 5, 7])
@pytest.mark.parametrize("spread", [0.1, 0.5, 1.5])
def test_the_state_at_a_moment_is_that_of_the_motion_at_its_phase(degree: int, spread: float) -> None:
    motion = draw_motion(11, n=40, spread=spread, joints=6, degree=degree)
    share = np.random.default_rng(1).uniform(size=40)
    share[:2] = 0.0, 1.0
    t = share * motion.duration()
    expected = motion.at(motion.phase_at(t[:, None]))
    for found, name in zip(states_at_times(motion, t), ("q", "dq", "ddq"), strict=True):
        of_motion = getattr(expected, name)[:, 0]
        assert np.abs(found - of_motion).max() < 1e-12 * max(np.abs(of_motion).max(), 1.0)


def test_velocities_and_accelerations_are_derivatives_of_positions_in_time() -> None:
    motion, h = draw_motion(12, n=30, joints=6), 1e-6
    t = np.random.default_rng(2).uniform(0.1, 0.9, 30) * motion.duration()
    (q0, dq0, _), (_, dq, ddq), (q1, dq1, _) = (states_at_times(motion, t + step) for step in (-h, 0.0, h))
    assert np.abs((q1 - q0) / (2 * h) - dq).max() < 1e-6 * np.abs(dq).max()
    assert np.abs((dq1 - dq0) / (2 * h) - ddq).max() < 1e-6 * np.abs(ddq).max()


def test_at_knots_and_ends_the_control_points_that_are_left_decide() -> None:
    motion = draw_motion(13, n=8, joints=2)
    ends = states_at_times(motion, np.zeros(8)), states_at_times(motion, motion.duration())
    assert np.abs(ends[0][0] - motion.path[:, 0]).max() < 1e-14
    assert np.abs(ends[1][0] - motion.path[:, -1]).max() < 1e-13
    knot = motion.time_at(np.array([0.5]))[:, 0]  # 8 spans: a knot of the path
    around = [states_at_times(motion, knot + step) for step in (-1e-9, 1e-9)]
    for before, after in zip(*around, strict=True):
        assert np.abs(before - after).max() < 1e-5 * max(np.abs(after).max(), 1.0)
