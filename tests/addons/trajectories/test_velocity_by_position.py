"""Velocity limits that depend on the position: never false on motions at the limit, proven beyond it, and a constraint."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

import cnpgen
from cnpgen.addons.trajectories.arm_registry import find_arm
from cnpgen.addons.trajectories.episode_checks import Level, Scale, check_episode
from cnpgen.addons.trajectories.episode_files import Episode
from cnpgen.addons.trajectories.velocity_by_position import (
    MIN_SHARE,
    VelocityByPosition,
    span_limits,
)
from cnpgen.errors import RecipeError
from cnpgen.problems.problem_file import load_problem
from cnpgen.trajectories import Decision, Trajectory
from tests.examples.chains import chain
from tests.problems.test_constraints import Bench, values
from tests.refusals import is_refused

FPS, NOISE = 30, 1e-3
BY_POSITION = """[[constraint]]
use = "velocity-by-position"
slope = "6 rad/s^2"
offset = [0.3, 0.2]
ends = [[-3.05, 3.05], [-2.5, 3.05]]
tolerance = "0.01 rad/s"
"""


def published_limit(joint: int, q: float) -> float:
    """Return Franka's largest velocity of the FR3's joint, as libfranka computes it."""
    s, o, _, end = find_arm("fr3").limits["velocity"].by_position[:, joint]
    largest = find_arm("fr3").limits["velocity"].upper[joint]
    return min(largest, max(0.0, -o + np.sqrt(max(0.0, s * (end - q)))))


def test_the_limits_of_the_fr3_are_the_published_ones() -> None:
    # -0.30 + sqrt(12.0 (2.75010 - q)) and 0.35 - sqrt(11.0 (-0.54092 + q)), evaluated by hand.
    limit = find_arm("fr3").limits["velocity"]
    q = np.tile([[2.5], [2.5 + 1e-7]], (1, 7))
    _, upper = span_limits(q, 1, 0.0, limit.by_position, limit.upper)
    assert upper[0, 0] == pytest.approx(-0.30 + np.sqrt(12.0 * 0.2501), abs=1e-6)
    lower, _ = span_limits(q[::-1] - 1.8, 1, 0.0, limit.by_position, limit.upper)
    assert lower[0, 5] == pytest.approx(0.35 - np.sqrt(11.0 * 0.15908), abs=1e-6)
    middle = span_limits(np.zeros((2, 7)), 1, 0.0, limit.by_position, limit.upper)
    assert np.array_equal(middle[1][0], limit.upper)


@pytest.mark.parametrize(("begin", "end"), [(-1.0, 2.0), (1.9, 2.6), (2.6, 2.745)])
def test_the_mean_is_that_of_the_numerical_integral(begin: float, end: float) -> None:
    limit = find_arm("fr3").limits["velocity"]
    least = MIN_SHARE * limit.upper[0]
    time, _ = quad(
        lambda q: 1 / max(published_limit(0, q), least), begin, end, limit=500
    )
    q = np.tile([[begin], [end]], (1, 7))
    _, upper = span_limits(q, 1, 0.0, limit.by_position, limit.upper)
    assert upper[0, 0] == pytest.approx((end - begin) / time, rel=1e-6)


def towards_the_end(speed: float, joint: int, sign: int) -> np.ndarray:
    """Return frames of a joint that goes to an end of its range at a share of its limit everywhere."""
    arm = find_arm("fr3")
    position, low_high = arm.limits["position"], arm.limits["velocity"].by_position[2:]
    middle = (position.lower + position.upper) / 2
    q, found, fine = float(middle[joint]), [], 2000
    # Towards the lower end, the limit is that of the mirrored joint.
    mirror = low_high[:, joint].sum()
    for step in range(6 * fine):
        if step % (fine // FPS) == 0:
            found.append(q)
        at = q if sign > 0 else mirror - q
        q += sign * speed * published_limit(joint, at) / fine
        q = float(np.clip(q, position.lower[joint], position.upper[joint]))
    frames = np.tile(middle, (len(found), 1))
    frames[:, joint] = found
    return frames


def checked(frames: np.ndarray) -> tuple[Level, list[str]]:
    arm, t = find_arm("fr3"), np.arange(len(frames)) * (2000 // FPS) / 2000
    index = np.arange(len(t))
    episode = Episode("0", t, frames, None, arm.joints, index, len(t))
    report = check_episode(
        episode, arm, Scale(tuple(range(7)), np.ones(7)), noise=NOISE, jitter=0.0
    )
    return report.level, [str(each) for each in report.findings]


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("sign", [-1, 1])
def test_motions_at_the_limit_pass_and_faster_ones_are_excluded(
    joint: int, sign: int
) -> None:
    random = np.random.default_rng(joint)
    frames = towards_the_end(0.999, joint, sign)
    noisy = frames + NOISE * random.uniform(-1, 1, frames.shape)
    level, findings = checked(noisy)
    # Accelerations change at once where the limit begins to fall: for review at most.
    assert level != Level.EXCLUDE, findings
    assert not [each for each in findings if "rad/s at" in each]
    fast = towards_the_end(1.25, joint, sign)
    # The constant limit alone proves nothing about the second part of the way.
    start = (
        np.abs(np.diff(fast[:, joint])) * FPS
        < 0.95 * find_arm("fr3").limits["velocity"].upper[joint]
    )
    level, findings = checked(fast[int(np.flatnonzero(start)[0]) :])
    assert level == Level.EXCLUDE
    assert any("at these positions" in each for each in findings)


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    """The file of an arm of two joints whose velocities the position limits."""
    chain(tmp_path, 2, jerk=False)
    path = tmp_path / "problem.toml"
    path.write_text(path.read_text() + BY_POSITION)
    return path


def test_both_forms_of_the_constraint_are_the_formula(problem: Path) -> None:
    bench = Bench(load_problem(str(problem)))
    constraint = bench.problem.constraint[-1]
    assert type(constraint) is VelocityByPosition
    function, _ = bench.symbolic(constraint)
    random = np.random.default_rng(0)
    for _ in range(20):
        q, dq = random.uniform(-3.2, 3.2, 2), random.uniform(-2, 2, 2)
        distances = [q[0] + 3.05, q[1] + 2.5, 3.05 - q[0], 3.05 - q[1]]
        limits = [
            max(0.0, np.sqrt(max(0.0, 6 * x)) - o)
            for x, o in zip(distances, [0.3, 0.2, 0.3, 0.2], strict=True)
        ]
        expected = pytest.approx(np.concatenate([-dq, dq]) - limits, abs=1e-12)
        assert values(constraint.measured(bench.state(q, dq))) == expected
        found = function(q, dq, np.zeros(2), [])[0].full()
        assert found[:, 0] == expected
    with is_refused(RecipeError):
        constraint.by_position(3)


@pytest.mark.parametrize(("share", "decision"), [(0.7, "valid"), (1.3, "invalid")])
def test_samples_near_an_end_are_judged_by_the_constraint(
    share: float, decision: str, problem: Path
) -> None:
    at, fine, rows = 2.5, 1000, []
    for step in range(360):
        if step % 20 == 0:
            rows.append([at, 0.0])
        at += share * (np.sqrt(6 * (3.05 - at)) - 0.3) / fine
    t, q = np.arange(len(rows)) / 50, np.array(rows)
    found = cnpgen.evaluate_trajectories(
        str(problem), [Trajectory(t, q)], noise=1e-5, workers=1
    )
    verdict = found.verdicts[0]
    assert verdict.decision == decision, str(verdict)
    if decision == Decision.INVALID:
        assert verdict.reason == VelocityByPosition.reason
        assert "joint velocity by position" in verdict.conditions
        assert "at least" in verdict.detail


@pytest.mark.slow
def test_planned_motions_meet_the_constraint(problem: Path) -> None:
    ends = np.array([[0.0, 2.6]]), np.array([[2.9, -2.3]])
    still = np.zeros((1, 2))
    spec = load_problem(str(problem)).trajectory
    unplanned = cnpgen.make_plans(
        str(problem),
        cnpgen.Boundary(ends[0], still, still, ends[1], still),
        path_control_points=np.full((1, spec.path_control_points, 2), np.nan),
        rate_control_points=np.full((1, spec.rate_control_points), np.nan),
    )
    solved = cnpgen.solve_plans(unplanned, workers=1)
    assert solved.valid.all()
    states = solved.plans.motion.at_times(
        np.linspace(0, float(solved.plans.duration[0]), 2000)[None]
    )
    q, dq = states.q[0], states.dq[0]
    limit = np.sqrt(np.maximum(6 * (3.05 - q), 0)) - [0.3, 0.2]
    excess = (dq - limit)[dq > 0.05].max()
    assert -0.1 < excess <= 0.011  # the limit is used, and kept
    without = problem.with_name("without.toml")
    text = problem.read_text().replace(BY_POSITION, "")
    without.write_text(text)
    # Without the constraint, the motion is faster than the limit near its end.
    solved = cnpgen.solve_plans(
        cnpgen.make_plans(
            str(without),
            unplanned.boundary,
            path_control_points=unplanned.path_control_points,
            rate_control_points=unplanned.rate_control_points,
        ),
        workers=1,
    )
    states = solved.plans.motion.at_times(
        np.linspace(0, float(solved.plans.duration[0]), 2000)[None]
    )
    limit = np.sqrt(np.maximum(6 * (3.05 - states.q[0]), 0)) - [0.3, 0.2]
    assert (states.dq[0] - limit)[states.dq[0] > 0.05].max() > 0.1
