"""The worked example of a planner package; in the extended run only, its plans where Crocoddyl is installed."""

import sys
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from cnpgen.addons.benchmark.answers import judge_answer
from cnpgen.addons.benchmark.benchmark_planner import Setting
from cnpgen.addons.benchmark.planners.obstacle_boxes import boxes_of
from cnpgen.addons.benchmark.planners.trajopt import (
    MIN_CENTER_DISTANCE_M,
    knot_constraints,
)
from cnpgen.errors import MachineError
from cnpgen.problems.problem_record import open_problem
from tests.addons.benchmark.test_baselines import one_of
from tests.refusals import is_refused

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "crocoddyl_planner.py"


@cache
def example() -> ModuleType:
    """Import the example as the module of its package."""
    spec = spec_from_file_location(EXAMPLE.stem, EXAMPLE)
    assert spec
    assert spec.loader
    module = module_from_spec(spec)
    sys.modules[EXAMPLE.stem] = module  # its dataclasses look their annotations up here
    spec.loader.exec_module(module)
    return module


@pytest.mark.extended
def test_crocoddyl_with_another_pinocchio_is_refused_before_its_import(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "crocoddyl", ModuleType("crocoddyl"))
    monkeypatch.setattr("importlib.metadata.version", lambda _: "3.2.1")
    monkeypatch.setattr("pinocchio.__version__", "4.1.0")
    with is_refused(MachineError):
        example().load_crocoddyl()
    monkeypatch.setattr("pinocchio.__version__", "4.0.2")
    assert example().load_crocoddyl().__name__ == "crocoddyl"
    monkeypatch.setattr("importlib.metadata.version", lambda _: "3.3.0")
    with is_refused(MachineError):
        example().load_crocoddyl()


@pytest.mark.extended
def test_violations_of_the_object_equal_those_of_trajopt_and_have_correct_derivatives() -> (
    None
):
    task = one_of("heavy-100")
    assert example().MIN_CENTER_DISTANCE_M == MIN_CENTER_DISTANCE_M
    problem, robot = open_problem(task.problem)
    violation = example().ObjectViolation(robot, *boxes_of(problem, task.scene))
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


@pytest.mark.extended
def test_a_motion_is_accepted_only_within_its_limits_and_at_its_goal() -> None:
    task = one_of("hits-81", 40)
    robot, boundary = open_problem(task.problem)[1], task.boundary
    duration = example().min_duration(robot, boundary)
    slow, fast = np.linspace(0, 5.0, 51), np.linspace(0, 0.5 * duration, 51)
    states = np.array(example().cubic_states(boundary, slow))
    np.testing.assert_allclose(
        states[[0, -1], : robot.n],
        [boundary.start_q[0], boundary.goal_q[0]],
        atol=1e-12,
    )
    assert example().are_small(robot, boundary, slow, states)
    assert not example().are_small(
        robot, boundary, fast, np.array(example().cubic_states(boundary, fast))
    )
    states[-1, 0] += 1e-3
    assert not example().are_small(robot, boundary, slow, states)


@pytest.mark.extended
def test_crocoddyl_returns_valid_hits_and_transports() -> None:
    pytest.importorskip("crocoddyl")
    for suite, row in (("hits-81", 40), ("heavy-100", 0)):
        task = one_of(suite, row)
        plan = example().Crocoddyl().prepare(Setting(task.problem, time_limit=300.0))
        verdict = judge_answer(task, plan(task))
        assert verdict.valid, (suite, verdict.reason, verdict.margins)
        assert verdict.metrics.duration < (0.4 if suite == "hits-81" else 1.6)
