"""Baselines of the extra ``planners``, where it is installed, and their refusals elsewhere."""

import numpy as np
import pytest

from cnpgen.addons.benchmark.answers import judge_answer
from cnpgen.addons.benchmark.benchmark_planner import Setting, load_planner
from cnpgen.addons.benchmark.planners.cbirrt import MANIFOLD_TOLERANCE, Search
from cnpgen.addons.benchmark.planners.drake import model_text
from cnpgen.addons.benchmark.planners.sscbirrt import ManifoldSet
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from tests.addons.benchmark.test_baselines import one_of
from tests.examples.example_robots import needs_robots
from tests.refusals import is_refused


def test_projections_reach_the_manifold() -> None:
    task = one_of("hits-81", 40)
    problem, robot = open_problem(task.problem)
    manifold = ManifoldSet(Search(problem, robot, task))
    q = task.boundary.start_q[0] + 0.05
    assert not manifold.contains(q)
    projected = manifold.project(q, q)
    assert projected is not None
    assert abs(task.problem.tip_positions(projected[None])[0, 2] - 0.16) < 1e-3


def test_the_model_of_drake_has_the_planned_joints_only() -> None:
    robot = open_problem(one_of("hits-81").problem)[1]
    text, root = model_text(robot)
    assert root == "world"
    assert text.count('type="revolute"') == robot.n
    assert "visual" not in text


def planned(name: str, task: Plans) -> Trajectory:
    answer = load_planner(name, {}).prepare(Setting(task.problem, time_limit=300.0))(
        task
    )
    assert isinstance(answer, Trajectory)
    return answer


@pytest.mark.slow
def test_sscbirrt_returns_a_path_near_the_manifold_within_the_limits() -> None:
    pytest.importorskip("sscbirrt")
    for suite in ("hits-81", "heavy-100"):
        task = one_of(suite)
        robot, answer = open_problem(task.problem)[1], planned("sscbirrt", task)
        t = np.linspace(0, answer.duration, 500)
        q, dq, ddq = answer.states(t)
        np.testing.assert_allclose(
            q[[0, -1]], [task.boundary.start_q[0], task.boundary.goal_q[0]], atol=1e-5
        )
        assert np.all(np.abs(dq) <= robot.velocity_limit * (1 + 1e-6))
        assert np.all(np.abs(ddq) <= robot.acceleration_limit * (1 + 1e-6))
        search = Search(open_problem(task.problem)[0], robot, task)
        assert (
            max(abs(search.residual(position)[0]) for position in q)
            < 1.2 * MANIFOLD_TOLERANCE
        )
        np.testing.assert_array_equal(planned("sscbirrt", task).q, answer.q)


@pytest.mark.slow
def test_drake_returns_valid_hits_and_transports() -> None:
    pytest.importorskip("pydrake")
    for suite, row in (("hits-81", 40), ("heavy-100", 0)):
        task = one_of(suite, row)
        verdict = judge_answer(task, planned("drake", task))
        assert verdict.valid, (suite, verdict.reason, verdict.margins)
        assert verdict.metrics.duration < (0.4 if suite == "hits-81" else 1.6)


@needs_robots
@pytest.mark.extended
def test_drake_refuses_problems_without_table_and_boxes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = one_of("clutter").problem
    monkeypatch.setattr(
        "cnpgen.addons.benchmark.planners.drake.load_drake", lambda: None
    )
    with is_refused(UsageError):
        load_planner("drake", {}).prepare(Setting(problem))
