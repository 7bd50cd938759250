"""Motions in time: derivatives by finite differences, durations by quadrature, phases by their inverse."""

from itertools import pairwise

import numpy as np
import pytest
import scipy

from cnpgen.errors import UsageError
from cnpgen.trajectory.boundary import Boundary, anchor_line, assemble
from cnpgen.trajectory.spline import clamped_knots, extrema
from cnpgen.trajectory.spline_motion import Motion, States, states_at_times
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.conftest import some

FIELDS = tuple(States.__annotations__)


def draw_motion(
    seed: int, *, n: int = 4, spread: float = 0.4, degree: int = 7, joints: int = 3
) -> Motion:
    random = np.random.default_rng(seed)
    rate = 2 * np.exp(random.normal(0, spread, (n, 20)))
    return Motion(
        np.cumsum(random.normal(0, 0.2, (n, 15, joints)), axis=1), rate, degree
    )


def one(motion: Motion, i: int) -> Motion:
    return Motion(motion.path[[i]], motion.rate[[i]], motion.degree)


@pytest.mark.parametrize(("seed", "degree"), [(0, 7), (1, 7), (2, 5)])
def test_velocity_acceleration_and_jerk_are_derivatives_in_time(
    seed: int, degree: int
) -> None:
    motion = draw_motion(seed, degree=degree)
    h = 2e-5 * motion.duration()[:, None]
    t = np.linspace(0.05, 0.95, 41) * motion.duration()[:, None]
    before, now, after = (
        motion.at(motion.phase_at(t + step)) for step in (-h, 0 * h, h)
    )
    for value, derivative in (("q", "dq"), ("dq", "ddq"), ("ddq", "jerk")):
        found = (getattr(after, value) - getattr(before, value)) / (2 * h[..., None])
        expected = getattr(now, derivative)
        assert np.abs(found - expected).max() < 2e-6 * np.abs(expected).max()


def test_shared_phases_and_individual_phases_agree() -> None:
    motion = draw_motion(3)
    s = np.sort(np.random.default_rng(0).uniform(size=(4, 30)), axis=1)
    s[:, 0], s[:, -1] = 0, 1
    own = motion.at(s)
    for i in range(4):
        same = one(motion, i).at(s[i])
        for name in FIELDS:
            expected = getattr(same, name)[0]
            assert getattr(own, name)[i].shape == expected.shape
            assert (
                np.abs(getattr(own, name)[i] - expected).max()
                <= 1e-12 * np.abs(expected).max()
            )


@pytest.mark.parametrize("spread", [0.1, 0.5, 1.0, 2.0])
def test_the_duration_is_the_integral_of_one_over_r(spread: float) -> None:
    motion = draw_motion(4, spread=spread)
    breaks = np.unique(
        np.r_[
            np.linspace(0, 1, 53), 0.5 ** np.arange(5, 25), 1 - 0.5 ** np.arange(5, 25)
        ]
    )
    for i, found in enumerate(motion.duration()):
        r = scipy.interpolate.BSpline(clamped_knots(20, 7), motion.rate[i], 7)
        pieces = [
            scipy.integrate.quad(lambda s, r=r: 1 / r(s), a, b, epsabs=0, epsrel=1e-12)[
                0
            ]
            for a, b in pairwise(breaks)
        ]
        assert found == pytest.approx(sum(pieces), rel=1e-13 if spread < 0.5 else 1e-8)
    assert np.allclose(
        motion.time_at(np.array([0.3, 1.0]))[:, 1], motion.duration(), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("spread", "excess"), [(0.0, 1e-12), (0.1, 0.01), (0.5, 0.2), (2.0, np.inf)]
)
def test_the_duration_bound_is_at_least_the_duration(
    spread: float, excess: float
) -> None:
    motion = draw_motion(5, spread=spread)
    ratio = motion.duration_bound() / motion.duration()
    assert (ratio >= 1 - 1e-12).all()
    assert (ratio <= 1 + excess).all()


def test_a_slow_start_is_included_in_the_duration() -> None:
    """The first basis function is 0.01 wide: a quadrature on equal cells has errors of some percent."""
    rate = np.full((1, 20), 2.0)
    rate[0, 0] = 1e-3
    r = scipy.interpolate.BSpline(clamped_knots(20, 7), rate[0], 7)
    breaks = np.r_[0, 0.5 ** np.arange(25, 2, -1), 1]
    expected = sum(
        scipy.integrate.quad(lambda s: 1 / r(s), a, b, epsrel=1e-12)[0]
        for a, b in pairwise(breaks)
    )
    assert Motion(np.zeros((1, 15, 1)), rate).duration()[0] == pytest.approx(
        expected, rel=1e-9
    )


@pytest.mark.parametrize("spread", [0.1, 0.5, 1.5])
def test_phase_at_inverts_time_at(spread: float) -> None:
    motion = draw_motion(5, spread=spread)
    s = np.unique(
        np.r_[
            np.linspace(0, 1, 101),
            np.geomspace(1e-9, 0.01, 20),
            1 - np.geomspace(1e-9, 0.01, 20),
        ]
    )
    t = motion.time_at(s)
    assert np.all(np.diff(t) > 0)
    assert np.abs(motion.phase_at(t) - s).max() < 1e-10
    times = (
        np.random.default_rng(0).uniform(0, 1, (4, 200)) * motion.duration()[:, None]
    )  # not sorted
    phases = motion.phase_at(times)
    for i in range(4):
        order = np.argsort(phases[i])
        assert (
            np.abs(one(motion, i).time_at(phases[i][order])[0] - times[i][order]).max()
            < 1e-9 * times.max()
        )


def test_times_outside_the_motion_are_its_ends() -> None:
    motion = draw_motion(6)
    T = motion.duration()
    s = motion.phase_at(np.stack([-T, 0 * T, T, 2 * T, np.inf * T], axis=1))
    assert np.array_equal(s, np.tile([0.0, 0.0, 1.0, 1.0, 1.0], (4, 1)))
    assert motion.phase_at(np.zeros((4, 0))).shape == (4, 0)
    assert draw_motion(0, n=0).phase_at(np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("factor", [1.0, 1.3, 7.0])
def test_time_scaling_from_rest_to_rest_is_exact(factor: float) -> None:
    random = np.random.default_rng(7)
    q, zero, spec = random.normal(size=(2, 4, 3)), np.zeros((4, 3)), TrajectorySpec()
    boundary, rate = (
        Boundary(q[0], zero, zero, q[1], zero, zero),
        np.exp(random.normal(0, 0.3, (4, 20))),
    )
    motion = Motion(
        assemble(boundary, anchor_line(boundary, rate, spec), rate, spec), rate
    )
    slow = motion.time_scaled(np.full(4, factor))
    assert np.allclose(slow.duration(), factor * motion.duration(), rtol=1e-14)
    s = np.linspace(0, 1, 50)
    fast, found = motion.at(s), slow.at(s)
    for power, name in enumerate(("q", "dq", "ddq", "jerk")):
        expected = getattr(fast, name) / factor**power
        assert (
            np.abs(getattr(found, name) - expected).max()
            <= 1e-13 * np.abs(expected).max()
        )
    ends = slow.at(np.array([0.0, 1.0]))
    assert np.abs(ends.dq).max() < 1e-11
    assert np.abs(ends.ddq).max() < 1e-9
    again = assemble(
        boundary, motion.path[:, 3:-3], slow.rate, spec
    )  # the boundary points for the new rate are the same
    assert np.abs(again - slow.path).max() < 1e-14


def test_phases_and_times_may_be_shared_or_individual() -> None:
    motion = draw_motion(4, n=5)
    t = np.linspace(0, 0.3, 9)
    s = motion.phase_at(t)
    assert s.shape == (5, 9)
    np.testing.assert_array_equal(s, motion.phase_at(np.tile(t, (5, 1))))
    np.testing.assert_allclose(motion.time_at(s), np.tile(t, (5, 1)), atol=1e-13)
    np.testing.assert_allclose(motion.time_at(s[2])[2], t, atol=1e-13)
    ends = np.stack([np.zeros(5), motion.duration()], axis=1)
    np.testing.assert_array_equal(motion.time_at(np.array([-1.0, 2.0])), ends)
    np.testing.assert_array_equal(
        motion.at([0.0, 0.5]).q, motion.at(np.array([0.0, 0.5])).q
    )
    assert motion[:0].time_at(np.zeros((0, 4))).shape == (0, 4)
    np.testing.assert_array_equal(motion[3].path, motion.path[[3]])
    np.testing.assert_array_equal(motion.time_scaled(2.0).rate, motion.rate / 2)
    for method, what in (
        (motion.at, "s"),
        (motion.time_at, "s"),
        (motion.phase_at, "t"),
    ):
        for wrong in (
            0.5,
            np.full((1, 4), 0.5),
            np.full((3, 4), 0.5),
            np.zeros((5, 2, 2)),
        ):
            with pytest.raises(
                UsageError, match=rf"{what} must have shape \(K,\) or \(5, K\), got"
            ):
                method(wrong)


@pytest.mark.parametrize(
    ("path", "rate", "message"),
    [
        (
            (3, 15, 2),
            (4, 20),
            r"shapes \(N, C, n\) and \(N, R\), got \(3, 15, 2\) and \(4, 20\)",
        ),
        ((15, 2), (1, 20), r"got \(15, 2\) and \(1, 20\)"),
        ((1, 15, 2), (20,), r"got \(1, 15, 2\) and \(20,\)"),
        ((1, 15, 2), (1, 7), "splines of degree 7 need at least 8 control points"),
        ((1, 7, 2), (1, 20), "splines of degree 7 need at least 8 control points"),
    ],
)
def test_control_points_of_wrong_shapes_raise_an_error(
    path: tuple[int], rate: tuple[int], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        Motion(np.zeros(path), np.ones(rate))


def test_motions_with_a_rate_that_is_not_positive_have_an_infinite_duration() -> None:
    rate = np.ones((7, 20))
    rate[1] = 0
    rate[2, 9] = -30
    rate[3] = -1
    rate[4, 0] = 0
    rate[5, 10] = -0.02  # negative as a control point only
    rate[6, 10] = np.nan
    motion = Motion(np.zeros((7, 15, 2)), rate)
    assert motion.runs_forward().tolist() == [
        True,
        False,
        False,
        False,
        False,
        True,
        False,
    ]
    T = motion.duration()
    assert T[[0, 5]] == pytest.approx([1.0, 1.0], rel=0.2)
    assert np.isposinf(T[1:5]).all()
    assert np.isnan(T[6])


@pytest.mark.parametrize("lowest", some([1e-2, 1e-3, 1e-4, 1e-5], 1, "slow"))
def test_the_duration_with_a_rate_close_to_zero_agrees_with_adaptive_quadrature(
    lowest: float,
) -> None:
    random = np.random.default_rng(int(-np.log10(lowest)))
    rate = np.concatenate([random.uniform(1, 4, (3, 20)), np.ones((1, 20))])
    for row, index in zip(rate[:3], (5, 9, 14), strict=True):
        low, high = -60.0, 0.0
        for _ in range(80):
            row[index] = (low + high) / 2
            low, high = (
                (low, row[index])
                if extrema(row, 7)[1].min() > lowest
                else (row[index], high)
            )
        row[index] = high
    assert (rate[:3].min(axis=1) < 0).all()
    motion = Motion(np.zeros((4, 15, 1)), rate)
    T = motion.duration()
    for row, found in zip(rate, T, strict=True):
        r = scipy.interpolate.BSpline(clamped_knots(20, 7), row, 7)
        near = extrema(row, 7)[0]
        cuts = [
            near,
            *(near + sign * 10.0**power for sign in (1, -1) for power in range(-6, 0)),
        ]
        edges = np.unique(np.clip(np.concatenate([np.linspace(0, 1, 14), *cuts]), 0, 1))
        pieces = [
            scipy.integrate.quad(lambda s, r=r: 1 / r(s), a, b, epsrel=1e-11)[0]
            for a, b in pairwise(edges)
        ]
        assert found == pytest.approx(sum(pieces), rel=2e-9)
    alone = [motion[[i]].duration()[0] for i in range(4)]
    assert T.tolist() == alone
    t = np.linspace(0, 1, 40) * T[:, None]
    s = motion.phase_at(t)
    back = np.array([motion[[i]].time_at(s[i])[0] for i in range(4)])
    assert np.abs(back - t).max() < 1e-8 * T.max()
    np.testing.assert_array_equal(motion.time_at(s[0])[0], back[0])


def test_a_negative_rate_between_samples_is_detected() -> None:
    """The rate has a minimum of -1e-6 between two maxima, over a phase of 1e-3."""
    rate = np.ones((1, 20))
    rate[0, 9:11] = -1.0
    low, high = 0.0, 10.0
    for _ in range(80):  # raise the minimum to zero
        center = (low + high) / 2
        low, high = (
            (center, high)
            if not Motion(np.zeros((1, 15, 1)), rate + center).runs_forward()[0]
            else (low, center)
        )
    below, above = (
        Motion(np.zeros((1, 15, 1)), rate + low - 1e-9),
        Motion(np.zeros((1, 15, 1)), rate + high + 1e-9),
    )
    assert not below.runs_forward()[0]
    assert above.runs_forward()[0]
    assert (
        below.at(np.linspace(0, 1, 1000)).rate.min() > -2e-9
    )  # a grid of 1000 phases barely detects it
    assert np.isposinf(below.duration()[0])


def test_invalid_motions_do_not_warn_or_change_other_motions() -> None:
    good = draw_motion(8, n=2)
    path, rate = np.repeat(good.path, 4, axis=0), np.repeat(good.rate, 4, axis=0)
    path[1], path[2, 3, 1], path[3] = np.nan, np.inf, 1e300
    rate[5], rate[6], rate[7] = 0, -np.inf, 1e200
    motion = Motion(path, rate)
    t = np.linspace(0, 1, 30) * good.duration()[0]
    for s in (np.linspace(0, 1, 20), motion.phase_at(np.tile(t, (8, 1)))):
        found = motion.at(s)
        expected = one(good, 0).at(s if s.ndim == 1 else s[:1])
        assert all(
            np.allclose(getattr(found, name)[0], getattr(expected, name)[0], rtol=1e-12)
            for name in FIELDS
        )
    assert np.array_equal(motion.duration()[0], good.duration()[0])
    assert np.array_equal(
        motion.time_at(np.linspace(0, 1, 5))[4], good.time_at(np.linspace(0, 1, 5))[1]
    )
    assert motion.runs_forward().tolist() == [True] * 5 + [False] * 2 + [True]


def test_a_motion_has_the_same_bits_in_any_batch() -> None:
    motion = draw_motion(10, n=70, joints=6)
    s = np.linspace(0, 1, 333)
    times = s * motion.duration()[:, None]
    phases = motion.phase_at(times)
    whole, own = motion.at(s), motion.at(phases)
    for index in ([3], [69, 3], list(range(0, 70, 3))):
        part = motion[index]
        assert np.array_equal(part.duration(), motion.duration()[index])
        assert np.array_equal(part.time_at(s), motion.time_at(s)[index])
        assert np.array_equal(part.phase_at(times[index]), phases[index])
        for name in FIELDS:
            assert np.array_equal(
                getattr(part.at(s), name), getattr(whole, name)[index]
            )
            assert np.array_equal(
                getattr(part.at(phases[index]), name), getattr(own, name)[index]
            )


def test_the_spec_has_degree_and_numbers_of_control_points() -> None:
    assert draw_motion(9, degree=5).spec == TrajectorySpec(
        degree=5, path_control_points=15, rate_control_points=20
    )
    assert len(draw_motion(9)) == 4


@pytest.mark.parametrize("degree", [3, 5, 7])
@pytest.mark.parametrize("spread", [0.1, 0.5, 1.5])
def test_states_at_times_agree_with_the_motion_at_its_phases(
    degree: int, spread: float
) -> None:
    motion = draw_motion(11, n=40, spread=spread, joints=6, degree=degree)
    fraction = np.random.default_rng(1).uniform(size=40)
    fraction[:2] = 0.0, 1.0
    t = fraction * motion.duration()
    expected = motion.at(motion.phase_at(t[:, None]))
    for found, name in zip(states_at_times(motion, t), ("q", "dq", "ddq"), strict=True):
        of_motion = getattr(expected, name)[:, 0]
        assert np.abs(found - of_motion).max() < 1e-12 * max(
            np.abs(of_motion).max(), 1.0
        )


def test_velocities_and_accelerations_are_derivatives_of_positions_in_time() -> None:
    motion, h = draw_motion(12, n=30, joints=6), 1e-6
    t = np.random.default_rng(2).uniform(0.1, 0.9, 30) * motion.duration()
    (q0, dq0, _), (_, dq, ddq), (q1, dq1, _) = (
        states_at_times(motion, t + step) for step in (-h, 0.0, h)
    )
    assert np.abs((q1 - q0) / (2 * h) - dq).max() < 1e-6 * np.abs(dq).max()
    assert np.abs((dq1 - dq0) / (2 * h) - ddq).max() < 1e-6 * np.abs(ddq).max()


def test_states_at_knots_and_ends_are_continuous() -> None:
    motion = draw_motion(13, n=8, joints=2)
    ends = (
        states_at_times(motion, np.zeros(8)),
        states_at_times(motion, motion.duration()),
    )
    assert np.abs(ends[0][0] - motion.path[:, 0]).max() < 1e-14
    assert np.abs(ends[1][0] - motion.path[:, -1]).max() < 1e-13
    knot = motion.time_at(np.array([0.5]))[:, 0]  # 8 spans: a knot of the path
    around = [states_at_times(motion, knot + step) for step in (-1e-9, 1e-9)]
    for before, after in zip(*around, strict=True):
        assert np.abs(before - after).max() < 1e-5 * max(np.abs(after).max(), 1.0)
