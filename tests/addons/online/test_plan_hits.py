"""Hits: a puck and a target give the plan of the completed boundary problem."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.addons.online.plan_hits import plan_hits
from cnpgen.errors import UsageError
from cnpgen.make.complete import complete
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.problems.problem_record import open_problem
from cnpgen.results import HitOptions
from tests.conftest import Arm
from tests.refusals import is_refused

PUCKS = np.array(
    [[0.9, 0.1], [1.1, -0.2], [3.0, 0.0], [1.0, 0.3]]
)  # m; the third is out of reach
TARGET = np.array([2.49, 0.0])  # m


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner("airhockey-replan")


@pytest.fixture(scope="module")
def state(planner) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States on plans that are being executed: moving, and off the table by the error of the network."""
    given = draw_boundary_problems("airhockey-replan", 4, seed=11).boundary
    plans = planner.plan_batch(given)
    return plans.states_at(0.4 * plans.duration)


def test_the_speed_is_accepted_as_a_keyword_for_one_version(planner, state):
    new = plan_hits(planner, state, PUCKS, TARGET, options=HitOptions(speed_share=0.5))
    with pytest.warns(DeprecationWarning, match="options=HitOptions") as warned:
        old = plan_hits(planner, state, PUCKS, TARGET, speed_share=0.5)
    assert warned[0].filename == __file__
    np.testing.assert_array_equal(
        old.plans.path_control_points, new.plans.path_control_points
    )


def test_a_hit_equals_pipeline_completion_and_planning(planner, state):
    found = plan_hits(planner, state, PUCKS, TARGET)
    along = (TARGET - PUCKS) / np.linalg.norm(TARGET - PUCKS, axis=1)[:, None]
    task = dict(zip(("start_q", "start_dq", "start_ddq"), state, strict=True))
    angle = np.arctan2(along[:, 1], along[:, 0])
    expected = complete(
        "airhockey-replan", goal_xyz=PUCKS - 0.07 * along, hit_angle=angle, **task
    )
    assert found.reasons == expected.reasons
    np.testing.assert_array_equal(found.plans.sample_id, [0, 1, 3])
    for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq"):
        ours, theirs = (
            getattr(found.plans.boundary, name),
            getattr(expected.plans.boundary, name),
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12, err_msg=name)
    planned = planner.plan_batch(expected.plans.boundary)
    np.testing.assert_allclose(
        found.plans.path_control_points, planned.path_control_points, atol=1e-9
    )
    np.testing.assert_allclose(
        found.plans.columns["hit_speed"], expected.plans.columns["hit_speed"]
    )


def test_the_mallet_meets_the_puck_on_the_line_to_the_target(planner, state):
    found = plan_hits(
        planner, state, PUCKS, TARGET, options=HitOptions(speed_share=0.5)
    )
    arm = Arm(open_problem(planner.model.problem)[1])
    for row, number in enumerate(found.plans.sample_id):
        q, dq = (
            found.plans.boundary.goal_q[row].copy(),
            found.plans.boundary.goal_dq[row].copy(),
        )
        away = PUCKS[number] - arm.pose(q).translation[:2]
        assert np.linalg.norm(away) == pytest.approx(0.07, abs=1e-7)
        line = (TARGET - PUCKS[number]) / np.linalg.norm(TARGET - PUCKS[number])
        np.testing.assert_allclose(away / 0.07, line, atol=1e-6)
        velocity = arm.velocity(q, dq)
        np.testing.assert_allclose(
            velocity / np.linalg.norm(velocity), [*line, 0], atol=1e-8
        )


def test_a_hit_is_the_same_alone_and_in_a_batch_and_has_a_plan_or_a_reason(
    planner, state
):
    many = plan_hits(planner, state, PUCKS, TARGET)
    assert many.reasons == ("", "", "no hitting configuration", "")
    assert "3 of 4 hits" in repr(many)
    for i, row in ((0, 0), (3, 2)):
        one = plan_hits(planner, tuple(part[i] for part in state), PUCKS[i], TARGET)
        np.testing.assert_array_equal(
            one.plans.boundary.goal_q[0], many.plans.boundary.goal_q[row]
        )
        np.testing.assert_allclose(
            one.plans.path_control_points[0],
            many.plans.path_control_points[row],
            atol=1e-5,
        )
    alone = plan_hits(planner, tuple(part[2] for part in state), PUCKS[2], TARGET)
    assert len(alone.plans) == 0
    assert alone.reasons == ("no hitting configuration",)


def test_a_planner_can_be_pickled_after_planning_hits(planner, state):
    again = plan_hits(pickle.loads(pickle.dumps(planner)), state, PUCKS, TARGET)
    assert again.reasons == plan_hits(planner, state, PUCKS, TARGET).reasons


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            (np.zeros(6), [1.0, 0.0], TARGET),
            "state must be positions, velocities and accelerations",
        ),
        (
            ((np.zeros(6),) * 2, [1.0, 0.0], TARGET),
            "state must be positions, .* got 2 values or arrays",
        ),
        (
            ((np.zeros(5),) * 3, [1.0, 0.0], TARGET),
            r"state must have shape \(6,\) or \(N, 6\), got \(5,\)",
        ),
        (
            ((np.zeros(6),) * 3, [1.0], TARGET),
            r"puck must have shape \(2,\) or \(N, 2\) or \(3,\) or \(N, 3\), got",
        ),
        (((np.zeros(6),) * 3, [1.0, np.nan], TARGET), "puck must be finite"),
        (
            ((np.full(6, 40.0), *(np.zeros(6),) * 2), [1.0, 0.0], TARGET),
            "start_q must be .* 40 deg = 0.698 rad",
        ),
        (
            ((np.zeros((2, 6)),) * 3, np.ones((3, 2)), TARGET),
            "state has 2 hits, another argument has 3",
        ),
        (
            ((np.zeros((0, 6)),) * 3, np.ones((0, 2)), TARGET),
            "state is empty, expected at least 1 hit",
        ),
    ],
)
def test_invalid_arguments_raise_errors_with_their_name(planner, arguments, message):
    with pytest.raises(UsageError, match=message):
        plan_hits(planner, *arguments)


def test_the_state_for_a_moving_puck_has_three_parts(planner):
    with is_refused(UsageError, argument="state"):
        plan_hits(
            planner, (np.zeros(6),) * 2, [1.0, 0.0], TARGET, puck_velocity=[-0.5, 0.0]
        )


def test_a_model_of_certified_rows_plans_hits_without_certifying(planner, state):
    stages = [*planner.model.training["stages"], {"use": "certified-plan"}]
    certified = Planner(
        replace(planner.model, training={**planner.model.training, "stages": stages})
    )
    assert (
        plan_hits(certified, state, PUCKS, TARGET).reasons
        == plan_hits(planner, state, PUCKS, TARGET).reasons
    )


def test_models_of_other_tasks_or_without_recorded_stages_cannot_plan_hits(planner):
    state = (np.zeros(7),) * 3
    with is_refused(UsageError, argument="hit_angle"):
        plan_hits(Planner("heavy-object"), state, [1.0, 0.0], TARGET)
    unknown = Planner(replace(planner.model, training={}))
    with is_refused(UsageError):
        plan_hits(unknown, state, [1.0, 0.0], TARGET)


def test_a_missing_direction_and_numbers_that_are_not_finite_raise_errors(
    planner, state
):
    with is_refused(UsageError, argument="target"):
        plan_hits(planner, state, PUCKS[3], PUCKS[3])
    with is_refused(UsageError, argument="speed_share"):
        plan_hits(planner, state, PUCKS, TARGET, options=HitOptions(speed_share=np.nan))
    with is_refused(UsageError, argument="contact_distance"):
        plan_hits(
            planner, state, PUCKS, TARGET, options=HitOptions(contact_distance=np.nan)
        )
    with is_refused(UsageError, argument="contact_distance"):
        plan_hits(
            planner, state, PUCKS, TARGET, options=HitOptions(contact_distance=0.05)
        )


def test_a_start_that_touches_the_puck_has_this_reason(planner, state):
    one = tuple(np.atleast_2d(values)[0].astype(float) for values in state)
    tip = Arm(open_problem(planner.model.problem)[1]).pose(one[0]).translation[:2]
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ahead = np.subtract(TARGET, tip) / np.linalg.norm(
        np.subtract(TARGET, tip)
    )  # some are within 10 mm of the goal
    for puck in (
        tip + 0.079 * around,
        tip + 0.03 * around,
        tip + np.linspace(0.062, 0.079, 8)[:, None] * ahead,
    ):
        touching = plan_hits(planner, one, puck, TARGET)
        assert set(touching.reasons) == {"start touches the puck"}
        assert not len(touching.plans)
    assert (
        "start touches the puck"
        not in plan_hits(planner, one, tip + 0.081 * around, TARGET).reasons
    )
