"""A batch of no task or plan is answered by none, or refused in words, whoever is asked."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import DatasetError, UsageError
from cnpgen.judges.plans import judge
from cnpgen.make.complete import complete
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.export import export_plans
from cnpgen.plans.join import join_plans
from cnpgen.plans.plan_file import save_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.refine_plans import refine_plans, solve_plans
from tests.conftest import some
from tests.refusals import is_refused

MODELS = (
    "airhockey-online",
    "heavy-object",
    "airhockey-replan",
)  # time-parametrized, scaled in time, with hits


@pytest.fixture(scope="module", params=some(MODELS, 2, "slow"))
def planner(request: pytest.FixtureRequest) -> Planner:
    return Planner(request.param)


@pytest.fixture
def none(planner: Planner) -> Plans:
    return planner.plan(np.zeros((0, planner.robot.n)), np.zeros((0, planner.robot.n)))


def test_nothing_is_planned_refined_judged_saved_and_joined(
    planner: Planner, none: Plans, tmp_path: Path
) -> None:
    assert [len(values) for values in none.states_at(0.1)] == [0, 0, 0]
    assert len(planner.replan(none, 0.1, goal_q=none.boundary.goal_q)) == 0
    for found in (
        refine_plans(none),
        solve_plans(none),
        refine_plans(none, workers=2, journal=tmp_path / "journal"),
    ):
        assert (len(found.plans), found.summary()["valid"]) == (0, 0)
    assert evaluate_plans(none, workers=2).summary()["valid_ratio"] is None
    problem, robot = open_problem(none.problem)
    assert (
        judge(problem, robot, none.motion, none.boundary, none.scene, np.zeros((0, 3)))
        == []
    )
    save_plans(tmp_path / "none.h5", none)
    assert len(join_plans(none, none, at=[])) == 0


def test_what_makes_no_sense_of_nothing_is_refused(
    planner: Planner, none: Plans, tmp_path: Path
) -> None:
    for plans in (none, join_plans(none, none)):
        with is_refused(DatasetError):
            export_plans(plans, tmp_path / "out", to="csv")
    with is_refused(UsageError, argument="goal_xyz"):
        complete("airhockey-replan", goal_xyz=np.zeros((0, 3)))
