"""Fit of motions to time-sampled trajectories of other planners."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.addons.trajectories.fit import fit_motion, largest_error
from cnpgen.addons.trajectories.samples import sampled_boundary
from cnpgen.errors import UsageError
from cnpgen.trajectory.boundary import Boundary, assemble
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.conftest import some
from tests.refusals import is_refused

SPEC = TrajectorySpec()
Curve = Callable[[np.ndarray], np.ndarray]
TRAVEL = np.array([1.2, -0.7, 0.05])


def minimum_jerk(u: np.ndarray) -> np.ndarray:
    u = np.clip(u, 0, 1)[:, None]
    return TRAVEL * (10 * u**3 - 15 * u**4 + 6 * u**5)


def trapezoid(u: np.ndarray) -> np.ndarray:
    ramp = 0.3
    speed = 1 / (1 - ramp)
    rise, fall = speed * u**2 / (2 * ramp), 1 - speed * (1 - u) ** 2 / (2 * ramp)
    return (
        TRAVEL
        * np.where(
            u < ramp, rise, np.where(u < 1 - ramp, speed * (u - ramp / 2), fall)
        )[:, None]
    )


def at_rest(q: np.ndarray) -> Boundary:
    zero = np.zeros((1, q.shape[1]))
    return Boundary(q[:1], zero, zero, q[-1:], zero)


def own_motion(seed: int) -> tuple[Motion, Boundary]:
    """Draw a motion of the family, 0.5 s long, with moving ends."""
    random = np.random.default_rng(seed)
    boundary = Boundary(
        *random.uniform(-1, 1, (5, 1, 3)) * np.array([1, 1, 5, 1, 1])[:, None, None]
    )
    rate = np.exp(np.cumsum(random.normal(0, 0.2, (1, 20)), axis=1))
    rate *= Motion(np.zeros((1, 15, 1)), rate).duration() / 0.5
    along = np.linspace(0, 1, 10)[:, None]
    interior = (
        boundary.start_q * (1 - along)
        + boundary.goal_q * along
        + random.normal(0, 0.1, (1, 10, 3))
    )
    return Motion(assemble(boundary, interior, rate, SPEC), rate), boundary


def test_a_quintic_is_fitted_exactly_with_phase_proportional_to_time() -> None:
    t = np.linspace(3, 3.7, 301)
    q = minimum_jerk((t - 3) / 0.7)
    motion = fit_motion(t, q, spec=SPEC, boundary=at_rest(q))
    assert largest_error(motion, t, q) < 1e-10
    assert np.allclose(motion.rate, 1 / 0.7, rtol=1e-12)
    assert motion.duration()[0] == pytest.approx(0.7, rel=1e-12)


@pytest.mark.parametrize("seed", some(range(4), 1, "slow"))
def test_a_motion_of_the_family_is_reproduced(seed: int) -> None:
    motion, boundary = own_motion(seed)
    t = np.linspace(0, 0.5, 501)
    q = motion.at(motion.phase_at(t[None])).q[0]
    found = fit_motion(t, q, spec=SPEC, boundary=boundary)
    assert largest_error(found, t, q) < 5e-5
    assert found.duration()[0] == pytest.approx(0.5, rel=1e-9)
    between = np.linspace(0.0005, 0.4995, 500)
    truth = motion.at(motion.phase_at(between[None])).q[0]
    assert largest_error(found, np.r_[0, between], np.vstack([q[:1], truth])) < 5e-5


@pytest.mark.slow
def test_a_trapezoidal_profile_is_fitted_within_a_milliradian() -> None:
    t = np.linspace(0, 0.8, 801)
    q = trapezoid(t / 0.8)
    motion = fit_motion(t, q, spec=SPEC)
    assert largest_error(motion, t, q) < 3e-4
    more = TrajectorySpec(path_control_points=30, rate_control_points=30)
    assert largest_error(fit_motion(t, q, spec=more), t, q) < 1e-4


@pytest.mark.slow
def test_rest_at_both_ends_keeps_the_rate_positive_and_uses_few_control_points() -> (
    None
):
    t = np.linspace(0, 1.4, 1401)
    q = minimum_jerk((t - 0.5) / 0.4)
    motion = fit_motion(t, q, spec=SPEC)
    assert largest_error(motion, t, q) < 1e-3
    assert (motion.rate > 0).all()
    assert motion.duration()[0] == pytest.approx(1.4, rel=1e-12)
    moving = np.diff(motion.phase_at(np.array([[0.5, 0.9]]))[0])
    assert moving > 0.6  # of the phase, in 0.29 of the time
    ends = motion.at(np.array([0.0, 1.0]))
    assert np.abs(ends.dq).max() < 1e-12
    assert np.abs(ends.ddq[0, 0]).max() < 1e-10


@pytest.mark.parametrize("goal_ddq", [False, True])
def test_a_prescribed_boundary_holds_exactly_for_other_samples(goal_ddq: bool) -> None:
    t = np.linspace(0, 1, 101)
    q = np.column_stack([np.sin(5 * t), np.cos(3 * t), t])
    random = np.random.default_rng(0)
    parts = [
        q[:1] + 0.01,
        *random.uniform(-1, 1, (2, 1, 3)),
        q[-1:] - 0.01,
        *random.uniform(-1, 1, (2, 1, 3)),
    ]
    boundary = Boundary(*parts[:5], parts[5] if goal_ddq else None)
    motion = fit_motion(t, q, spec=SPEC, boundary=boundary)
    ends, rate = motion.at(np.array([0.0, 1.0])), motion.rate[0]
    assert np.abs(ends.q[0] - [boundary.start_q[0], boundary.goal_q[0]]).max() < 1e-12
    assert (
        np.abs(ends.dq[0] - [boundary.start_dq[0], boundary.goal_dq[0]]).max() < 1e-10
    )
    assert np.abs(ends.ddq[0, 0] - boundary.start_ddq[0]).max() < 1e-11 * max(
        rate[0] ** 2, 10
    )
    if goal_ddq:
        assert np.abs(ends.ddq[0, 1] - parts[5][0]).max() < 1e-11 * max(
            rate[-1] ** 2, 10
        )


def test_uneven_and_missing_samples_are_supported() -> None:
    random = np.random.default_rng(1)
    uneven = np.r_[0, np.sort(random.uniform(0, 1, 300)), 1]
    gap = np.r_[np.linspace(0, 0.5, 30), np.linspace(0.8, 1, 200)]
    for t in (uneven, gap):
        q = np.column_stack([np.sin(4 * t), np.cos(3 * t)])
        motion = fit_motion(t, q, spec=SPEC)
        dense = np.linspace(0, 1, 500)
        assert largest_error(motion, t, q) < 1e-5
        assert (
            largest_error(
                motion, dense, np.column_stack([np.sin(4 * dense), np.cos(3 * dense)])
            )
            < 2e-3
        )


@pytest.mark.slow
def test_few_samples_with_velocities_are_connected_by_cubics() -> None:
    from scipy.interpolate import CubicHermiteSpline

    t = np.linspace(0, 1, 9)
    q, dq = (
        np.column_stack([np.sin(4 * t), t**2]),
        np.column_stack([4 * np.cos(4 * t), 2 * t]),
    )
    motion = fit_motion(t, q, dq, spec=SPEC)
    dense = np.linspace(0, 1, 500)
    assert largest_error(motion, dense, CubicHermiteSpline(t, q, dq)(dense)) < 3e-4
    ends = motion.at(np.array([0.0, 1.0]))
    assert np.abs(ends.dq[0] - dq[[0, -1]]).max() < 1e-12


@pytest.mark.parametrize(
    ("t", "q"),
    [
        ([0.0, 1.0], [[0.0, 1.0], [1.0, 3.0]]),
        ([0.0, 0.1, 1.0], [[0.0], [1.0], [0.0]]),
        ([2.0, 2.1, 2.3, 2.4, 3.0], [[0.0], [1.0], [0.5], [0.2], [0.9]]),
    ],
)
def test_a_handful_of_samples_is_interpolated_smoothly(
    t: list[float], q: list[list[float]]
) -> None:
    motion = fit_motion(t, q, spec=SPEC)
    assert largest_error(motion, t, q) < 1e-9
    travel = np.abs(np.diff(q, axis=0)).sum()
    assert np.ptp(motion.at(np.linspace(0, 1, 200)).q) < 3 * travel
    assert motion.runs_forward()[0]


def test_two_samples_make_a_straight_motion_at_constant_speed() -> None:
    motion = fit_motion([0.0, 2.0], [[0.0, 1.0], [1.0, 3.0]], spec=SPEC)
    states = motion.at(np.linspace(0, 1, 20))
    assert np.abs(states.dq - np.array([0.5, 1.0])).max() < 1e-9
    assert np.abs(states.ddq).max() < 1e-6


def test_a_robot_at_rest_stays_at_rest() -> None:
    t = np.linspace(0, 1, 50)
    motion = fit_motion(t, np.full((50, 2), 0.3), spec=SPEC)
    assert np.abs(motion.path - 0.3).max() < 1e-12
    assert np.allclose(motion.rate, 1, rtol=1e-12)


@pytest.mark.parametrize(
    "spec",
    [
        TrajectorySpec(degree=3, path_control_points=6, rate_control_points=4),
        TrajectorySpec(degree=5, path_control_points=10, rate_control_points=12),
        TrajectorySpec(degree=7, path_control_points=60, rate_control_points=50),
    ],
)
def test_other_degrees_and_numbers_of_control_points_are_supported(
    spec: TrajectorySpec,
) -> None:
    t = np.linspace(0, 1, 101)
    q = np.column_stack([np.sin(3 * t)])
    motion = fit_motion(t, q, spec=spec)
    assert motion.spec == spec
    assert largest_error(motion, t, q) < 5e-3


@pytest.mark.slow
def test_many_samples_and_long_motions_are_fitted() -> None:
    t = np.linspace(0, 1e4, 20_001)
    q = np.column_stack([np.sin(3e-4 * t), trapezoid(t / 1e4)[:, 0]])
    motion = fit_motion(t, q, spec=SPEC)
    assert largest_error(motion, t, q) < 1e-3
    assert motion.duration()[0] == pytest.approx(1e4, rel=1e-9)


def test_noise_does_not_cause_boundary_accelerations() -> None:
    random = np.random.default_rng(2)
    t = np.linspace(0, 1, 1001)
    q = minimum_jerk(t)
    boundary = sampled_boundary(t, q + random.normal(0, 1e-5, q.shape))
    assert np.abs(boundary.start_dq).max() < 0.02
    assert np.abs(boundary.goal_dq).max() < 0.02
    assert np.abs(boundary.start_ddq).max() < 1.0


def test_the_sampled_boundary_agrees_with_the_curve() -> None:
    t = np.linspace(1, 2, 501)
    q = np.column_stack([np.sin(4 * (t - 1)), (t - 1) ** 2, np.full_like(t, 0.2)])
    dq = np.column_stack([4 * np.cos(4 * (t - 1)), 2 * (t - 1), np.zeros_like(t)])
    for velocities in (None, dq):
        boundary = sampled_boundary(t, q, velocities)
        assert boundary.goal_ddq is None
        assert np.array_equal(boundary.start_q[0], q[0])
        assert np.array_equal(boundary.goal_q[0], q[-1])
        assert np.abs(boundary.start_dq[0] - dq[0]).max() < 1e-3
        assert np.abs(boundary.goal_dq[0] - dq[-1]).max() < 1e-3
        assert np.abs(boundary.start_ddq[0] - [0, 2, 0]).max() < 0.3
    resting = sampled_boundary(t, minimum_jerk(t - 1))
    assert not resting.start_dq.any()
    assert not resting.goal_dq.any()


T3, Q3 = [0.0, 0.5, 1.0], np.zeros((3, 2))


@pytest.mark.parametrize(
    ("t", "q", "dq", "message"),
    [
        (
            [0.0, 0.5, 0.5],
            Q3,
            None,
            r"t must increase, got 0.5 s in sample 1, then 0.5 s",
        ),
        ([0.0, 0.7, 0.5], Q3, None, "t must increase, got 0.7 s in sample 1"),
        ([0.0, np.nan, 1.0], Q3, None, "t must be finite, got nan in sample 1"),
        (T3, [[0, 0], [0, 0], [np.inf, 0]], None, "q must be finite, .* in sample 2"),
        (T3, Q3, np.full((3, 2), np.nan), "dq must be finite, .* in sample 0"),
        (T3, Q3[:2], None, r"got \(3,\) and \(2, 2\)"),
        (T3, np.zeros(3), None, r"q shape \(K, n\)"),
        ([T3], Q3, None, r"t must have shape \(K,\)"),
        (T3, np.zeros((3, 0)), None, "must have shape"),
        (
            T3,
            Q3,
            np.zeros((3, 3)),
            r"dq must have the shape of q, \(3, 2\), got \(3, 3\)",
        ),
        ([0.0], Q3[:1], None, "at least 2 samples, got 1"),
        ([], np.zeros((0, 2)), None, "at least 2 samples, got 0"),
        (T3, [["a", "b"]] * 3, None, "q must be an array of numbers"),
    ],
)
def test_invalid_samples_raise_an_error(
    t: object, q: object, dq: object, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        fit_motion(t, q, dq, spec=SPEC)
    with pytest.raises(UsageError, match=message):
        sampled_boundary(t, q, dq)


def test_a_boundary_of_a_wrong_shape_raises_an_error() -> None:
    t = np.linspace(0, 1, 20)
    q = np.zeros((20, 3))
    with is_refused(UsageError, argument="boundary"):
        fit_motion(t, q, spec=SPEC, boundary=at_rest(np.zeros((2, 2))))
    with is_refused(UsageError, argument="boundary"):
        fit_motion(t, q, spec=SPEC, boundary=at_rest(np.full((2, 3), np.nan)))
    with pytest.raises(UsageError, match="boundary must be an array of numbers"):
        fit_motion(
            t,
            q,
            spec=SPEC,
            boundary=replace(at_rest(np.zeros((2, 3))), goal_dq=[["a", 0, 0]]),
        )
    lists = Boundary(
        *(
            values.tolist()
            for values in vars(at_rest(np.zeros((2, 3)))).values()
            if values is not None
        )
    )
    assert np.array_equal(
        fit_motion(t, q, spec=SPEC, boundary=lists).path, np.zeros((1, 15, 3))
    )
