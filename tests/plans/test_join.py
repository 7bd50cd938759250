"""Joining plans: what is executed goes on without a jump, and what would jump is refused with its size."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.export import export_plans
from cnpgen.plans.format import PlanStatus
from cnpgen.plans.join import join_plans
from cnpgen.plans.plan_file import save_plans
from cnpgen.plans.plans import Plans
from tests.refusals import assert_said, is_refused


def unsolved(plans: Plans) -> Plans:
    return replace(
        plans, path_control_points=np.full_like(plans.path_control_points, np.nan)
    )


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner("airhockey-replan")


@pytest.fixture(scope="module")
def three(planner) -> tuple[Plans, Plans, Plans, np.ndarray, np.ndarray]:
    """Plans, those that take over from them at a time, and those that take over from these at another."""
    goals = draw_boundary_problems("airhockey-replan", 3, seed=3).boundary
    first = planner.plan_batch(goals)
    switch = 0.3 * first.duration
    second = planner.replan(
        first, switch, goal_q=goals.goal_q[::-1], goal_dq=goals.goal_dq[::-1]
    )
    later = 0.5 * second.duration
    third = planner.replan(second, later, goal_q=goals.goal_q, goal_dq=goals.goal_dq)
    return first, second, third, switch, switch + later


def test_what_is_joined_is_each_plan_in_its_time_and_nowhere_jumps(three):
    first, second, third, switch, later = three
    joined = join_plans(join_plans(first, second, at=switch), third, at=later)
    np.testing.assert_allclose(joined.duration, later + third.duration)
    for time, plans, own in (
        (0.5 * switch, first, 0.5 * switch),
        (0.5 * (switch + later), second, 0.5 * (later - switch)),
    ):
        states = joined.motion.at_times(time[:, None])
        for name, expected in zip(
            ("q", "dq", "ddq"), plans.states_at(own), strict=True
        ):
            np.testing.assert_allclose(getattr(states, name)[:, 0], expected, atol=1e-9)
    around = np.stack(
        [switch - 1e-9, switch + 1e-9, later - 1e-9, later + 1e-9], axis=1
    )
    states = joined.motion.at_times(around)
    for values in (states.q, states.dq):
        assert np.abs(np.diff(values, axis=1)[:, [0, 2]]).max() < 1e-6
    assert "3 sequences of 3 plans of 'airhockey'" in repr(joined)


def test_what_follows_a_whole_plan_begins_at_its_end(planner):
    aside = planner.robot.home.copy()
    aside[0] += 0.1
    first = planner.plan(planner.robot.home, aside)
    end = first.states_at(first.duration)
    second = planner.plan(end[0], planner.robot.home, start_dq=end[1], start_ddq=end[2])
    np.testing.assert_allclose(
        join_plans(first, second).duration, first.duration + second.duration
    )


@pytest.mark.parametrize("share", [0.5, 0.95, 0.999])
def test_what_is_left_of_a_plan_can_be_joined_to_it_however_short(planner, share):
    """A control point of a motion of a third of a millisecond is exact to some 1e-5 rad/s^2."""
    goals = draw_boundary_problems("airhockey-replan", 16, seed=5).boundary
    first = planner.plan_batch(goals)
    switch = share * first.duration
    rest = planner.replan(first, switch, goal_q=goals.goal_q, goal_dq=goals.goal_dq)
    assert len(join_plans(first, rest, at=switch)) == 16


def test_a_jump_is_refused_with_its_size_place_and_time(three):
    first, second, _, switch, _ = three
    with is_refused(UsageError, argument="following"):
        join_plans(first, second, at=switch + 1e-6)
    moved = second.path_control_points.copy()
    moved[1, 2] += 1e-8  # the third control point decides the acceleration alone
    with is_refused(UsageError, argument="following"):
        join_plans(first, replace(second, path_control_points=moved), at=switch)
    moved = second.path_control_points.copy()
    moved[2, 0, 0] = np.nan
    with is_refused(UsageError, argument="following"):
        join_plans(first, replace(second, path_control_points=moved), at=switch)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda first, second, at: (first, second[:2], at),
            "3 plans are followed by 2",
        ),
        (
            lambda first, second, at: (first, second, [0.1, 0.2]),
            "at must be one number or one for each of 3 plans",
        ),
        (
            lambda first, second, at: (first, second, 60.0),
            r"plan 0 cannot be cut at 60 s: its last part lasts from 0 to",
        ),
        (
            lambda first, second, at: (first, second, -0.1),
            r"plan 0 cannot be cut at -0.1 s",
        ),
        (lambda first, second, at: (first, "plans.h5", at), "must be Plans"),
        (
            lambda first, second, at: (first, unsolved(second), at),
            "plan 0 has no control points yet",
        ),
        (
            lambda first, second, at: (unsolved(first), second, at),
            "plan 0 has no control points yet",
        ),
    ],
)
def test_what_does_not_fit_together_is_refused(three, change, message):
    first, second, _, switch, _ = three
    one, other, at = change(first, second, switch)
    with pytest.raises(UsageError, match=message):
        join_plans(one, other, at=at)


def test_plans_of_different_problems_are_refused(three):
    first = three[0]
    with is_refused(UsageError, argument="following"):
        join_plans(first, draw_boundary_problems("heavy-object", 3))


def test_a_sequence_is_valid_only_if_all_of_its_plans_are(three):
    first, second, _, switch, _ = three
    valid, invalid, unknown = PlanStatus.VALID, PlanStatus.INVALID, PlanStatus.UNKNOWN
    first = replace(first, status=np.array([valid, valid, valid], np.uint8))
    second = replace(second, status=np.array([valid, invalid, unknown], np.uint8))
    np.testing.assert_array_equal(
        join_plans(first, second, at=switch).status, [valid, invalid, unknown]
    )


def test_a_sequence_is_exported_like_a_plan(three, tmp_path):
    first, second, _, switch, _ = three
    joined = join_plans(first, second, at=switch)
    exported = export_plans(joined, tmp_path / "joined.npz", to="npz", rate=1000.0)
    assert exported.count == 3
    with np.load(tmp_path / "joined.npz") as data:
        t, q, dq = (data[f"plan_00001_{name}"] for name in ("t", "q", "dq"))
    assert t[-1] == pytest.approx(joined.duration[1])
    np.testing.assert_allclose(
        np.diff(q, axis=0)[:-1] / 1e-3, (dq[1:-1] + dq[:-2]) / 2, atol=1e-3
    )  # one smooth motion
    np.testing.assert_allclose(q[-1], second.boundary.goal_q[1], atol=1e-9)


def test_the_command_joins_files_and_refuses_jumps(
    three, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    first, second, _, switch, _ = three
    save_plans("first.h5", first[1])
    save_plans("second.h5", second[1])
    at = repr(float(switch[1]))
    command = ["export", "first.h5", "--to", "csv", "-o", "out", "--join", "second.h5"]
    assert main([*command, "--at", at]) == 0
    rows = list(
        csv.reader(Path("out/plan_00000.csv").read_text(encoding="utf-8").splitlines())
    )
    assert float(rows[-1][0]) == pytest.approx(switch[1] + second.duration[1])
    capsys.readouterr()
    assert main([*command, "--at", "1ms", "--force"]) == 2
    assert_said(capsys.readouterr().err)
    assert main([*command, "--at", "1ms", "--at", "2ms", "--force"]) == 2
    assert_said(capsys.readouterr().err)
