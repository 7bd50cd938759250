"""Steps in compiled code: those of NumPy and DAQP, but for rounding, and the same plans."""

import ctypes
import platform
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.kernels import compiler
from cnpgen.kernels.library import KernelLibrary, problem_kernels
from cnpgen.problems.robot import load_robot
from cnpgen.refine.engine import load_refiner
from cnpgen.refine.jury import Jury
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver import compiled, quadratic
from cnpgen.refine.solver.compiled import CompiledSteps
from cnpgen.refine.solver.quadratic import Near, PlainSteps
from cnpgen.refine.task import Task
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spec import TrajectorySpec
from tests.conftest import some
from tests.examples.chains import chain
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


def compare(tool: Refiner, problem: Task, *, within: float = 1e-6) -> None:
    """Compare values, held residuals, steps, within a part of the box, and multipliers at five points."""
    motion = tool.transcription(problem, tool.passes.first)
    bounds = tool.bounds(problem, tool.passes.first, motion.end_residuals())
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
            np.testing.assert_allclose(other.dx, one.dx, atol=within * radius)
            assert (other.left, other.gain) == pytest.approx((one.left, one.gain), rel=1e-6, abs=1e-8)
            size = np.abs(one.multipliers).max()
            np.testing.assert_allclose(other.multipliers, one.multipliers, atol=1e-4 * size)
        x, multipliers, radius = x + one.dx, one.multipliers, 0.5 * radius


@pytest.mark.parametrize("held", [False, True], ids=["goal acceleration free", "goal acceleration held"])
@pytest.mark.parametrize("label", some(LABELS, 1, "slow"))
def test_values_and_steps_are_those_of_numpy_and_daqp(label: str, held: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    exact(monkeypatch)
    plan = load(label)
    compare(refiner_of(plan), task(plan, free_or_held(plan, held)))


@pytest.mark.slow
@pytest.mark.parametrize("points", [(7, 15, 20), (7, 10, 8), (3, 7, 4)], ids=str)
@pytest.mark.parametrize(("joints", "jerk"), [(1, False), (2, True), (9, False)])
def test_steps_of_arms_of_any_number_of_joints_are_those_of_numpy_and_daqp(
    joints: int, jerk: bool, points: tuple[int, int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exact(monkeypatch)
    problem = chain(tmp_path, joints, jerk=jerk)
    spec = TrajectorySpec(degree=points[0], path_control_points=points[1], rate_control_points=points[2])
    tool = load_refiner(problem, load_robot(problem), spec=spec)
    random = np.random.default_rng(joints)
    q, dq = 0.5 * random.normal(size=(2, 1, joints)), 0.2 * random.normal(size=(2, 1, joints))
    for goal_ddq in (None, random.normal(size=(1, joints))):
        ends = Boundary(q[0], dq[0], 0.3 * random.normal(size=(1, joints)), q[1], dq[1], goal_ddq)
        compare(tool, Task(ends, np.zeros(0), np.zeros(3), np.zeros(3)), within=1e-5)  # one joint: flat


@pytest.mark.skipif(platform.machine() != "x86_64", reason="of processors that have vectors of these widths")
@pytest.mark.parametrize("march", ["x86-64", "x86-64-v3"])
def test_with_narrower_vectors_and_all_residuals_held_no_memory_is_left(
    march: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exact(monkeypatch)
    monkeypatch.setattr(compiler, "vector_flags", lambda: (f"-march={march}",))
    plan, guards, room = load("replan"), [], CompiledSteps._room

    def guarded(self: CompiledSteps, sizes: Sequence[int]) -> list[int]:
        begins = room(self, [size + 1 for size in sizes])
        guards.extend(ctypes.c_double.from_address(at + 8 * size) for at, size in zip(begins, sizes, strict=True))
        return begins

    monkeypatch.setattr(CompiledSteps, "_room", guarded)
    tool = refiner_of(plan)
    tool.stage = replace(tool.stage, steps=compiled.load_steps(KernelLibrary("compiled", tmp_path, "test")))
    problem, which = task(plan), tool.passes.first
    motion = tool.transcription(problem, which)
    bounds, x = tool.bounds(problem, which, motion.end_residuals()), tool.straight(problem)
    plain, fast = PlainSteps(motion, bounds, 6), CompiledSteps(motion, bounds, 6)
    for guard in guards:
        guard.value = np.pi
    _, g, violation = fast.value(x)
    all_held = Near(violation, 0.3, 0.3, np.ones(g.shape, bool), None)
    assert fast.model(x, g, all_held, proximal=0.02, penalty=2.0).held.all()
    few_held = replace(all_held, missed=~all_held.missed)
    models = [each.model(x, g, few_held, proximal=0.02, penalty=2.0) for each in (plain, fast)]
    one, other = (each.solve(np.full(motion.nx, 0.1)) for each in models)
    np.testing.assert_allclose(other.dx, one.dx, atol=1e-7)
    assert {guard.value for guard in guards} == {np.pi}


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
