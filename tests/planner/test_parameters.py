"""Planners for problems with parameters: plans, replans and hits on the table of each sample."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cnpgen.addons.online.plan_hits import plan_hits
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plan_file import load_plans, save_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.obstacles import table_frame_of
from cnpgen.problems.problem_file import load_problem
from tests.refusals import is_refused

PUCK, TARGET = [1.0, 0.1], [2.49, 0.0]


@cache
def planner() -> Planner:
    return Planner("airhockey-tables")


@cache
def problems() -> Plans:
    return draw_boundary_problems("airhockey-tables", 16, seed=11)


def test_plans_are_valid_on_their_own_tables_only(tmp_path) -> None:
    plans = planner().plan_batch(problems().boundary)
    assert evaluate_plans(plans, workers=1).valid.mean() > 0.8
    save_plans(tmp_path / "plans.h5", plans)
    np.testing.assert_array_equal(
        load_plans(tmp_path / "plans.h5").boundary.parameters, plans.boundary.parameters
    )
    others = replace(plans.boundary, parameters=plans.boundary.parameters[::-1])
    assert not evaluate_plans(replace(plans, boundary=others), workers=1).valid.any()


def test_a_plan_does_not_depend_on_the_others() -> None:
    together, boundary = planner().plan_batch(problems().boundary), problems().boundary
    states = {name: values[3] for name, values in boundary.conditions().items()}
    alone = planner().plan(**states, parameters=boundary.parameters[3])
    np.testing.assert_allclose(
        alone.path_control_points[0], together.path_control_points[3], atol=1e-6
    )


def test_hits_are_along_the_table() -> None:
    boundary = problems().boundary
    rest = np.zeros_like(boundary.start_q)
    hits = plan_hits(
        planner(),
        (boundary.start_q, rest, rest),
        PUCK,
        TARGET,
        parameters=boundary.parameters,
    )
    assert len(hits.plans) >= 14
    frame = table_frame_of(
        load_problem("airhockey-tables"), hits.plans.boundary.parameters
    )
    goal = frame.to_table(hits.plans.columns["goal_xyz"])
    along = (np.array(TARGET) - PUCK) / np.linalg.norm(np.array(TARGET) - PUCK)
    np.testing.assert_allclose(
        goal, np.tile([*(PUCK - 0.07 * along), 0.16], (len(goal), 1)), atol=1e-7
    )
    assert evaluate_plans(hits.plans, workers=1).valid.mean() > 0.8


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        (None, "parameters is missing: tasks have table_height"),
        ([0.2, 0, 0, 1], "table_height must be from"),
    ],
)
def test_missing_and_other_values_are_refused(parameters, text: str) -> None:
    boundary = problems().boundary
    with pytest.raises(UsageError, match=text):
        planner().plan(boundary.start_q[0], boundary.goal_q[0], parameters=parameters)
    with is_refused(UsageError, argument="parameters"):
        Planner("airhockey-hit").plan(
            boundary.start_q[0], boundary.goal_q[0], parameters=[1.0]
        )
