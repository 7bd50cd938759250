"""Samples without a stated interpolation: errors are bounded, valid plans are valid, and no decision is wrong."""

from dataclasses import replace

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.trajectories.resolved_curves import is_resolved, resolved_curves
from cnpgen.addons.trajectories.smooth_curve import (
    AccelerationLimits,
    estimated_derivative,
    smooth_curve,
)
from cnpgen.errors import UsageError
from cnpgen.plans.exporter import sample_plan
from cnpgen.problems.constraints.joint import JointAcceleration
from cnpgen.trajectories import Decision, Trajectory
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.plan_files import plans_of
from tests.examples.plans import PROBLEMS, load
from tests.refusals import is_refused

RATES = np.array([3.0, 5.0])
LABELS = ("hit", "replan", "transport")
SAMPLINGS = [(100, 1), (30, 1), (30, 2), (30, 0), (100, 0), (500, 2)]


def wave(times: np.ndarray, order: int = 0) -> np.ndarray:
    """Return derivatives of a motion of two joints, shape (K, 2)."""
    return np.asarray(
        RATES**order * np.sin(RATES * times[:, None] + 0.3 + order * np.pi / 2)
    )


def sampled(motion: Motion, rate: float, orders: int) -> Trajectory:
    plan = sample_plan(motion, rate)
    return Trajectory(plan.t, *(plan.q, plan.dq, plan.ddq)[: orders + 1])


@pytest.mark.parametrize("orders", [1, 2])
def test_the_smooth_curve_leads_through_the_samples_within_the_limits(
    orders: int,
) -> None:
    times = (
        np.cumsum(
            np.concatenate([[0.0], np.random.default_rng(0).uniform(0.5, 1.5, 60)])
        )
        * 0.01
    )
    trajectory = Trajectory(times, *(wave(times, order) for order in range(orders + 1)))
    limits = AccelerationLimits(
        1.01 * np.abs(wave(times, 2)).max(axis=0), np.full(2, np.inf)
    )
    curve = smooth_curve(trajectory, limits)
    assert curve is not None
    states = curve.evaluate(times / times[-1], jerk=False)
    for order, values in enumerate((states.q, states.dq, states.ddq)[: orders + 1]):
        assert np.allclose(values.T, wave(times, order), atol=1e-9), order
    s = np.linspace(0, 1, 3000)
    states = curve.evaluate(s, jerk=False)
    assert np.allclose(states.ddq.T, wave(s * times[-1], 2), atol=5e-3)
    assert (np.abs(states.ddq.max(axis=1)) <= limits.acceleration * (1 + 1e-9)).all()


def test_accelerations_that_jump_at_an_end_stay_within_the_limits() -> None:
    fine = np.linspace(0, 0.3, 300_001)
    acceleration = 10 * np.minimum(fine / 1e-3, 1)  # a jump within a tenth of a span
    velocity = np.concatenate(
        [[0.0], np.cumsum((acceleration[1:] + acceleration[:-1]) / 2) * fine[1]]
    )
    position = np.concatenate(
        [[0.0], np.cumsum((velocity[1:] + velocity[:-1]) / 2) * fine[1]]
    )
    chosen = slice(None, None, 10_000)
    trajectory = Trajectory(
        fine[chosen], position[chosen, None], velocity[chosen, None]
    )
    s = np.linspace(0, 1, 20_000)
    limits = AccelerationLimits(np.array([10.02]), np.array([np.inf]))
    curve = smooth_curve(trajectory, limits)
    assert curve is not None
    assert np.abs(curve.evaluate(s, jerk=False).ddq).max() <= 10.02 + 1e-6
    cubic = cnpgen.trajectories.Trajectory(trajectory.t, trajectory.q, trajectory.dq)
    assert np.abs(cubic.states(s * 0.3)[2]).max() > 10.3, (
        "the cubic curve violates the limit"
    )
    assert (
        smooth_curve(
            trajectory, AccelerationLimits(np.array([9.5]), np.array([np.inf]))
        )
        is None
    )


def test_a_jerk_limit_holds_at_the_ends() -> None:
    times = np.linspace(0, 0.5, 51)
    trajectory = Trajectory(times, wave(times), wave(times, 1))
    limits = AccelerationLimits(np.full(2, 30.0), 1.02 * RATES**3)
    curve = smooth_curve(trajectory, limits)
    assert curve is not None
    jerk = curve.evaluate(np.linspace(0, 1, 5000), jerk=True).jerk
    assert jerk is not None
    assert (np.abs(jerk).max(axis=1) <= 1.03 * RATES**3).all()


def test_derivatives_are_estimated_from_neighbors() -> None:
    times = (
        np.cumsum(
            np.concatenate([[0.0], np.random.default_rng(1).uniform(0.5, 1.5, 60)])
        )
        * 0.02
    )
    trajectory = Trajectory(times, wave(times), wave(times, 1))
    errors = [
        np.abs(estimated_derivative(trajectory, 2, count) - wave(times, 2)).max()
        for count in (3, 5)
    ]
    assert errors[1] < 1e-6
    assert errors[0] > 100 * errors[1]


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize(("rate", "orders"), SAMPLINGS)
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_plan_stays_within_the_resolved_curves(
    label: str, rate: float, orders: int, noise: float
) -> None:
    plans, random = plans_of(load(label)), np.random.default_rng(2)
    exact = sampled(plans.motion, rate, orders)
    parts = [part for part in (exact.q, exact.dq, exact.ddq) if part is not None]
    noisy = Trajectory(
        exact.t, *(part + noise * random.uniform(-1, 1, part.shape) for part in parts)
    )
    limit = np.abs(
        plans.motion.at_times(np.linspace(0, exact.t[-1], 5000)[None]).ddq[0]
    ).max(axis=0)
    family = resolved_curves(noisy, np.full(3, noise), limit)
    t = np.linspace(0, exact.t[-1], 2000)
    states, truth = (
        family.evaluate(t / t[-1], jerk=False),
        plans.motion.at_times(t[None]),
    )
    for name, bound in zip(
        ("q", "dq", "ddq"), family.bounds_at(t / t[-1]), strict=False
    ):
        error = np.abs(getattr(states, name) - getattr(truth, name)[0].T)
        assert (error <= bound + 1e-9).all(), name


def test_slow_samples_do_not_resolve_a_fast_motion() -> None:
    motion = plans_of(load("hit")).motion
    limit = np.full(motion.path.shape[2], 20.0)
    assert is_resolved(sampled(motion, 200, 1), limit)
    assert not is_resolved(sampled(motion, 20, 1), limit)
    assert not is_resolved(sampled(motion, 200, 0), limit)


@pytest.mark.parametrize("label", ["hit", "transport"])
@pytest.mark.parametrize(("rate", "orders"), [(100, 1), (500, 1), (500, 2)])
def test_a_valid_plan_is_valid_from_its_samples(
    label: str, rate: float, orders: int
) -> None:
    plans = plans_of(load(label))
    (verdict,) = cnpgen.evaluate_trajectories(
        plans.problem, [sampled(plans.motion, rate, orders)]
    ).verdicts
    assert verdict.valid, verdict


@pytest.mark.parametrize("label", ["hit", "transport"])
@pytest.mark.parametrize("rate", [100, 30])
def test_a_plan_that_is_too_fast_is_never_valid(label: str, rate: float) -> None:
    plans = plans_of(load(label))
    for name, power in (("joint velocity", 1), ("joint acceleration", 2)):
        margin = cnpgen.evaluate_plans(plans, workers=1).verdicts[0].margins[name]
        wanted = 1 + margin.tolerance / abs(margin.bound) + 0.01
        fast = plans.motion.time_scaled(
            (abs(margin.value / margin.bound) / wanted) ** (1 / power)
        )
        for orders in (0, 1, 2):
            (verdict,) = cnpgen.evaluate_trajectories(
                plans.problem, [sampled(fast, rate, orders)]
            ).verdicts
            assert verdict.decision != Decision.VALID, (name, orders)
            if verdict.decision == Decision.UNDECIDED:
                assert verdict.conditions[name].decision != Decision.VALID, orders


def test_a_velocity_between_positions_that_a_line_hides_is_undecided() -> None:
    plans = plans_of(load("hit"))
    without = [
        each
        for each in PROBLEMS["airhockey"].constraint
        if not isinstance(each, JointAcceleration)
    ]
    problem = replace(PROBLEMS["airhockey"], constraint=tuple(without))
    margin = (
        cnpgen.evaluate_plans(plans, workers=1).verdicts[0].margins["joint velocity"]
    )
    limit, joint, t = (
        abs(margin.bound),
        plans.problem.joint_names.index(margin.part),
        0.01 * np.arange(21.0),
    )
    decisions = []
    for mean in (
        0.84,
        0.82,
    ):  # of the limit: the velocity rises to 101 % and to 99 %, lines to at most 100 %
        q = np.repeat(plans.boundary.start_q[:1], len(t), axis=0)
        q[:, joint] = limit * (
            mean * (t - 0.1) + 0.17 * np.sin(40 * np.pi * t) / (40 * np.pi)
        )
        trajectory = Trajectory(t, q)
        for interpolation in (None, "linear"):
            found = cnpgen.evaluate_trajectories(
                problem, [trajectory], noise=0, interpolation=interpolation
            )
            decisions.append(found.verdicts[0].conditions["joint velocity"])
    hidden, line, *slower = decisions
    assert hidden.decision == Decision.UNDECIDED
    assert abs(hidden.margin.value) == pytest.approx(1.01 * limit, rel=2e-3)
    assert 0 < hidden.undecided_share < 1
    assert hidden.uncertainty > hidden.margin.violation
    assert {entry.decision for entry in (line, *slower)} == {Decision.VALID}


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize(
    ("rate", "orders", "noise"),
    [(30, 0, 0.0), (30, 1, 5e-5), (30, 2, 1e-3), (100, 1, 5e-5)],
)
def test_coarse_or_noisy_samples_give_no_wrong_decision(
    label: str, rate: float, orders: int, noise: float
) -> None:
    plans, random = plans_of(load(label)), np.random.default_rng(3)
    exact = sampled(plans.motion, rate, orders)
    parts = [part for part in (exact.q, exact.dq, exact.ddq) if part is not None]
    noisy = Trajectory(
        exact.t, *(part + noise * random.uniform(-1, 1, part.shape) for part in parts)
    )
    (verdict,) = cnpgen.evaluate_trajectories(
        plans.problem, [noisy], noise=noise
    ).verdicts
    truth = cnpgen.evaluate_plans(plans, workers=1).verdicts[0].margins
    for name, entry in verdict.conditions.items():
        assert entry.decision != (
            Decision.INVALID if truth[name].ok else Decision.VALID
        ), name


def test_an_estimate_needs_velocities() -> None:
    with is_refused(UsageError):
        estimated_derivative(Trajectory(np.arange(3.0), np.zeros((3, 1))), 2, 3)
