"""Steps in compiled code: those of NumPy and DAQP, but for rounding, and the same plans."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.kernels.library import problem_kernels
from cnpgen.refine.engine import load_refiner
from cnpgen.refine.jury import Jury
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver import compiled, quadratic
from cnpgen.refine.solver.compiled import CompiledSteps
from cnpgen.refine.solver.quadratic import Near, PlainSteps
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import some
from tests.examples.plans import Plan, load
from tests.examples.refiner import library, needs_compiler, task

pytestmark = needs_compiler
LABELS = ("hit", "replan", "transport")


def refiner_of(plan: Plan) -> Refiner:
    """Return the refiner with the problem's own objective, which the criterion belongs to."""
    return load_refiner(plan.problem, plan.robot, kernels=library(plan.problem.name))


def free_or_held(plan: Plan, held: bool) -> Boundary:
    return replace(plan.boundary, goal_ddq=0 * plan.boundary.goal_dq + 0.3) if held else plan.boundary


def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Go on until rows are broken by less than usual: then both solvers end at the same point."""
    for module in (quadratic, compiled):
        monkeypatch.setattr(module, "FEASIBLE", 1e-10)


@pytest.mark.parametrize("held", [False, True], ids=["goal acceleration free", "goal acceleration held"])
@pytest.mark.parametrize("label", some(LABELS, 1, "slow"))
def test_values_and_steps_are_those_of_numpy_and_daqp(label: str, held: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    exact(monkeypatch)
    plan = load(label)
    tool, problem = refiner_of(plan), task(plan, free_or_held(plan, held))
    which = tool.passes.first
    motion = tool.transcription(problem, which)
    bounds = tool.bounds(problem, which, motion.end_residuals())
    plain, fast = PlainSteps(motion, bounds, 6), CompiledSteps(motion, bounds, 6)
    x, multipliers, radius = tool.straight(problem), None, 0.3
    for turn in range(5):
        (cost, g, violation), found = plain.value(x), fast.value(x)
        assert found[0] == pytest.approx(cost, rel=1e-12)
        np.testing.assert_allclose(found[1], g, atol=1e-9 * np.abs(g).max())
        assert found[2] == pytest.approx(violation, rel=1e-9)
        missed = np.random.default_rng(turn).uniform(size=g.shape) < 0.01
        near = Near(violation, 0.3 if turn else 0.1, 1.5 * radius, missed, multipliers)
        models = [each.model(x, g, near, proximal=0.02, penalty=2.0) for each in (plain, fast)]
        np.testing.assert_array_equal(models[1].held, models[0].held)
        for relax in (False, True):
            one, other = (each.solve(np.full(motion.nx, radius), warm=multipliers, relax=relax) for each in models)
            assert one is not None
            assert other is not None
            np.testing.assert_allclose(other.dx, one.dx, atol=1e-6 * radius)
            assert (other.left, other.gain) == pytest.approx((one.left, one.gain), rel=1e-6, abs=1e-8)
            size = np.abs(one.multipliers).max()
            np.testing.assert_allclose(other.multipliers, one.multipliers, atol=1e-4 * size)
        x, multipliers, radius = x + one.dx, one.multipliers, 0.5 * radius


@pytest.mark.parametrize("given", [False, True], ids=["from nothing", "from a plan"])
@pytest.mark.parametrize("label", some(LABELS, 2, "slow"))
def test_plans_are_as_good_as_those_of_numpy_and_daqp(label: str, given: bool) -> None:
    plan = load(label)
    tool, jury = refiner_of(plan), Jury(plan.problem, plan.robot, degree=7)
    plain = refiner_of(plan)
    plain.stage = replace(plain.stage, steps=None)
    start = {"path": plan.motion.path[0] + 0.01, "rate": 1.02 * plan.motion.rate[0]} if given else {}
    fast, slow = (refine_task(each, jury, task(plan, **start)) for each in (tool, plain))
    assert fast.valid
    assert slow.valid
    assert fast.cost == pytest.approx(slow.cost, rel=2e-4)


def test_what_is_not_solved_in_so_many_changes_is_daqps(monkeypatch: pytest.MonkeyPatch) -> None:
    exact(monkeypatch)
    plan = load("replan")
    tool, problem = refiner_of(plan), task(plan)
    motion = tool.transcription(problem, tool.passes.first)
    steps = CompiledSteps(motion, tool.bounds(problem, tool.passes.first, motion.end_residuals()), 6)
    x = tool.straight(problem)
    _, g, violation = steps.value(x)
    near = Near(violation, 0.3, 0.3, np.zeros(g.shape, bool), None)
    model, box = steps.model(x, g, near, proximal=0.02, penalty=2.0), np.full(motion.nx, 0.1)
    wanted = model.solve(box)
    monkeypatch.setattr(compiled, "CHANGES", 1)
    assert steps.solve(model, box, None, relax=False) is None
    np.testing.assert_allclose(model.solve(box).dx, wanted.dx, atol=1e-7)


def test_steps_are_numpys_where_kernels_are_not_compiled(tmp_path) -> None:
    plan = load("hit")
    kernels = problem_kernels(plan.problem, plan.robot, "numpy", tmp_path)
    assert compiled.load_steps(kernels) is None
    assert refiner_of(plan).stage.steps is not None
