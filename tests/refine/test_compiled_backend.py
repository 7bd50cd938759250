"""Compiled backend: equal to NumPy and DAQP up to rounding, and the same plans."""

import ctypes
import platform
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.kernels import c_library
from cnpgen.kernels.library import KernelLibrary, problem_kernels
from cnpgen.problems.load_robot import load_robot
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver import compiled_backend, sqp
from cnpgen.refine.solver.compiled_backend import CompiledBackend
from cnpgen.refine.solver.qp_subproblem import ResidualSelection
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import RefinementTask
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.conftest import needs_compiled_code, some
from tests.examples import numpy_solver
from tests.examples.chains import chain
from tests.examples.numpy_solver import NumpyBackend
from tests.examples.plans import Plan, load
from tests.examples.refiner import library, task

pytestmark = needs_compiled_code
LABELS = ("hit", "replan", "transport")


def refiner_of(plan: Plan) -> Refiner:
    """Return the refiner with the problem's own objective, including its cost term."""
    return Refiner(plan.problem, plan.robot, kernels=library(plan.problem.name))


def with_goal_acceleration(plan: Plan, constrained: bool) -> Boundary:
    return (
        replace(plan.boundary, goal_ddq=0 * plan.boundary.goal_dq + 0.3)
        if constrained
        else plan.boundary
    )


def use_tight_tolerance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the tolerance of both solvers, so that they end at the same point."""
    for module in (numpy_solver, compiled_backend):
        monkeypatch.setattr(module, "QP_TOLERANCE", 1e-10)


def compare(tool: Refiner, problem: RefinementTask, *, within: float = 1e-6) -> None:
    """Compare values, selected residuals, steps up to a fraction of the box, and multipliers at five points."""
    motion = tool.transcription(problem, tool.levels.coarse)
    bounds = tool.bounds(problem, tool.levels.coarse, motion.end_residuals())
    plain, fast = NumpyBackend(motion, bounds), CompiledBackend(motion, bounds)
    x, multipliers, radius, compared = tool.line_guess(problem), None, 0.3, 0
    for turn in range(5):
        (cost, g, violation), value = plain.value(x), fast.value(x)
        assert value[0] == pytest.approx(cost, rel=1e-12)
        np.testing.assert_allclose(value[1], g, atol=1e-9 * np.abs(g).max())
        assert value[2] == pytest.approx(violation, rel=1e-9)
        missed = np.random.default_rng(turn).uniform(size=g.shape) < 0.01
        selection = ResidualSelection(
            violation, 0.3 if turn else 0.1, 1.5 * radius, missed, multipliers
        )
        models = [
            backend.subproblem(x, g, selection, proximal=0.02, penalty=2.0)
            for backend in (plain, fast)
        ]
        np.testing.assert_array_equal(models[1].selected, models[0].selected)
        for relax in (False, True):
            one, other = (
                model.solve(np.full(motion.nx, radius), warm=multipliers, relax=relax)
                for model in models
            )
            if one is None:  # DAQP finds no step within its tolerance
                continue
            assert other is not None
            compared += 1
            np.testing.assert_allclose(other.dx, one.dx, atol=within * radius)
            assert (other.remaining, other.gain) == pytest.approx(
                (one.remaining, one.gain), rel=1e-6, abs=1e-8
            )
            size = np.abs(one.multipliers).max()
            np.testing.assert_allclose(
                other.multipliers, one.multipliers, atol=1e-4 * size
            )
        step = other if one is None else one
        assert step is not None
        x, multipliers, radius = x + step.dx, step.multipliers, 0.5 * radius
    assert compared >= 8


@pytest.mark.parametrize(
    "constrained",
    [False, True],
    ids=["goal acceleration free", "goal acceleration given"],
)
@pytest.mark.parametrize("label", some(LABELS, 1, "slow"))
def test_values_and_steps_are_those_of_numpy_and_daqp(
    label: str, constrained: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_tight_tolerance(monkeypatch)
    plan = load(label)
    compare(refiner_of(plan), task(plan, with_goal_acceleration(plan, constrained)))


@pytest.mark.slow
@pytest.mark.parametrize("points", [(7, 15, 20), (7, 10, 8), (3, 7, 4)], ids=str)
@pytest.mark.parametrize(("joints", "jerk"), [(1, False), (2, True), (9, False)])
def test_steps_of_arms_of_any_number_of_joints_are_those_of_numpy_and_daqp(
    joints: int,
    jerk: bool,
    points: tuple[int, int, int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    use_tight_tolerance(monkeypatch)
    problem = chain(tmp_path, joints, jerk=jerk)
    spec = TrajectorySpec(
        degree=points[0], path_control_points=points[1], rate_control_points=points[2]
    )
    tool = Refiner(problem, load_robot(problem), spec=spec)
    random = np.random.default_rng(joints)
    q, dq = (
        0.5 * random.normal(size=(2, 1, joints)),
        0.2 * random.normal(size=(2, 1, joints)),
    )
    for goal_ddq in (None, random.normal(size=(1, joints))):
        ends = Boundary(
            q[0], dq[0], 0.3 * random.normal(size=(1, joints)), q[1], dq[1], goal_ddq
        )
        compare(
            tool,
            RefinementTask(ends, Scene((), np.empty((1, 0))), np.zeros(3), np.zeros(3)),
            within=1e-5,
        )  # with one joint the objective is flat


@pytest.mark.skipif(
    platform.machine() != "x86_64",
    reason="of processors that have vectors of these widths",
)
@pytest.mark.parametrize("march", ["x86-64", "x86-64-v3"])
def test_no_memory_is_overwritten_with_narrower_vectors_and_all_residuals(
    march: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_tight_tolerance(monkeypatch)
    monkeypatch.setattr(c_library, "native_flags", lambda: (f"-march={march}",))
    monkeypatch.setattr(c_library, "BUILT_FOLDER", tmp_path / "none")
    plan, guards, allocate = load("replan"), [], CompiledBackend._allocate

    def guarded(self: CompiledBackend, sizes: Sequence[int]) -> list[int]:
        begins = allocate(self, [size + 1 for size in sizes])
        guards.extend(
            ctypes.c_double.from_address(at + 8 * size)
            for at, size in zip(begins, sizes, strict=True)
        )
        return begins

    monkeypatch.setattr(CompiledBackend, "_allocate", guarded)
    tool = refiner_of(plan)
    tool.residual_kernels = replace(
        tool.residual_kernels,
        step_library=compiled_backend.load_step_library(
            KernelLibrary("compiled", tmp_path, "test")
        ),
    )
    problem, level = task(plan), tool.levels.coarse
    motion = tool.transcription(problem, level)
    bounds, x = (
        tool.bounds(problem, level, motion.end_residuals()),
        tool.line_guess(problem),
    )
    plain, fast = NumpyBackend(motion, bounds), CompiledBackend(motion, bounds)
    for guard in guards:
        guard.value = np.pi
    _, g, violation = fast.value(x)
    all_selected = ResidualSelection(violation, 0.3, 0.3, np.ones(g.shape, bool), None)
    assert fast.subproblem(
        x, g, all_selected, proximal=0.02, penalty=2.0
    ).selected.all()
    few_selected = replace(all_selected, missed=~all_selected.missed)
    models = [
        backend.subproblem(x, g, few_selected, proximal=0.02, penalty=2.0)
        for backend in (plain, fast)
    ]
    one, other = (model.solve(np.full(motion.nx, 0.1)) for model in models)
    np.testing.assert_allclose(other.dx, one.dx, atol=1e-7)
    assert {guard.value for guard in guards} == {np.pi}


@pytest.mark.parametrize(
    "with_input", [False, True], ids=["without input plan", "with input plan"]
)
@pytest.mark.parametrize("label", some(LABELS, 2, "slow"))
def test_plans_are_as_good_as_those_of_numpy_and_daqp(
    label: str, with_input: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = load(label)
    tool, checker = refiner_of(plan), PlanChecker(plan.problem, plan.robot, degree=7)
    input_plan = (
        {"path": plan.motion.path[0] + 0.01, "rate": 1.02 * plan.motion.rate[0]}
        if with_input
        else {}
    )
    fast = refine_task(tool, checker, task(plan, **input_plan))
    monkeypatch.setattr(sqp, "CompiledBackend", NumpyBackend)
    slow = refine_task(refiner_of(plan), checker, task(plan, **input_plan))
    assert fast.valid
    assert slow.valid
    assert fast.cost == pytest.approx(slow.cost, rel=2e-4)


def test_a_program_with_too_many_working_set_changes_has_no_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = load("replan")
    tool, problem = refiner_of(plan), task(plan)
    motion = tool.transcription(problem, tool.levels.coarse)
    backend = CompiledBackend(
        motion, tool.bounds(problem, tool.levels.coarse, motion.end_residuals())
    )
    x = tool.line_guess(problem)
    _, g, violation = backend.value(x)
    selection = ResidualSelection(violation, 0.3, 0.3, np.zeros(g.shape, bool), None)
    model, box = (
        backend.subproblem(x, g, selection, proximal=0.02, penalty=2.0),
        np.full(motion.nx, 0.1),
    )
    assert model.solve(box) is not None
    monkeypatch.setattr(compiled_backend, "MAX_WORKING_SET_CHANGES", 1)
    assert model.solve(box) is None


def test_interpreted_kernels_are_called_from_compiled_code(tmp_path) -> None:
    plan = load("hit")
    kernels = problem_kernels(plan.problem, plan.robot, "numpy", tmp_path)
    tools = refiner_of(plan), Refiner(plan.problem, plan.robot, kernels=kernels)
    results = []
    for tool in tools:
        motion = tool.transcription(task(plan), tool.levels.coarse)
        bounds = tool.bounds(task(plan), tool.levels.coarse, motion.end_residuals())
        results.append(
            CompiledBackend(motion, bounds).value(tool.line_guess(task(plan)))
        )
    (cost, g, violation), (expected_cost, expected_g, expected_violation) = results
    assert cost == pytest.approx(expected_cost, rel=1e-9)
    np.testing.assert_allclose(g, expected_g, atol=1e-9 * np.abs(expected_g).max())
    assert violation == pytest.approx(expected_violation, rel=1e-9)
