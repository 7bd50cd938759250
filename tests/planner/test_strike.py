"""Strikes: a puck and a target in, a plan out; the same as the pipeline completes and the planner plans."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.make.boundary_problems import draw_boundary_problems
from cnpgen.make.complete import complete
from cnpgen.planner.planner import Planner, states_at
from cnpgen.problems.record import open_problem
from tests.conftest import Arm

PUCKS = np.array([[0.9, 0.1], [1.1, -0.2], [3.0, 0.0], [1.0, 0.3]])  # m; the third is out of reach
TARGET = np.array([2.49, 0.0])  # m


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner("airhockey-replan")


@pytest.fixture(scope="module")
def state(planner) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where plans are on the way: moving, and off the table by what a network leaves."""
    given = draw_boundary_problems("airhockey-replan", 4, seed=11).boundary
    plans = planner.plan_batch(given)
    return states_at(plans, 0.4 * plans.duration)


def test_a_strike_is_what_the_pipeline_completes_and_the_planner_plans(planner, state):
    found = planner.strike(state, PUCKS, TARGET)
    along = (TARGET - PUCKS) / np.linalg.norm(TARGET - PUCKS, axis=1)[:, None]
    task = dict(zip(("start_q", "start_dq", "start_ddq"), state, strict=True))
    angle = np.arctan2(along[:, 1], along[:, 0])
    expected = complete("airhockey-replan", goal_xyz=PUCKS - 0.07 * along, hit_angle=angle, **task)
    assert found.reasons == expected.reasons
    np.testing.assert_array_equal(found.plans.sample_id, [0, 1, 3])
    for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq"):
        ours, theirs = getattr(found.plans.boundary, name), getattr(expected.plans.boundary, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12, err_msg=name)
    planned = planner.plan_batch(expected.plans.boundary)
    np.testing.assert_allclose(found.plans.path_control_points, planned.path_control_points, atol=1e-9)
    np.testing.assert_allclose(found.plans.columns["hit_speed"], expected.plans.columns["hit_speed"])


def test_the_mallet_meets_the_puck_on_the_line_to_the_target(planner, state):
    found = planner.strike(state, PUCKS, TARGET, meeting=0.05, speed_share=0.5)
    arm = Arm(open_problem(planner.model.problem)[1])
    for row, number in enumerate(found.plans.sample_id):
        q, dq = found.plans.boundary.goal_q[row].copy(), found.plans.boundary.goal_dq[row].copy()
        away = PUCKS[number] - arm.pose(q).translation[:2]
        assert np.linalg.norm(away) == pytest.approx(0.05, abs=1e-7)
        line = (TARGET - PUCKS[number]) / np.linalg.norm(TARGET - PUCKS[number])
        np.testing.assert_allclose(away / 0.05, line, atol=1e-6)
        velocity = arm.velocity(q, dq)
        np.testing.assert_allclose(velocity / np.linalg.norm(velocity), [*line, 0], atol=1e-8)


def test_one_strike_is_the_same_alone_and_among_others_and_has_a_reason_where_it_has_no_plan(planner, state):
    many = planner.strike(state, PUCKS, TARGET)
    assert many.reasons == ("", "", "no hitting configuration", "")
    assert "3 of 4 strikes" in repr(many)
    for i, row in ((0, 0), (3, 2)):
        one = planner.strike(tuple(part[i] for part in state), PUCKS[i], TARGET)
        np.testing.assert_array_equal(one.plans.boundary.goal_q[0], many.plans.boundary.goal_q[row])
        np.testing.assert_allclose(one.plans.path_control_points[0], many.plans.path_control_points[row], atol=1e-5)
    alone = planner.strike(tuple(part[2] for part in state), PUCKS[2], TARGET)
    assert len(alone.plans) == 0
    assert alone.reasons == ("no hitting configuration",)


def test_a_planner_that_has_struck_can_still_be_pickled(planner, state):
    again = pickle.loads(pickle.dumps(planner)).strike(state, PUCKS, TARGET)
    assert again.reasons == planner.strike(state, PUCKS, TARGET).reasons


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros(6), [1.0, 0.0], TARGET), "state must be positions, velocities and accelerations"),
        (
            ((np.zeros(6),) * 2, [1.0, 0.0], TARGET),
            "state must be positions, .* got 2 values or arrays",
        ),
        (((np.zeros(5),) * 3, [1.0, 0.0], TARGET), r"start_q must have shape \(6,\) or \(N, 6\), got \(5,\)"),
        (((np.zeros(6),) * 3, [1.0], TARGET), r"puck must have shape \(2,\) or \(N, 2\) or \(3,\) or \(N, 3\), got"),
        (((np.zeros(6),) * 3, [1.0, np.nan], TARGET), "puck must be finite"),
        (((np.zeros((2, 6)),) * 3, np.ones((3, 2)), TARGET), "start_q is given for 2 strikes, another argument for 3"),
        (((np.zeros((0, 6)),) * 3, np.ones((0, 2)), TARGET), "start_q is of no strike"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(planner, arguments, message):
    with pytest.raises(UsageError, match=message):
        planner.strike(*arguments)


def test_a_model_of_certified_rows_strikes_without_solving_anything(planner, state):
    stages = [*planner.model.training["stages"], {"use": "certified-plan"}]
    certified = Planner(replace(planner.model, training={**planner.model.training, "stages": stages}))
    assert certified.strike(state, PUCKS, TARGET).reasons == planner.strike(state, PUCKS, TARGET).reasons


def test_models_of_other_tasks_or_of_unknown_rows_cannot_strike(planner):
    state = (np.zeros(7),) * 3
    with pytest.raises(UsageError, match="'heavy-object' has no column to give 'hit_angle'"):
        Planner("heavy-object").strike(state, [1.0, 0.0], TARGET)
    unknown = Planner(replace(planner.model, training={}))
    with pytest.raises(UsageError, match="does not say how the rows were drawn"):
        unknown.strike(state, [1.0, 0.0], TARGET)


def test_what_gives_no_direction_or_is_no_number_is_refused(planner, state):
    with pytest.raises(UsageError, match=r"towards must be another place than the puck, got \[\[1.0, 0.3\]\]"):
        planner.strike(state, PUCKS[3], PUCKS[3])
    with pytest.raises(UsageError, match="speed_share must be finite"):
        planner.strike(state, PUCKS, TARGET, speed_share=np.nan)
    with pytest.raises(UsageError, match="meeting must be a finite number, got nan"):
        planner.strike(state, PUCKS, TARGET, meeting=np.nan)
