"""CasADi's solvers on the refiner's transcription: exact derivatives, as good as the own one, interruptible."""

import os
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.refine.casadi.alternatives import minimise_with
from cnpgen.refine.casadi.callbacks import Callbacks
from cnpgen.refine.casadi.programme import Programme
from cnpgen.refine.solver.criterion import Criterion
from cnpgen.refine.solver.hessian import lagrangian_hessian
from cnpgen.refine.solver.sqp import Bounds, Settings
from tests.examples.plans import load
from tests.examples.refiner import refiner, task
from tests.refine.test_solver import transcription

SOLVERS = ("ipopt", "sqpmethod")


def gradient(motion, x: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    """Gradient of the Lagrangian without the objective."""
    at = motion.evaluate(x)
    k, which = np.nonzero(np.ones(at.g.shape, bool))
    return multipliers[k, which] @ motion.rows(at, k, which)


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
@pytest.mark.parametrize("goal_acceleration", [False, True])
def test_the_hessian_of_the_lagrangian_is_that_of_finite_differences(label: str, goal_acceleration: bool) -> None:
    plan = load(label)
    boundary = replace(plan.boundary, goal_ddq=plan.boundary.goal_dq * 0 + 0.3) if goal_acceleration else plan.boundary
    motion = transcription(plan, 12, boundary)
    random = np.random.default_rng(1)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0]) + 0.02 * random.normal(size=motion.nx)
    at = motion.evaluate(x)
    multipliers = random.normal(size=at.g.shape) * (random.random(at.g.shape) < 0.3)
    multipliers[:, -2:] = 0  # of obstacles, which have corners
    if label == "transport":
        multipliers[:, 28:] = 0
    hessian = lagrangian_hessian(motion, at, multipliers, 2.0)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-9)
    step = 1e-5
    for variable in motion.split + np.array([-motion.split, -1, 0, 1, 7, 18, 19]):
        move = step * np.eye(motion.nx)[variable]
        column = (gradient(motion, x + move, multipliers) - gradient(motion, x - move, multipliers)) / (2 * step)
        expected = column + 2.0 * at.curvature[variable]
        np.testing.assert_allclose(hessian[variable], expected, atol=3e-6 * (1 + np.abs(hessian).max()))


def test_without_multipliers_only_the_objective_is_curved() -> None:
    plan = load("hit")
    motion = transcription(plan, 12, criterion=Criterion("centrifugal", 0.01))
    at = motion.evaluate(motion.pack(plan.motion.path[0], plan.motion.rate[0]))
    np.testing.assert_array_equal(lagrangian_hessian(motion, at, np.zeros(at.g.shape), 3.0), 3.0 * at.curvature)


def test_a_programme_holds_what_it_is_told_and_its_sparse_jacobian_is_the_dense_one() -> None:
    plan = load("replan")
    motion = transcription(plan, 24)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0])
    shape = motion.evaluate(x).g.shape
    held = np.random.default_rng(0).random(shape) < 0.2
    bounds = Bounds(np.full(shape, -1.0), np.full(shape, 1.0), np.zeros(shape, bool))
    programme = Programme(motion, bounds, held, x)
    import casadi as ca

    nlp = programme.problem()
    derivative = ca.Function("derivative", [nlp["x"]], [ca.jacobian(nlp["g"], nlp["x"])])
    elsewhere = x + 0.05 * np.random.default_rng(1).normal(size=len(x))
    found = derivative(elsewhere)
    np.testing.assert_array_equal(np.array(found), motion.rows(motion.evaluate(elsewhere), *np.nonzero(held)))
    assert found.nnz() < 0.5 * found.numel()


@pytest.mark.parametrize("solver", SOLVERS)
def test_casadis_solvers_end_at_least_as_good_as_the_own_one(solver: str) -> None:
    asked, tool = task(load("hit")), refiner("airhockey")
    which = tool.passes.first
    own = tool.minimise(asked, which, tool.straight(asked))
    motion, bounds = tool.transcription(asked, which), tool._bounds[which].of(asked.start_xyz)
    other = minimise_with(motion, bounds, tool.straight(asked), which.settings, solver=solver)
    assert bounds.violation(motion.value(other.x)[1]) == pytest.approx(other.violation, abs=1e-12)  # another kernel
    assert other.violation < Settings().violation_tolerance
    assert other.cost < own.cost * 1.001
    assert 1 < other.iterations <= 6 * Settings().max_iterations


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_interruption_inside_a_plug_in_is_not_lost(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, tool = task(load("hit")), refiner("airhockey")
    motion, which = tool.transcription(asked, tool.passes.first), tool.passes.first
    evaluate, calls = motion.evaluate, []

    def interrupt(x: np.ndarray) -> object:
        calls.append(x)
        if len(calls) > 6:
            raise KeyboardInterrupt
        return evaluate(x)

    monkeypatch.setattr(motion, "evaluate", interrupt)
    with pytest.raises(KeyboardInterrupt):
        minimise_with(motion, tool._bounds[which].of(asked.start_xyz), tool.straight(asked), Settings(), solver=solver)
    assert len(calls) == 7  # and nothing was evaluated afterwards


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("seconds", [0.02, 0.1, 0.25])
def test_a_signal_is_not_lost_wherever_it_comes(solver: str, seconds: float) -> None:
    asked, tool = task(load("hit")), refiner("airhockey")
    which = tool.passes.first
    motion, bounds, x = tool.transcription(asked, which), tool._bounds[which].of(asked.start_xyz), tool.straight(asked)
    endless = Settings(max_iterations=100_000, cost_tolerance=1e-300)
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        minimise_with(motion, bounds, x, endless, solver=solver)
    timer.join()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_callback_that_failed_once_is_not_called_again() -> None:
    import casadi as ca

    calls: list[np.ndarray] = []

    def compute(x: np.ndarray) -> np.ndarray:
        calls.append(x)
        raise ValueError("first")

    callbacks, dense = Callbacks(), ca.Sparsity.dense(2, 1)
    function = callbacks.wrap("broken", [dense], dense, compute)
    for _ in range(2):
        with pytest.raises(RuntimeError):
            function([1.0, 2.0])
    assert str(callbacks.raised) == "first"
    assert len(calls) == 1


@pytest.mark.parametrize("solver", SOLVERS)
def test_steps_into_what_is_no_number_are_taken_back(solver: str) -> None:
    asked, tool = task(load("transport")), refiner("heavy-object")
    which, x = tool.passes.first, tool.straight(asked)
    bounds = tool._bounds[which].of(asked.start_xyz)
    nowhere = Bounds(bounds.lower + 50.0, bounds.upper + 50.0, bounds.sharp)  # contradicts itself
    settings = Settings(max_iterations=1)
    result = minimise_with(tool.transcription(asked, which), nowhere, x, settings, solver=solver)
    assert np.isfinite(result.x).all()
    assert result.violation <= nowhere.violation(tool.transcription(asked, which).value(x)[1])


@pytest.mark.parametrize("solver", SOLVERS)
def test_without_iterations_the_first_variables_come_back(solver: str) -> None:
    asked, tool = task(load("hit")), refiner("airhockey")
    which, x = tool.passes.first, tool.straight(asked)
    bounds = tool._bounds[which].of(asked.start_xyz)
    result = minimise_with(tool.transcription(asked, which), bounds, x, Settings(max_iterations=0), solver=solver)
    np.testing.assert_array_equal(result.x, x)
