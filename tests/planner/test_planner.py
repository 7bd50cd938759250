"""The planner: exact boundary conditions, single plans and batches, continuous replanning, and errors."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.format import PlanStatus
from cnpgen.plans.join import join_plans
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.robots.plausible_values import UnitError
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import columns_of, some
from tests.examples.example_robots import needs_robots
from tests.examples.models import boundary_of_columns, untrained_model
from tests.refusals import is_refused


@pytest.fixture(scope="module")
def rows(tiny) -> Boundary:
    return boundary_of_columns(columns_of(tiny("airhockey-replan")), 40)


@pytest.fixture(scope="module")
def planner(rows) -> Planner:
    return Planner(untrained_model("airhockey", rows))


def planned(planner: Planner, rows: Boundary):
    return planner.plan(
        rows.start_q,
        rows.goal_q,
        start_dq=rows.start_dq,
        start_ddq=rows.start_ddq,
        goal_dq=rows.goal_dq,
    )


def test_plans_meet_their_boundary_conditions_by_the_independent_verdict(planner, rows):
    verdicts = evaluate_plans(planned(planner, rows), workers=1).verdicts
    for verdict in verdicts:
        for name in ("boundary position", "boundary velocity", "boundary acceleration"):
            assert verdict.margins[name].violation < 1e-9


def test_a_plan_is_the_same_alone_and_in_a_batch(planner, rows):
    many = planned(planner, rows)
    assert len(many) == 40
    assert (many.status == PlanStatus.UNKNOWN).all()
    for i in (0, 7, 39):
        one = planned(planner, rows[i])
        assert len(one) == 1
        np.testing.assert_allclose(
            one.path_control_points[0], many.path_control_points[i], atol=1e-5
        )
        np.testing.assert_allclose(
            one.rate_control_points[0], many.rate_control_points[i], rtol=1e-5
        )


def test_plans_that_the_model_determines_have_all_fields_and_pass_the_checks(
    planner, rows
):
    plan = planned(planner, rows[0])
    assert list(vars(plan)) == list(vars(replace(plan)))


def test_missing_velocities_and_accelerations_are_zero(planner, rows):
    given = planner.plan(rows.start_q[0], rows.goal_q[0])
    np.testing.assert_array_equal(given.boundary.start_dq, 0)
    np.testing.assert_array_equal(given.boundary.goal_dq, 0)
    q, dq, ddq = given.states_at(0.0)
    np.testing.assert_allclose(q[0], rows.start_q[0], atol=1e-12)
    np.testing.assert_allclose(dq[0], 0, atol=1e-12)
    np.testing.assert_allclose(ddq[0], 0, atol=1e-9)


def test_tip_positions_are_those_of_pinocchio(planner, rows):
    plans = planned(planner, rows)
    for end, q in (("start", rows.start_q), ("goal", rows.goal_q)):
        np.testing.assert_allclose(
            plans.columns[f"{end}_xyz"], plans.problem.tip_positions(q), atol=1e-12
        )


@pytest.mark.parametrize("part", some([0.1, 0.6, 0.9, 0.99], 1, "slow"))
def test_replanning_to_an_unchanged_goal_never_takes_longer_than_the_remaining_trajectory(
    part,
):
    planner, rows = (
        Planner("airhockey-replan"),
        draw_boundary_problems("airhockey-replan", 8, seed=21).boundary,
    )
    old = refine_plans(planner.plan_batch(rows), workers=1).plans
    left = (1 - part) * old.duration
    new = planner.replan(
        old, part * old.duration, goal_q=rows.goal_q, goal_dq=rows.goal_dq
    )
    assert (new.duration <= left * (1 + 1e-12)).all()
    assert evaluate_plans(new, workers=1).valid.all()
    alone = planner.plan_batch(new.boundary)
    reused = alone.duration >= 0.98 * left
    assert reused.any()
    np.testing.assert_allclose(new.duration[~reused], alone.duration[~reused])
    states, times = old.motion.at_times, np.linspace(0, 1, 50) * left[:, None]
    np.testing.assert_allclose(
        new.motion.at_times(times).q[reused],
        states(times + part * old.duration[:, None]).q[reused],
        atol=1e-4,
    )


def test_a_changed_goal_is_planned_by_the_network_alone(planner, rows):
    old = planned(planner, rows)
    when = 0.9 * old.duration
    for shift in (1e-6, 0.1):
        new = planner.replan(
            old, when, goal_q=rows.goal_q + shift, goal_dq=rows.goal_dq
        )
        np.testing.assert_array_equal(
            new.path_control_points,
            planner.plan_batch(new.boundary).path_control_points,
        )


def test_one_plan_can_be_replanned_to_several_goals_including_its_own(planner, rows):
    old = planned(planner, rows)[:1]
    new = planner.replan(
        old, 0.5 * old.duration, goal_q=rows.goal_q[:3], goal_dq=rows.goal_dq[:3]
    )
    assert len(new) == 3
    for row, each in enumerate(new[[k]] for k in range(3)):
        alone = planner.replan(
            old, 0.5 * old.duration, goal_q=rows.goal_q[row], goal_dq=rows.goal_dq[row]
        )
        np.testing.assert_allclose(each.duration, alone.duration, rtol=1e-7)


def test_replanning_rejects_plans_of_other_types_and_problems(planner, rows):
    old, goal = planned(planner, rows), {"goal_q": rows.goal_q, "goal_dq": rows.goal_dq}
    with is_refused(UsageError, argument="plans"):
        planner.replan(rows, 0.1, **goal)
    joined = join_plans(
        old, planner.replan(old, 0.5 * old.duration, **goal), at=0.5 * old.duration
    )
    with is_refused(UsageError, argument="plans"):
        planner.replan(joined, 0.1, **goal)
    with is_refused(UsageError, argument="plans"):
        planner.replan(draw_boundary_problems("heavy-object", 2, seed=1), 0.0, **goal)
    with is_refused(UsageError, argument="goal_q") as caught:
        planner.replan(old, 0.0, goal_q=1e4 * rows.goal_q)
    assert caught.value.argument == "goal_q"


def test_replanning_is_continuous_in_position_velocity_and_acceleration(planner, rows):
    old = planned(planner, rows)
    when = 0.4 * old.duration
    new = planner.replan(
        old, when, goal_q=rows.goal_q[::-1], goal_dq=rows.goal_dq[::-1]
    )
    before, after = old.states_at(when), new.states_at(0.0)
    for found, expected, scale in zip(after, before, (1, 1, 100), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-11 * scale)
    assert (np.abs(before[1]).max(axis=1) > 0.05).all()  # it was moving
    np.testing.assert_array_equal(new.boundary.goal_q, rows.goal_q[::-1])
    arrived = new.states_at(new.duration)
    np.testing.assert_allclose(arrived[0], rows.goal_q[::-1], atol=1e-9)
    np.testing.assert_allclose(arrived[1], rows.goal_dq[::-1], atol=1e-8)


def test_a_replanned_hit_continues_the_first_motion(planner, rows):
    """Finite differences of positions and velocities across both switches agree with the states."""
    first = planner.plan(rows.start_q[0], rows.goal_q[1])
    second = planner.replan(first, 0.5 * first.duration, goal_q=rows.goal_q[2])
    hit = planner.replan(
        second, 0.5 * second.duration, goal_q=rows.goal_q[3], goal_dq=rows.goal_dq[3]
    )
    h = 1e-6
    for old, new in ((first, second), (second, hit)):
        switch = 0.5 * old.duration[0]
        q0, dq0, ddq0 = old.states_at(switch - h)
        q1, dq1, ddq1 = new.states_at(h)
        np.testing.assert_allclose((q1 - q0) / (2 * h), (dq0 + dq1) / 2, atol=1e-4)
        np.testing.assert_allclose((dq1 - dq0) / (2 * h), (ddq0 + ddq1) / 2, atol=1e-2)


def test_start_and_goal_are_positional_and_velocities_are_keyword_arguments(
    planner, rows
):
    plans = planner.plan(rows.start_q, rows.goal_q)
    np.testing.assert_array_equal(plans.boundary.goal_q, rows.goal_q)
    with is_refused(TypeError):
        planner.plan(rows.start_q)
    with is_refused(TypeError):
        planner.plan(rows.start_q, rows.goal_q, rows.start_dq)


def test_rounding_errors_count_as_rest_so_that_rest_to_rest_plans_can_be_replanned(
    tiny,
):
    """Velocities at the ends of a plan differ from zero by 1e-14: replanning from them must not fail."""
    rest = boundary_of_columns(columns_of(tiny("heavy-object")), 20)
    planner = Planner(untrained_model("heavy-object", rest), backend="numpy")
    plans = planned(planner, rest)
    assert np.abs(plans.states_at(0.0)[2]).max() > 0
    again = planner.replan(plans, 0.0, goal_q=rest.goal_q)
    np.testing.assert_array_equal(again.boundary.start_ddq, 0.0)
    np.testing.assert_allclose(
        again.path_control_points, plans.path_control_points, atol=1e-5
    )
    limit = planner.robot.velocity_limit
    planner.plan(rest.start_q, rest.goal_q, start_dq=0.9e-9 * limit)
    with is_refused(UsageError, argument="start_dq"):
        planner.plan(rest.start_q, rest.goal_q, start_dq=1.1e-9 * limit)
    q, dq, _ = plans.states_at(plans.duration)
    np.testing.assert_allclose(
        planner.plan(q, rest.start_q, start_dq=dq).boundary.start_dq, 0.0, atol=0
    )


def test_a_planner_is_pickled_without_its_kernels(planner, rows):
    other = pickle.loads(
        pickle.dumps(Planner(planner.model, scale_time=False, backend="numpy"))
    )
    found = planned(other, rows).path_control_points
    np.testing.assert_allclose(
        found, planned(planner, rows).path_control_points, atol=1e-5
    )


def test_reprs_of_planners_models_and_plans(planner, rows):
    size = f"{planner.model.architecture.layers} x {planner.model.architecture.hidden}"
    assert repr(planner) == f"<Planner for 'airhockey': a network of {size}>"
    free = "goal_acceleration = 'free'"
    assert repr(planner.model) == f"<Model of 'airhockey': a network of {size}, {free}>"
    plans = planned(planner, rows)
    assert repr(plans) == "<40 plans of 'airhockey': 40 unknown>"
    status = np.array([1, 1, 2], np.uint8)
    assert (
        repr(replace(plans[:3], status=status))
        == "<3 plans of 'airhockey': 2 valid, 1 invalid>"
    )
    assert repr(plans[:0]) == "<0 plans of 'airhockey'>"


@pytest.mark.parametrize("wrong", [5, None, b"airhockey-hit"])
def test_an_invalid_model_argument_raises_an_error_with_its_value(wrong):
    with is_refused(UsageError, argument="model"):
        Planner(wrong)


@pytest.mark.parametrize("time", [[0.1, 0.2], "soon", [[0.1]] * 3])
def test_a_wrong_number_of_times_raises_an_error(planner, rows, time):
    one = planned(planner, rows[:1])
    with is_refused(UsageError, argument="time"):
        planner.replan(one, time, goal_q=rows.goal_q[0])


def test_a_time_outside_of_the_plan_raises_an_error(planner, rows):
    plans = planned(planner, rows)
    with is_refused(UsageError, argument="time"):
        planner.replan(plans, -0.1, goal_q=rows.goal_q)
    with is_refused(UsageError, argument="time"):
        plans.states_at(100.0)
    path, rate = plans.path_control_points * np.nan, plans.rate_control_points * np.nan
    unsolved = replace(plans, path_control_points=path, rate_control_points=rate)
    with is_refused(UsageError, argument="plans"):
        planner.replan(unsolved, 0.1, goal_q=rows.goal_q)


def test_a_rest_to_rest_model_rejects_moving_starts(tiny, rows):
    resting = boundary_of_columns(columns_of(tiny("airhockey-hit")), 20)
    planner = Planner(untrained_model("airhockey", resting))
    with is_refused(UsageError, argument="start_dq"):
        planned(planner, rows)
    assert len(planned(planner, resting)) == 20


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"goal_q": np.zeros(5)},
            r"goal_q must have shape \(6,\) or \(N, 6\), got \(5,\)",
        ),
        ({"goal_q": np.full(6, np.nan)}, "goal_q must be finite, got .* in row 0"),
        ({"goal_q": ["a"] * 6}, "goal_q must be an array of numbers"),
        (
            {"goal_q": np.zeros((3, 6)), "start_dq": np.zeros((2, 6))},
            "start_dq has 2 rows, another .* has 3",
        ),
    ],
)
def test_invalid_boundary_conditions_raise_errors_with_their_name(
    planner, wrong, message
):
    arguments = {"start_q": np.zeros(6), "goal_q": np.ones(6), **wrong}
    with pytest.raises(UsageError, match=message):
        planner.plan(**arguments)


def test_goal_accelerations_raise_an_error_if_the_model_leaves_them_free(planner, rows):
    with is_refused(UsageError, argument="goal_ddq"):
        planner.plan_batch(replace(rows, goal_ddq=np.zeros_like(rows.goal_q)))


def test_no_tasks_give_no_plans(planner, rows):
    assert len(planner.plan_batch(rows[:0])) == 0


@needs_robots
def test_no_tasks_of_a_model_with_corrected_lines_give_no_plans() -> None:
    none = draw_boundary_problems("panda-scenes", 1)[:0]
    poses = {OBSTACLE_POSES: none.columns[OBSTACLE_POSES]}
    assert len(Planner("panda-scenes").plan_batch(none.boundary, columns=poses)) == 0


def test_plans_are_the_same_on_every_backend(planner, rows):
    other = Planner(planner.model, backend="numpy")
    np.testing.assert_allclose(
        planned(other, rows).path_control_points,
        planned(planner, rows).path_control_points,
        atol=1e-5,
    )


def test_values_in_degrees_are_refused(planner, rows):
    start = np.array([0, 40.0, 0, -30, 0, 110])
    message = "start_q must be from .* rad, got 40 rad in plan 0 of joint_2; .* 40 deg = 0.698 rad"
    with pytest.raises(UnitError, match=message) as caught:
        planner.plan(start, rows.goal_q[0])
    assert caught.value.argument == "start_q"
    with is_refused(UnitError, argument="goal_dq"):
        planner.plan(
            rows.start_q[0], rows.goal_q[0], goal_dq=np.array([60.0, 0, 0, 0, 0, 0])
        )
    with pytest.raises(UnitError, match=message):
        planner.plan_batch(replace(rows[:1], start_q=start[None]))
    with pytest.warns(UserWarning, match=message) as warnings:
        planner.plan(start, rows.goal_q[0], allow_large_angles=True)
    assert {Path(each.filename).name for each in warnings} == {
        "test_planner.py"
    }  # the caller's line
