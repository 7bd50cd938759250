"""The benchmark's planners that use a trained model."""

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import load_planner
from cnpgen.benchmark import Setting, load_suite
from cnpgen.errors import UsageError
from cnpgen.planner.model_file import shipped_models
from cnpgen.planner.planner import Planner
from tests.refusals import is_refused


def test_the_paper_planner_plans_with_its_model_file() -> None:
    problem = load_suite("hits-81").problems(1)[0]
    file = str(shipped_models()["airhockey-hit"])
    plan = load_planner("cnp-b-paper", {"model": file}).prepare(
        Setting(problem.problem)
    )(problem)
    b = problem.boundary
    expected = Planner(file, scale_time=False).plan(
        b.start_q, b.goal_q, goal_dq=b.goal_dq
    )
    np.testing.assert_array_equal(
        plan.path_control_points, expected.path_control_points
    )
    np.testing.assert_array_equal(plan.sample_id, problem.sample_id)


def test_the_paper_planner_refuses_a_missing_model_and_one_of_another_problem() -> None:
    setting = Setting(load_suite("hits-81").problems(1)[0].problem)
    with is_refused(UsageError):
        load_planner("cnp-b-paper", {}).prepare(setting)
    with is_refused(UsageError):
        load_planner(
            "cnp-b-paper", {"model": str(shipped_models()["heavy-object"])}
        ).prepare(setting)
