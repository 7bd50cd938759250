"""Curves through samples of float32: within the errors of all samples and within acceleration limits, or none."""

import numpy as np
from scipy.integrate import cumulative_trapezoid

import cnpgen
from cnpgen.addons.trajectories.curve_family import CurveFamily
from cnpgen.addons.trajectories.judge_family import FamilyJudge
from cnpgen.addons.trajectories.judge_samples import acceleration_limits
from cnpgen.addons.trajectories.limited_witness import limited_witness
from cnpgen.addons.trajectories.sample_errors import SampleErrors, errors_of
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.window_program import TorqueBounds
from cnpgen.addons.trajectories.witness import MIN_ERRORS, witness
from cnpgen.arrays import Array
from cnpgen.plans.exporter import sample_plan
from tests.examples.plans import load

FINE = np.linspace(0, 1, 20_001)


def ramp(limit: float, rate: float) -> Trajectory:
    """One joint whose acceleration rises to the limit within half a span, in float32."""
    fine = np.linspace(0, 0.4, 400_001)
    rise = 0.5 / rate
    ddq = limit * np.clip(np.minimum(fine / rise, (0.2 - fine) / rise), -1, 1)
    dq = cumulative_trapezoid(ddq, fine, initial=0)
    q = cumulative_trapezoid(dq, fine, initial=0)
    chosen = np.arange(0, len(fine), round(1 / rate / fine[1]))
    values = [
        array[chosen].astype(np.float32).astype(float)[:, None] for array in (q, dq)
    ]
    return Trajectory((np.arange(len(chosen)) / rate).astype(np.float32), *values)


def largest_acceleration(curve: CurveFamily) -> float:
    return float(np.abs(curve.evaluate(FINE, jerk=False).ddq).max())


def is_within(curve: CurveFamily, trajectory: Trajectory, errors: SampleErrors) -> bool:
    states = curve.evaluate(trajectory.t / trajectory.duration, jerk=False)
    assert trajectory.dq is not None
    allowed = 1.001 * np.maximum(errors.values, MIN_ERRORS)
    pairs = ((states.q, trajectory.q), (states.dq, trajectory.dq))
    return all(
        (np.abs(x.T - y) <= e).all() for (x, y), e in zip(pairs, allowed, strict=False)
    )


def test_the_curve_keeps_a_limit_that_the_smoothest_one_exceeds() -> None:
    trajectory, limit = ramp(10.0, 500.0), np.array([10.0 * 1.004])
    errors = errors_of(trajectory, None, None)
    smoothest = witness(trajectory, errors)
    limited = limited_witness(trajectory, errors, limit)
    assert smoothest is not None
    assert limited is not None
    assert largest_acceleration(smoothest) > 10.05
    assert largest_acceleration(limited) <= limit[0]
    assert is_within(limited, trajectory, errors)


def test_the_curve_keeps_a_torque_limit_that_couples_joints() -> None:
    one = ramp(10.0, 500.0)
    assert one.dq is not None
    q, dq = (np.hstack([x, 0.5 * x]) for x in (one.q, one.dq))
    trajectory = Trajectory(one.t, q, dq)
    errors = errors_of(trajectory, None, None)
    mass = np.array([[1.0, 0.4], [0.4, 0.5]])

    def torques(q: Array, dq: Array, ddq: Array) -> Array:
        return np.asarray(ddq @ mass)

    # 10 + 0.4 * 5 and 0.4 * 10 + 0.5 * 5, with a tolerance
    limit = np.array([12.0, 6.5]) * 1.004
    free = np.array([100.0, 100.0])
    largest = []
    for bounds in (None, TorqueBounds(torques, limit)):
        curve = limited_witness(trajectory, errors, free, bounds)
        assert curve is not None
        assert is_within(curve, trajectory, errors)
        ddq = curve.evaluate(FINE, jerk=False).ddq.T
        largest.append(float((np.abs(ddq @ mass) / limit).max()))
    assert largest[0] > 1.001
    assert largest[1] <= 1


def test_no_curve_keeps_a_limit_below_the_mean_acceleration() -> None:
    trajectory = ramp(10.0, 500.0)
    errors = errors_of(trajectory, None, None)
    assert limited_witness(trajectory, errors, np.array([9.9])) is None
    assert limited_witness(trajectory, errors, np.array([np.inf])) is None


def test_a_plan_in_float32_is_shown_valid() -> None:
    plan = load("transport")
    sampled = sample_plan(plan.motion, 500.0)
    values = [
        array[:-1].astype(np.float32).astype(float)
        for array in (np.arange(len(sampled.t)) / 500, sampled.q, sampled.dq)
    ]
    trajectory = Trajectory(*values)
    errors = errors_of(trajectory, None, None)
    judge = FamilyJudge(plan.problem, plan.robot)
    limit = acceleration_limits(judge.limits(None), 0.98).acceleration
    curve = limited_witness(trajectory, errors, limit)
    assert curve is not None
    assert is_within(curve, trajectory, errors)
    assert cnpgen.evaluate_trajectories(plan.problem, [trajectory]).valid.all()
