"""Remaining trajectories: agreement with the motion, and exact knot refinement."""

import numpy as np
import pytest

from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.remaining_trajectory import (
    MAX_ACCELERATION_ERROR,
    finer,
    remaining_trajectory,
    with_finer_knots,
)
from cnpgen.trajectory.spline_motion import Motion, states_at_times
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

SPEC = TrajectorySpec()
LIMIT = np.array([10.0, 12.0, 20.0])  # rad/s^2


def motions(count: int, roughness: float, seed: int = 0) -> Motion:
    """Draw motions with moving ends, whose accelerations are of the order of the limits."""
    random = np.random.default_rng(seed)
    rate = 0.6 * np.exp(roughness * random.normal(size=(count, 20)))
    boundary = Boundary(
        *(scale * random.normal(size=(count, 3)) for scale in (1.0, 0.3, 1.0, 1.0, 0.3))
    )
    along = np.linspace(0, 1, 10)[:, None]
    line = boundary.start_q[:, None] * (1 - along) + boundary.goal_q[:, None] * along
    interior = line + roughness * random.normal(size=line.shape)
    return Motion(assemble(boundary, interior, rate, SPEC), rate)


def remaining(motion: Motion, part: float) -> tuple[Motion, np.ndarray, Boundary]:
    t = part * motion.duration()
    goal = states_at_times(motion, motion.duration())
    boundary = Boundary(*states_at_times(motion, t), goal[0], goal[1])
    return (
        remaining_trajectory(motion, t, boundary, spec=SPEC, acceleration_limit=LIMIT),
        t,
        boundary,
    )


@pytest.mark.parametrize(("part", "points"), [(0.9, 15), (0.5, None), (0.05, None)])
def test_the_remaining_trajectory_agrees_with_the_motion_after_that_time(part, points):
    motion = motions(6, 0.02)
    rest, t, boundary = remaining(motion, part)
    assert points is None or rest.path.shape[1] == points
    np.testing.assert_allclose(rest.duration(), motion.duration() - t, rtol=1e-12)
    times = np.linspace(0, 1, 301) * (motion.duration() - t)[:, None]
    found, expected = rest.at_times(times), motion.at_times(times + t[:, None])
    assert (np.abs(found.ddq - expected.ddq) / LIMIT).max() < (
        2 * MAX_ACCELERATION_ERROR if rest.path.shape[1] < 31 else 1e-2
    )
    np.testing.assert_allclose(found.q, expected.q, atol=1e-4)
    for time, names in (
        (np.zeros(6), ("start_q", "start_dq", "start_ddq")),
        (rest.duration(), ("goal_q", "goal_dq")),
    ):
        for state, name in zip(states_at_times(rest, time), names, strict=False):
            np.testing.assert_allclose(
                state, getattr(boundary, name), atol=1e-9, err_msg=name
            )


def test_close_to_the_end_the_remaining_trajectory_is_exact_to_rounding():
    motion = motions(6, 0.05)
    rest, t, _ = remaining(motion, 0.9)
    times = np.linspace(0, 1, 101) * (motion.duration() - t)[:, None]
    found, expected = rest.at_times(times), motion.at_times(times + t[:, None])
    np.testing.assert_allclose(found.q, expected.q, atol=1e-10)
    np.testing.assert_allclose(found.ddq / LIMIT, expected.ddq / LIMIT, atol=1e-6)


def test_a_rough_motion_gets_more_spans_than_a_smooth_one():
    assert remaining(motions(3, 0.1), 0.1)[0].spec == finer(SPEC, 3)
    straight = motions(3, 0.0)
    assert remaining(straight, 0.9)[0].spec == SPEC


@pytest.mark.parametrize("spans", [1, 2, 3])
def test_a_motion_with_finer_knots_is_the_same_motion(spans):
    motion = motions(4, 0.1, seed=spans)
    same = with_finer_knots(motion, finer(SPEC, spans))
    assert (same.path.shape[1], same.rate.shape[1]) == (8 * spans + 7, 13 * spans + 7)
    s = np.linspace(0, 1, 77)
    for name in ("q", "dq", "ddq"):
        np.testing.assert_allclose(
            getattr(same.at(s), name), getattr(motion.at(s), name), rtol=1e-9, atol=1e-9
        )
