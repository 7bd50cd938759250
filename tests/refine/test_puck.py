"""Hits whose straight line passes through the puck: valid plans do not touch it early, by SciPy and Pinocchio."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from cnpgen.addons.online.plan_hits import plan_hits
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.refine.refine_plans import refine_plans, solve_plans
from tests.conftest import Arm

TARGET = np.array([2.49, 0.0])
LAST_M = 0.01


def depth_of_early_contact(plans: Plans, pucks: np.ndarray) -> np.ndarray:
    """Return the largest penetration [m] with more than 10 mm of path left, by positions along the path."""
    contact = load_problem("airhockey").first(PuckContact)
    assert contact is not None
    arm, depths = Arm(open_problem(plans.problem)[1]), []
    s = np.linspace(0, 1, 1500)
    for path, puck in zip(plans.path_control_points, pucks, strict=True):
        knots = np.r_[
            np.zeros(8), np.arange(1, len(path) - 7) / (len(path) - 7), np.ones(8)
        ]
        tip = np.array(
            [
                arm.pose(q).translation[:2].copy()
                for q in scipy.interpolate.BSpline(knots, path, 7)(s)
            ]
        )
        left = np.append(
            np.cumsum(np.linalg.norm(np.diff(tip, axis=0), axis=1)[::-1])[::-1], 0.0
        )
        distance = np.linalg.norm(tip - puck, axis=1)[left > LAST_M]
        depths.append(contact.mallet_radius + contact.puck_radius - distance.min())
    return np.array(depths)


@pytest.fixture(scope="module")
def hits() -> tuple[Plans, np.ndarray]:
    """Hits from rest in front of the puck: the straight line to the goal passes through it."""
    planner = Planner("airhockey-hit", backend="numpy")
    _, robot = open_problem(planner.model.problem)
    arm, rest = Arm(robot), np.zeros((1, 6))
    q = robot.home.copy()
    for _ in range(50):  # the tip is moved to x = 1 m by Gauss-Newton steps
        error = np.array([1.0, 0.0, 0.16]) - arm.pose(q).translation
        q = q + np.linalg.lstsq(arm.jacobian(q)[:3], error, rcond=None)[0]
    pucks = np.array([[0.85, 0.02], [0.88, -0.05], [0.86, 0.1]])
    planned = plan_hits(planner, (q[None], rest, rest), pucks, TARGET)
    assert planned.reasons == ("", "", "")
    return planned.plans, pucks


def test_plans_called_valid_do_not_touch_the_puck_early(hits) -> None:
    plans, pucks = hits
    assert depth_of_early_contact(solve_plans_without_puck(plans), pucks).max() > 0.02
    refined = refine_plans(plans, workers=1).plans
    assert evaluate_plans(refined, workers=1).valid.all()
    assert depth_of_early_contact(refined, pucks).max() < 5e-5


def test_a_motion_through_the_puck_is_invalid_for_this_reason(hits) -> None:
    through = solve_plans_without_puck(hits[0])
    verdicts = evaluate_plans(
        replace(through, problem=hits[0].problem), workers=1
    ).verdicts
    reasons = {verdict.reason for verdict in verdicts}
    assert reasons == {"early contact with the puck"}


def solve_plans_without_puck(plans: Plans) -> Plans:
    """Solve the same boundary problems without the constraint."""
    problem = load_problem("airhockey")
    others = tuple(
        constraint
        for constraint in problem.constraint
        if not isinstance(constraint, PuckContact)
    )
    record = record_problem(replace(problem, constraint=others))
    found = solve_plans(replace(plans, problem=record), workers=1).plans
    assert evaluate_plans(found, workers=1).valid.all()
    return found
