"""Stops of a planner in C: on the path, within the limits by Pinocchio, and as early as a search in Python finds them."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.trajectory.spline_motion import Motion
from tests.addons.deploy.compiled_planner import (
    CompiledPlanner,
    compiled_planner,
    needs_compiler,
)
from tests.addons.deploy.test_export_planner import VALID, requests_of

pytestmark = needs_compiler
ROWS = 12
COUNT = 101
DELAYS_S = np.array([0.0, 0.02, 0.05, 0.1, 0.15])
TOLERANCES = (
    0.002,
    0.005,
    0.005,
)  # of the limits of dq, ddq and torque, as in the problem


@pytest.fixture(scope="module")
def compiled(tmp_path_factory) -> CompiledPlanner:
    return compiled_planner("airhockey-hit", tmp_path_factory.mktemp("stops"), "-O1")


@pytest.fixture(scope="module")
def hits() -> Planner:
    return Planner("airhockey-hit")


@pytest.fixture(scope="module")
def valid(compiled, hits) -> list[tuple[np.ndarray, Motion]]:
    """Requests of valid motions, and these motions."""
    boundary = draw_boundary_problems("airhockey-hit", ROWS, seed=6).boundary
    requests, motion = requests_of(boundary), hits.plan_batch(boundary).motion
    rows = np.flatnonzero(compiled.plan(requests).code == VALID)
    return [(requests[row], motion[[row]]) for row in rows]


def law(motion: Motion, begin: float, braking: float, times: np.ndarray) -> list:
    """States of a stop from those of the motion: dq = q' u and ddq = q'' u^2 + q' du/dt."""
    x = np.clip((times - begin) / braking, 0, 1)
    sigma = np.where(times < begin, times, begin + braking * (x - x**3 + x**4 / 2))
    states = motion.at_times(np.minimum(sigma, motion.duration()[0]))
    u, w = (1 - 3 * x**2 + 2 * x**3)[:, None], (-6 * x * (1 - x) / braking)[:, None]
    q, dq, ddq = states.q[0], states.dq[0], states.ddq[0]
    return [q, dq * u, ddq * u**2 + dq * w]


def use_of_limits(planner: Planner, q, dq, ddq) -> float:
    """Largest use of a limit, with torques by Pinocchio; 1 is a limit with its tolerance."""
    robot = planner.robot
    model, data = robot.model, robot.model.createData()
    torque = np.array(
        [pin.rnea(model, data, *state) for state in zip(q, dq, ddq, strict=True)]
    )
    limits = robot.velocity_limit, robot.acceleration_limit, robot.torque_limit
    return max(
        float((np.abs(values) / (limit * (1 + tolerance))).max())
        for values, limit, tolerance in zip(
            (dq, ddq, torque), limits, TOLERANCES, strict=True
        )
    )


def test_a_stop_is_on_the_path_and_ends_at_rest(compiled, valid):
    found = 0
    for request, motion in valid:
        time = 0.4 * float(motion.duration()[0])
        stop = compiled.stop(request, time, COUNT)
        if not stop.exists:
            continue
        found += 1
        q, dq, ddq = law(motion, stop.begin, stop.braking_time, stop.times)
        np.testing.assert_allclose(stop.q, q, rtol=0, atol=1e-6)
        np.testing.assert_allclose(stop.dq, dq, rtol=0, atol=1e-5)
        np.testing.assert_allclose(stop.ddq, ddq, rtol=0, atol=2e-3)
        assert not stop.dq[-1].any()
        assert not stop.ddq[-1].any()
        assert stop.moves[:-1].all()
        assert not stop.moves[-1]
        assert stop.begin + stop.braking_time < motion.duration()[0]
    assert found >= 3


def test_a_stop_is_within_the_limits_by_pinocchio(compiled, hits, valid):
    for request, motion in valid:
        stop = compiled.stop(request, 0.4 * float(motion.duration()[0]), COUNT)
        braking = stop.times >= stop.begin
        if stop.exists:
            states = (values[braking] for values in (stop.q, stop.dq, stop.ddq))
            assert use_of_limits(hits, *states) < 1.002  # the check has 40 times


@pytest.mark.slow
def test_no_stop_of_the_family_is_earlier(compiled, hits, valid):
    """Python tries braking times in steps of 2 ms."""
    for request, motion in valid[:4]:
        duration = float(motion.duration()[0])
        time, ends = 0.4 * duration, [duration]
        for begin in time + DELAYS_S:
            for braking in np.arange(4e-3, min(2 * (duration - begin), 1.5), 2e-3):
                if begin + braking >= min(ends):
                    break
                times = np.linspace(begin, begin + braking, 40)
                if use_of_limits(hits, *law(motion, begin, braking, times)) <= 1:
                    ends.append(begin + braking)
        stop = compiled.stop(request, time, 3)
        assert stop.exists == (min(ends) < duration)
        assert stop.begin + stop.braking_time == pytest.approx(min(ends), abs=4e-3)


@pytest.mark.parametrize("time", [-0.1, np.nan, np.inf, 99.0])
def test_there_is_no_stop_outside_of_the_motion(compiled, valid, time):
    stop = compiled.stop(valid[0][0], time, 2)
    assert not stop.exists
    assert stop.braking_time == 0


def test_the_source_of_stops_is_part_of_the_planner(compiled):
    header = (Path(compiled.folder) / "airhockey_hit.h").read_text()
    assert "airhockey_hit_find_stop" in header
    assert "@" not in header
