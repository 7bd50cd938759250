"""Baselines of the extras ``planners`` and ``crocoddyl``, where these are installed, and their refusals elsewhere."""

import sys
from types import ModuleType

import numpy as np
import pytest

from cnpgen.addons.benchmark.answers import judge_answer
from cnpgen.addons.benchmark.benchmark_planner import Setting, load_planner
from cnpgen.addons.benchmark.planners.cbirrt import MANIFOLD_TOLERANCE, Search
from cnpgen.addons.benchmark.planners.crocoddyl import (
    ObjectViolation,
    are_small,
    cubic_states,
    load_crocoddyl,
    min_duration,
)
from cnpgen.addons.benchmark.planners.drake import model_text
from cnpgen.addons.benchmark.planners.obstacle_boxes import boxes_of
from cnpgen.addons.benchmark.planners.sscbirrt import ManifoldSet
from cnpgen.addons.benchmark.planners.trajopt import knot_constraints
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.errors import MachineError, UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from tests.addons.benchmark.test_baselines import one_of


def test_crocoddyl_with_another_pinocchio_is_refused_before_its_import(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "crocoddyl", ModuleType("crocoddyl"))
    monkeypatch.setattr("importlib.metadata.version", lambda _: "3.2.1")
    monkeypatch.setattr("pinocchio.__version__", "4.1.0")
    with pytest.raises(
        MachineError, match=r"Crocoddyl 3.2.1 needs Pinocchio 4.0, installed is 4.1.0"
    ):
        load_crocoddyl()
    monkeypatch.setattr("pinocchio.__version__", "4.0.2")
    assert load_crocoddyl().__name__ == "crocoddyl"
    monkeypatch.setattr("importlib.metadata.version", lambda _: "3.3.0")
    with pytest.raises(
        MachineError, match=r"must be 3.2.\* with Pinocchio 4.0.\*, installed is 3.3.0"
    ):
        load_crocoddyl()


def test_violations_of_the_object_equal_those_of_trajopt_and_have_correct_derivatives() -> (
    None
):
    task = one_of("heavy-100")
    problem, robot = open_problem(task.problem)
    violation = ObjectViolation(robot, *boxes_of(problem, task.scene))
    at_knots = knot_constraints(problem, robot, task.scene)
    random = np.random.default_rng(2)
    violated = 0
    for _ in range(20):
        q, d = (
            task.boundary.start_q[0] + 0.08 * random.normal(size=robot.n),
            random.normal(size=robot.n),
        )
        values = violation.values(q)
        still = np.zeros((1, robot.n))
        others = -at_knots(q[None], still, still)[0][0][1 : 1 + violation.size]
        np.testing.assert_allclose(np.sort(values), np.sort(others), atol=1e-12)
        difference = (
            violation.values(q + 1e-7 * d) - violation.values(q - 1e-7 * d)
        ) / 2e-7
        np.testing.assert_allclose(violation.derivatives(q) @ d, difference, atol=1e-6)
        violated += int(values.max() > 0)
    assert violated > 5


def test_a_motion_is_accepted_only_within_its_limits_and_at_its_goal() -> None:
    task = one_of("hits-81", 40)
    robot, boundary = open_problem(task.problem)[1], task.boundary
    duration = min_duration(robot, boundary)
    slow, fast = np.linspace(0, 5.0, 51), np.linspace(0, 0.5 * duration, 51)
    states = np.array(cubic_states(boundary, slow))
    np.testing.assert_allclose(
        states[[0, -1], : robot.n],
        [boundary.start_q[0], boundary.goal_q[0]],
        atol=1e-12,
    )
    assert are_small(robot, boundary, slow, states)
    assert not are_small(robot, boundary, fast, np.array(cubic_states(boundary, fast)))
    states[-1, 0] += 1e-3
    assert not are_small(robot, boundary, slow, states)


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
@pytest.mark.parametrize("planner", ["drake", "crocoddyl"])
def test_optimizers_return_valid_hits_and_transports(planner: str) -> None:
    if planner == "drake":
        pytest.importorskip("pydrake")
    else:
        pytest.importorskip("crocoddyl")
    for suite, row in (("hits-81", 40), ("heavy-100", 0)):
        task = one_of(suite, row)
        verdict = judge_answer(task, planned(planner, task))
        assert verdict.valid, (suite, verdict.reason, verdict.margins)
        assert verdict.metrics.duration < (0.4 if suite == "hits-81" else 1.6)


@pytest.mark.extended
def test_optimizers_refuse_problems_without_table_and_boxes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("example_robot_data")
    problem = one_of("clutter").problem
    monkeypatch.setattr(
        "cnpgen.addons.benchmark.planners.drake.load_drake", lambda: None
    )
    monkeypatch.setattr(
        "cnpgen.addons.benchmark.planners.crocoddyl.load_crocoddyl", lambda: None
    )
    for planner in ("drake", "crocoddyl"):
        with pytest.raises(UsageError, match=r"neither table nor object|upright boxes"):
            load_planner(planner, {}).prepare(Setting(problem))
