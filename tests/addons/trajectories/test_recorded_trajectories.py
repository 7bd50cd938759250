"""Recorded data: faults are refuted by bounds, rounding is seen, valid motions are shown, and none is refuted."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.trajectories.sample_errors import (
    SampleErrors,
    rounding,
    time_rounding,
)
from cnpgen.addons.trajectories.witness import witness
from cnpgen.cli.main import main
from cnpgen.problems.constraints.joint import JointAcceleration, JointVelocity
from cnpgen.problems.problem import Problem
from cnpgen.trajectories import Decision, Statement, Trajectory
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.plan_files import plans_of
from tests.examples.plans import PROBLEMS, load

HOME = np.array([-0.3, 0.6975, 0, -0.5049, 0, 1.9286])


def sampled(
    motion: Motion, rate: float, *, slow: float = 1.0, noise: float = 0.0
) -> Trajectory:
    """Return samples of a motion that is slowed, with noise of positions and ten times that of velocities."""
    duration = float(motion.duration()[0]) * slow
    t = np.append(np.arange(int(np.floor(duration * rate - 1e-9)) + 1) / rate, duration)
    states, random = motion.at_times((t / slow)[None]), np.random.default_rng(0)
    q = states.q[0] + noise * random.uniform(-1, 1, states.q[0].shape)
    dq = states.dq[0] / slow + 10 * noise * random.uniform(-1, 1, q.shape)
    return Trajectory(t, q, dq)


def verdict_of(problem: Any, trajectory: Trajectory, **options: Any) -> Any:
    (verdict,) = cnpgen.evaluate_trajectories(problem, [trajectory], **options).verdicts
    return verdict


@pytest.mark.parametrize("label", ["hit", "transport"])
@pytest.mark.parametrize("slow", [1.0, 2.0])
@pytest.mark.parametrize("rate", [10, 30, 100, 500])
@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3])
def test_a_valid_motion_is_never_invalid(
    label: str, slow: float, rate: float, noise: float
) -> None:
    plans = plans_of(load(label))
    samples = sampled(plans.motion, rate, slow=slow, noise=noise)
    verdict = verdict_of(plans.problem, samples, noise=(noise, 10 * noise, 0.0))
    assert verdict.decision != Decision.INVALID, verdict


@pytest.mark.parametrize("digits", [4, 5])
def test_rounded_positions_at_1_khz_are_not_invalid(
    digits: int, tmp_path: Path
) -> None:
    plans = plans_of(load("hit"))
    samples = sampled(plans.motion, 1000)
    rounded = Trajectory(samples.t, samples.q.round(digits))
    found = cnpgen.evaluate_trajectories(plans.problem, [rounded])
    assert found.verdicts[0].decision != Decision.INVALID
    assert found.errors[0].q == pytest.approx(0.5 * 10.0**-digits)
    assert f"positions have {digits} decimals" in found.errors[0].source
    exact = verdict_of(plans.problem, rounded, noise=0)
    assert exact.decision == Decision.INVALID  # with --noise 0 they are exact


@pytest.mark.parametrize("name", ["jump", "jump_q", "step", "step_q"])
def test_a_joint_that_starts_or_jumps_within_a_sample_is_invalid(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t = np.arange(251) / 500
    q, dq = np.tile(HOME, (len(t), 1)), np.zeros((len(t), 6))
    if name.startswith("jump"):
        q[:, 0] += 0.5 * np.clip(t - 0.1, 0, 0.3)
        dq[(t >= 0.1) & (t < 0.4), 0] = 0.5
    else:
        q[125:, 0] += 0.05
    heads = ["t", *(f"q{k}" for k in range(1, 7)), *(f"dq{k}" for k in range(1, 7))]
    count = 7 if name.endswith("q") else 13
    table = np.column_stack([t, q, dq])[:, :count]
    path = tmp_path / f"{name}.csv"
    np.savetxt(path, table, delimiter=",", header=",".join(heads[:count]), comments="")
    words = ["evaluate", str(path), "--problem", "airhockey"]
    assert main([*words, "--list"]) == 1
    out = capsys.readouterr().out
    assert "1 invalid" in out
    assert "at least" in out or "at most" in out
    assert "joint_1" in out
    assert "e+06" not in out
    assert main([*words, "--noise", "0", "--json"]) == 1
    (found,) = json.loads(capsys.readouterr().out)["verdicts"]
    assert found["statement"] == "invalid"
    assert found["conditions"]["joint acceleration"]["margin"]["part"] == "joint_1"
    # The mean value theorem: |ddq| >= 0.5 / 0.002, and |dq| >= 0.05 / 0.002.
    value = abs(found["conditions"]["joint acceleration"]["margin"]["value"])
    assert value == pytest.approx(250 if name.startswith("jump") else 12_500)


FAULTS: dict[str, Any] = {
    "aside": lambda t, q, dq: (t, q + 0.05 * (np.arange(len(t)) == 20)[:, None], dq),
    "jump": lambda t, q, dq: (t, q + 0.05 * (np.arange(len(t)) >= 20)[:, None], dq),
    "degrees": lambda t, q, dq: (
        t,
        np.where(np.arange(len(t))[:, None] >= 20, np.degrees(q), q),
        dq,
    ),
    "equal": lambda t, q, dq: (t, q[np.r_[:20, [20] * 9, 29 : len(t)]], dq),
    "dropped": lambda t, q, dq: (t[:-5], np.delete(q, np.s_[20:25], axis=0), dq[:-5]),
    "late": lambda t, q, dq: (
        t + 0.6 * (t[1] - t[0]) * (np.arange(len(t)) == 20),
        q,
        dq,
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("rate", [30, 100])
@pytest.mark.parametrize("noise", [5e-5, 1e-3])
def test_planted_faults_are_proven_invalid(
    fault: str, rate: float, noise: float
) -> None:
    plans = plans_of(load("transport"))
    good = sampled(plans.motion, rate, slow=2.0 if rate > 30 else 1.3, noise=noise)
    t, q, dq = FAULTS[fault](good.t, good.q, good.dq)
    verdict = verdict_of(
        plans.problem, Trajectory(t, q, dq), noise=(noise, 10 * noise, 0)
    )
    assert verdict.statement == Statement.INVALID, verdict
    assert not verdict.assumption
    assert verdict.detail


COLUMNS: dict[str, tuple[Any, str]] = {
    "zero": (lambda dq: 0 * dq, "are 0 while it moves"),
    "degrees": (np.degrees, "are in degrees"),
    "sign": (lambda dq: -dq, "have the opposite sign"),
    "late": (lambda dq: np.concatenate([dq[:1], dq[:-1]]), "are one sample late"),
    "early": (lambda dq: np.concatenate([dq[1:], dq[-1:]]), "are one sample early"),
    "swapped": (lambda dq: np.roll(dq, 1, axis=1), "are in the column of joint"),
}


@pytest.mark.parametrize("name", COLUMNS)
def test_velocities_that_contradict_are_explained(name: str) -> None:
    plans, (change, text) = plans_of(load("hit")), COLUMNS[name]
    good = sampled(plans.motion, 30 if name in {"late", "early"} else 100, slow=2.0)
    bad = Trajectory(good.t, good.q, change(good.dq))
    verdict = verdict_of(plans.problem, bad, noise=1e-6)
    assert verdict.reason == "velocities are not the derivative of the positions"
    assert text in verdict.detail, verdict
    ignored = verdict_of(plans.problem, bad, noise=1e-6, ignore_velocities=True)
    assert ignored.decision != Decision.INVALID


def with_scaled_torques(problem: Problem, factor: float) -> Problem:
    scale = problem.limits.torque_scale * factor
    return replace(problem, limits=replace(problem.limits, torque_scale=scale))


@pytest.mark.parametrize(("rate", "factor"), [(30, 0.4), (100, 0.6), (500, 0.6)])
def test_torques_above_their_limits_are_refuted_from_positions(
    rate: float, factor: float
) -> None:
    plans = plans_of(load("transport"))
    samples = sampled(plans.motion, rate)
    positions = Trajectory(samples.t, samples.q)
    problem = PROBLEMS["heavy-object"]
    true = verdict_of(problem, positions)
    assert true.decision != Decision.INVALID
    verdict = verdict_of(with_scaled_torques(problem, factor), positions)
    assert verdict.statement == Statement.INVALID
    assert "unless a velocity or acceleration limit is exceeded" in verdict.detail
    margin = verdict.conditions["joint torque"].margin
    reached = cnpgen.evaluate_plans(plans, workers=1).verdicts[0]
    assert abs(margin.value) <= abs(reached.margins["joint torque"].value) * 1.05


@pytest.mark.parametrize("noise", [5e-5, 1e-3])
@pytest.mark.parametrize("slow", [1.5, 3.0])
def test_a_valid_motion_is_shown_from_noisy_positions_at_30_hz(
    noise: float, slow: float
) -> None:
    plans = plans_of(load("transport"))
    samples = sampled(plans.motion, 30, slow=slow, noise=noise)
    verdict = verdict_of(plans.problem, Trajectory(samples.t, samples.q), noise=noise)
    if verdict.decision == Decision.UNDECIDED:
        assert "a smooth curve within the errors is not valid" in verdict.detail
    else:
        assert verdict.statement == Statement.EXISTS


@pytest.mark.parametrize("orders", [0, 1, 2])
@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.parametrize("jitter", [0.0, 2e-3])
def test_a_witness_is_within_the_errors_of_all_samples(
    orders: int, noise: float, jitter: float
) -> None:
    random, t = np.random.default_rng(3), np.arange(60) / 30
    rates, late = np.array([2.0, 3.0]), jitter * random.uniform(-1, 1, 60)
    phase = rates * (t + late)[:, None]
    data = [np.sin(phase), rates * np.cos(phase), -(rates**2) * np.sin(phase)]
    given = [
        part + noise * random.uniform(-1, 1, part.shape) for part in data[: orders + 1]
    ]
    samples = Trajectory(t, *given)
    curve = witness(samples, SampleErrors(noise, noise, noise, jitter, ""))
    assert curve is not None
    close = np.zeros(len(t), bool)
    for offset in np.linspace(-1, 1, 41) * jitter:
        s = np.clip((t + offset) / t[-1], 0, 1)
        states = curve.evaluate(s, jerk=False)
        found = [
            np.abs(value.T - part).max(axis=1) <= max(noise, small) * (1 + 1e-6)
            for value, part, small in zip(
                (states.q, states.dq, states.ddq),
                given,
                (2e-9, 2e-7, 2e-5),
                strict=False,
            )
        ]
        close |= np.all(found, axis=0)
    assert close.all()


def test_rounding_is_seen_in_radians_degrees_steps_and_float32() -> None:
    random = np.random.default_rng(0)
    values = np.cumsum(random.uniform(-0.05, 0.06, (200, 3)), axis=0)
    step = 2 * np.pi / 4096
    cases = {
        "4 decimals": (values.round(4), 5e-5),
        "2 decimals of a degree": (np.radians(np.degrees(values).round(2)), 8.7266e-5),
        "steps of 0.00153 rad": (np.round(values / step) * step + 0.1, step / 2),
        "the precision of float32": (
            values.astype(np.float32).astype(float),
            np.spacing(np.float32(np.abs(values).max())) / 2,
        ),
        "": (values, 0.0),
    }
    for text, (rounded, half) in cases.items():
        kind, found = rounding(rounded)
        assert (kind, found) == (text, pytest.approx(half, rel=1e-4)), text
    rounded = values.round(4).astype(np.float32).astype(float)
    assert rounding(rounded)[0] == "4 decimals"
    assert rounding(np.zeros((50, 2))) == ("", 0.0)


def test_times_of_a_grid_are_exact_and_others_are_rounded() -> None:
    t = np.arange(100) / 30
    assert time_rounding(t) == ("", 0.0)
    assert time_rounding(np.arange(100) * 0.002) == ("", 0.0)
    assert time_rounding(t.astype(np.float32).astype(float)) == ("", 0.0)
    assert time_rounding(t.round(3)) == ("3 decimals", pytest.approx(5e-4))
    late = t + np.random.default_rng(0).uniform(0, 1e-3, 100)
    assert time_rounding(late) == ("", 0.0)
    assert time_rounding(late.round(4))[0] == "4 decimals"


def test_jitter_without_a_velocity_limit_decides_nothing() -> None:
    problem = PROBLEMS["airhockey"]
    kinds = JointVelocity, JointAcceleration
    kept = tuple(each for each in problem.constraint if not isinstance(each, kinds))
    free = replace(problem, constraint=kept)
    t = np.arange(60) / 30
    bad = np.tile(HOME, (60, 1)) + np.array([0, 1.0, 0, 0, 0, 0])  # off the table
    verdict = verdict_of(free, Trajectory(t, bad), noise=1e-4, time_jitter=1e-3)
    assert verdict.decision == Decision.UNDECIDED
    assert "jitter" in verdict.reason


def test_the_statement_names_its_assumption() -> None:
    plans = plans_of(load("transport"))
    samples = sampled(plans.motion, 500, slow=2.0)
    verdict = verdict_of(plans.problem, samples, max_jerk=2000)
    assert verdict.assumption == "jerks of at most 2000 rad/s^3"
    assert verdict.statement == Statement.ALL, verdict
    shown = verdict_of(plans.problem, samples)
    assert (shown.statement, shown.assumption) == (Statement.EXISTS, "")
