"""Fits of action chunks, compared with splines of SciPy and with integrals of their definition."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp
from scipy.interpolate import BSpline

from cnpgen.addons.online.chunk_fit import BRAKING_SHARE, chunk_fit, chunk_times
from cnpgen.addons.online.set_points import SetPoint

RATE, LENGTH = 30.0, 50
STEP = 1 / RATE


def smooth_chunk(t):
    """Positions, velocities and accelerations of two joints at times, shape (K, 2) each."""
    w = np.array([1.3, 0.9])
    x = t[:, None] * w
    return 0.5 * np.sin(x), 0.5 * w * np.cos(x), -0.5 * w**2 * np.sin(x)


def states(path, rate, times):
    """Positions of a plan by SciPy at times: ds/dt = r(s)."""

    def spline(control):
        inner = np.linspace(0, 1, len(control) - 6)
        return BSpline(np.r_[np.zeros(7), inner, np.ones(7)], control, 7)

    p, r = spline(path), spline(rate)
    found = solve_ivp(
        lambda _, s: r(np.clip(s, 0, 1)),
        (0, times[-1]),
        [0.0],
        t_eval=times,
        rtol=1e-11,
        atol=1e-12,
        method="DOP853",
    )
    s = np.clip(found.y[0], 0, 1)
    speed, slope = r(s)[:, None], r.derivative()(s)[:, None]
    dq = p.derivative()(s) * speed
    ddq = p.derivative(2)(s) * speed**2 + p.derivative()(s) * slope * speed
    return p(s), dq, ddq


def test_chunk_times_are_the_integral_of_their_rate():
    s = np.linspace(0, 1, 20001)
    y = np.clip((s - 1 + BRAKING_SHARE) / BRAKING_SHARE, 0, 1)
    rate = 2.0 * (1 - (3 * y**2 - 2 * y**3))
    expected = cumulative_trapezoid(rate, s, initial=0)
    np.testing.assert_allclose(chunk_times(s, 2.0), expected, atol=1e-8)
    assert rate[-1] == 0  # at rest
    fit = chunk_fit(LENGTH, RATE)
    np.testing.assert_allclose(
        chunk_times(fit.phases, fit.duration), np.arange(LENGTH) * STEP, atol=1e-6
    )
    assert fit.times[-1] == pytest.approx((LENGTH - 1) * STEP)


def test_the_matrix_is_the_least_squares_solution_of_samples_and_jerks():
    rng, fit = np.random.default_rng(1), chunk_fit(LENGTH, RATE)
    points = fit.spec.path_control_points
    design = np.zeros((fit.fixed.shape[0], points))
    design[:, np.r_[:3, points - 3 : points]] = fit.fixed
    design[:, 3:-3] = np.linalg.pinv(fit.solve)
    q = rng.normal(size=(LENGTH, 2))
    state = SetPoint(q[0], rng.normal(size=2), rng.normal(size=2))
    _, path = fit.fit(q, state, fit.rate(1.0, np.ones(1))[0])
    residual = design @ path
    residual[:LENGTH] -= q
    gradient = design[:, 3:-3].T @ residual
    np.testing.assert_allclose(gradient, 0, atol=1e-9)
    greville = np.linspace(0, 1, points)
    assert np.abs(design[:LENGTH].sum(axis=1) - 1).max() < 1e-9  # of a basis
    assert np.abs(design[LENGTH:] @ greville**0).max() < 1e-9  # no jerk at a constant


@pytest.mark.parametrize("running", [0.75, 1.0, 1.6])
@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_a_motion_starts_in_its_state_ends_at_rest_and_is_in_time(running, speed):
    rng, fit = np.random.default_rng(2), chunk_fit(LENGTH, RATE)
    q = smooth_chunk(np.arange(LENGTH) * STEP)[0]
    state = SetPoint(q[0] + 0.02, rng.normal(size=2), rng.normal(size=2))
    rate = fit.rate(running, np.array([speed]))[0]
    _, path = fit.fit(fit.blended(q, state, running), state, rate)
    found = states(path, rate, np.linspace(0, 3, 400))
    for values, expected in zip(found, state, strict=True):
        np.testing.assert_allclose(values[0], expected, atol=1e-9)
    np.testing.assert_allclose(found[1][-1], 0, atol=1e-9)
    np.testing.assert_allclose(found[2][-1], 0, atol=1e-7)
    moving = np.abs(found[1]).max(axis=1) > 1e-7
    chunk = (LENGTH - 1) * STEP
    assert np.linspace(0, 3, 400)[moving].max() <= 1.2 * chunk / min(speed, running, 1)
    if running >= 0.75 and speed == 1:
        assert np.linspace(0, 3, 400)[moving].max() <= 1.2 * chunk


def test_a_motion_follows_its_chunk_at_its_own_timing():
    t = np.arange(LENGTH) * STEP
    q, dq, ddq = smooth_chunk(t)
    fit, state = chunk_fit(LENGTH, RATE), SetPoint(q[0], dq[0], ddq[0])
    running = fit.running_speed(q, state, 2.0)
    assert running == pytest.approx(1, abs=0.02)
    rate = fit.rate(1.0, np.ones(1))[0]
    _, path = fit.fit(fit.blended(q, state, 1.0), state, rate)
    kept = t < (1 - BRAKING_SHARE) * fit.duration  # before it brakes
    found, _, _ = states(path, rate, t)
    assert np.abs(found - q)[kept].max() < 1e-3


def test_the_running_speed_is_that_along_the_chunk():
    q = smooth_chunk(np.arange(LENGTH) * STEP)[0]
    fit = chunk_fit(LENGTH, RATE)
    velocity = np.array([0.65, 0.45])
    across = np.array([0.45, -0.65])
    for speed in (0.9, 1.5, 1.9):
        state = SetPoint(q[0], speed * velocity + across, np.zeros(2))
        assert fit.running_speed(q, state, 2.0) == pytest.approx(speed, abs=0.04)
    still = SetPoint(q[0], np.zeros(2), np.zeros(2))
    assert fit.running_speed(q, still, 2.0) == 0.75
    fast = SetPoint(q[0], 9 * velocity, np.zeros(2))
    assert fit.running_speed(q, fast, 1.0) == 1.0


def test_the_difference_at_the_join_vanishes_within_the_blend():
    fit = chunk_fit(LENGTH, RATE)
    q = smooth_chunk(np.arange(LENGTH) * STEP)[0]
    _, dq, ddq = smooth_chunk(np.zeros(1))
    state = SetPoint(q[0] + 0.03, dq[0], ddq[0])
    blended = fit.blended(q, state, 1.0)
    assert np.abs(blended[0] - state.q).max() < 1e-3
    np.testing.assert_allclose(blended[24:], q[24:], atol=1e-12)
    assert (np.diff(np.abs(blended - q).max(axis=1)) < 1e-9).all()
