"""Comparison with Ipopt on the same transcription: equally good within half a percent; tests of the Ipopt setup."""

from dataclasses import replace

import numpy as np
import pytest
from ipopt import (
    Program,
    lagrangian_hessian,
    minimize_with_ipopt,
    with_ipopt,
)
from numpy_transcription import evaluate, residual_gradients

from cnpgen.refine import initial_guesses
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.sqp import Settings
from cnpgen.refine.solver.transcription import Transcription
from tests.examples.plans import load
from tests.examples.refiner import cost_term_of, refiner, task
from tests.refine.test_solver import transcription

more = pytest.mark.extended  # the same claim for another motion
PROBLEMS = {"hit": "airhockey", "replan": "airhockey", "transport": "heavy-object"}


@pytest.mark.slow
@pytest.mark.parametrize("label", ["hit", pytest.param("replan", marks=more)])
def test_a_level_ends_at_least_as_good_as_ipopts_from_the_same_guess(
    label: str,
) -> None:
    problem, tool = task(load(label)), refiner(PROBLEMS[label])
    interior, rate = initial_guesses.straight_line(
        problem.boundary, tool.robot.velocity_limit, tool.spec
    )
    level, x = tool.levels.coarse, np.concatenate([interior.ravel(), np.log(rate)])
    own, other = (
        solver.run_level(problem, level, x) for solver in (tool, with_ipopt(tool))
    )
    assert max(own.violation, other.violation) < Settings().violation_tolerance
    assert not np.array_equal(own.x, other.x)
    assert own.cost < 1.005 * other.cost
    assert 1 < other.iterations <= 6 * level.settings.max_iterations


def gradient(motion, x: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    """Return the gradient of the Lagrangian without the objective."""
    at = evaluate(motion, x)
    k, residual = np.nonzero(np.ones(at.g.shape, bool))
    return multipliers[k, residual] @ residual_gradients(motion, at, k, residual)


@pytest.mark.parametrize(
    "label",
    ["hit", pytest.param("replan", marks=more), pytest.param("transport", marks=more)],
)
@pytest.mark.parametrize("goal_acceleration", [pytest.param(False, marks=more), True])
def test_the_hessian_of_the_lagrangian_is_that_of_finite_differences(
    label: str, goal_acceleration: bool
) -> None:
    plan = load(label)
    boundary = (
        replace(plan.boundary, goal_ddq=plan.boundary.goal_dq * 0 + 0.3)
        if goal_acceleration
        else plan.boundary
    )
    motion = transcription(plan, 12, boundary)
    random = np.random.default_rng(1)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0]) + 0.02 * random.normal(
        size=motion.nx
    )
    at = evaluate(motion, x)
    multipliers = random.normal(size=at.g.shape) * (random.random(at.g.shape) < 0.3)
    multipliers[:, -2:] = 0  # of obstacles, whose distances are not smooth
    if label == "transport":
        multipliers[:, 28:] = 0
    hessian = lagrangian_hessian(motion, at, multipliers, 2.0)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-9)
    step = 1e-5
    for variable in motion.split + np.array([-motion.split, -1, 0, 1, 7, 18, 19]):
        move = step * np.eye(motion.nx)[variable]
        column = (
            gradient(motion, x + move, multipliers)
            - gradient(motion, x - move, multipliers)
        ) / (2 * step)
        expected = column + 2.0 * at.curvature[variable]
        np.testing.assert_allclose(
            hessian[variable], expected, atol=3e-6 * (1 + np.abs(hessian).max())
        )


def test_without_multipliers_only_the_objective_is_curved() -> None:
    plan = load("hit")
    motion = transcription(plan, 12, cost_term=cost_term_of("centrifugal", 0.01))
    at = evaluate(motion, motion.pack(plan.motion.path[0], plan.motion.rate[0]))
    np.testing.assert_array_equal(
        lagrangian_hessian(motion, at, np.zeros(at.g.shape), 3.0), 3.0 * at.curvature
    )


def test_a_program_has_the_selected_residuals_and_its_sparse_jacobian_equals_the_dense_one() -> (
    None
):
    import casadi as ca

    plan = load("replan")
    motion = transcription(plan, 24)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0])
    shape = evaluate(motion, x).g.shape
    selected = np.random.default_rng(0).random(shape) < 0.2
    bounds = Bounds(
        np.full(shape, -1.0),
        np.full(shape, 1.0),
        np.zeros(shape, bool),
        np.full(shape, np.inf),
    )
    program = Program(
        motion, bounds, selected, x
    )  # has the callbacks, so it lives as long as the functions
    nlp = program.problem()
    derivative = ca.Function(
        "derivative", [nlp["x"]], [ca.jacobian(nlp["g"], nlp["x"])]
    )
    elsewhere = x + 0.05 * np.random.default_rng(1).normal(size=len(x))
    found = derivative(elsewhere)
    np.testing.assert_array_equal(
        np.array(found),
        residual_gradients(motion, evaluate(motion, elsewhere), *np.nonzero(selected)),
    )
    assert found.nnz() < 0.5 * found.numel()


def test_an_error_while_ipopt_runs_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, tool = task(load("hit")), refiner("airhockey")
    level, calls = tool.levels.coarse, []
    motion = tool.transcription(problem, level)

    def fail(of: Transcription, x: np.ndarray) -> object:
        calls.append(x)
        if len(calls) > 6:
            raise KeyboardInterrupt
        return evaluate(of, x)

    monkeypatch.setattr("ipopt.evaluate", fail)
    bounds = tool.bounds(problem, level, motion.end_residuals())
    with pytest.raises(KeyboardInterrupt):
        minimize_with_ipopt(motion, bounds, tool.line_guess(problem), Settings())
