"""Solver and strategy of the refiner: exact derivatives, plans that the independent verdict accepts, outcomes."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy_transcription import evaluate, regularized_values, residual_gradients

from cnpgen.errors import UsageError
from cnpgen.judges.plans import Verdict
from cnpgen.kernels.library import problem_kernels
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine import initial_guesses
from cnpgen.refine.attempts import make_attempts
from cnpgen.refine.grid_levels import GridLevel
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refine_engine import prepare, tasks_of
from cnpgen.refine.refine_plans import refine_plans, solve_plans
from cnpgen.refine.refinement import Refinement
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver import compiled_backend, sqp
from cnpgen.refine.solver.bounds import (
    INTERVAL_FRACTION,
    NO_TIGHTENING,
    Bounds,
    bounds_template,
)
from cnpgen.refine.solver.compiled_backend import (
    CompiledBackend,
    load_step_library,
)
from cnpgen.refine.solver.grid import make_grid
from cnpgen.refine.solver.qp_subproblem import ResidualSelection
from cnpgen.refine.solver.residuals import (
    CostTerm,
    choose_cost_term,
    cost_term_residuals,
    residual_counts,
    stage_jacobian,
    stage_values,
)
from cnpgen.refine.solver.sqp import Deadline, Settings, minimize
from cnpgen.refine.solver.transcription import ResidualKernels, Transcription
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline import chebyshev
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from cnpgen.world.world import World
from tests.conftest import needs_compiled_code, some
from tests.examples import numpy_solver
from tests.examples.constraints import TipSpeed
from tests.examples.numpy_solver import NumpyBackend
from tests.examples.plans import PROBLEMS, Plan, load, raised
from tests.examples.refiner import (
    cost_term_of,
    library,
    obstacle_poses,
    refine,
    refiner,
    refiner_of,
    task,
    verdict,
)
from tests.refusals import is_refused

LABELS = ("hit", "replan", "transport")


def transcription(
    plan: Plan,
    points: int,
    boundary: Boundary | None = None,
    cost_term: CostTerm | None = None,
) -> Transcription:
    kernels, spec = library(plan.problem.name), plan.problem.trajectory
    interpreted = replace(
        kernels, backend="numpy"
    )  # faster than compiling for few points
    residuals = (
        None
        if cost_term is None
        else interpreted.load(cost_term_residuals, terms=cost_term.tables)
    )
    counts = () if cost_term is None else residual_counts(plan.robot, cost_term)
    stages = (kernels.load(builder) for builder in (stage_values, stage_jacobian))
    step = load_step_library(kernels)
    stage = ResidualKernels(spec, *stages, step, cost_term, residuals, counts)
    return Transcription(
        stage,
        make_grid(spec, points),
        boundary=boundary or plan.boundary,
        obstacle_poses=obstacle_poses(plan),
    )


def duration(found: Attempt) -> float:
    return float(Motion(found.path[None], found.rate[None]).duration()[0])


@pytest.mark.parametrize("label", some(LABELS, 1, "slow"))
@pytest.mark.parametrize(
    ("kind", "goal_acceleration"),
    [
        (None, False),
        (None, True),
        ("centrifugal", True),
        ("effort", False),
        ("jerk", True),
    ]
    + [
        pytest.param(*each, marks=pytest.mark.extended)
        for each in (("centrifugal", False), ("effort", True), ("jerk", False))
    ],
)
def test_gradients_of_residuals_and_objective_are_those_of_finite_differences(
    label: str, goal_acceleration: bool, kind: str | None
) -> None:
    plan = load(label)
    b = plan.boundary
    boundary = replace(b, goal_ddq=b.goal_dq * 0 + 0.3) if goal_acceleration else b
    motion = transcription(
        plan, 24, boundary, cost_term_of(kind, 0.3) if kind else None
    )
    random = np.random.default_rng(0)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0]) + 0.02 * random.normal(
        size=motion.nx
    )
    at = evaluate(motion, x)
    k, residual = np.nonzero(np.ones(at.g.shape, bool))
    rows = residual_gradients(motion, at, k, residual)
    step = 1e-6
    for variable in random.choice(motion.nx, 12, replace=False):
        up, down = (
            regularized_values(motion, x + sign * step * np.eye(motion.nx)[variable])
            for sign in (1, -1)
        )
        gradient = (up[1] - down[1]).ravel() / (2 * step)
        size = 1 + np.abs(rows[:, variable]).max()
        np.testing.assert_allclose(rows[:, variable], gradient, atol=2e-6 * size)
        expected = (up[0] - down[0]) / (2 * step)
        assert at.gradient[variable] == pytest.approx(
            expected, abs=1e-7 * (1 + np.abs(at.gradient).max())
        )
    assert at.cost == pytest.approx(regularized_values(motion, x)[0], rel=1e-13)
    assert np.linalg.eigvalsh(at.curvature).min() > -1e-9 * np.abs(at.curvature).max()


def test_residuals_are_the_scaled_constraints_of_the_problem() -> None:
    plan = load("hit")
    motion = transcription(plan, 32)
    _, g = regularized_values(
        motion, motion.pack(plan.motion.path[0], plan.motion.rate[0])
    )
    states = plan.motion.at(motion.grid.s)
    np.testing.assert_allclose(
        g[:, 6:12], states.dq[0] / plan.robot.velocity_limit, atol=1e-12
    )
    np.testing.assert_allclose(
        g[:, 12:18], states.ddq[0] / plan.robot.acceleration_limit, atol=1e-10
    )


@pytest.mark.parametrize("kind", some(["effort", "jerk", "centrifugal"], 1, "slow"))
def test_the_objective_is_an_integral_over_time_as_pinocchio_evaluates_it(
    kind: str,
) -> None:
    plan = load("hit")
    with_term, without = (
        transcription(plan, 24, cost_term=term)
        for term in (cost_term_of(kind, 1.0), None)
    )
    x = without.pack(plan.motion.path[0], plan.motion.rate[0])
    added = regularized_values(with_term, x)[0] - regularized_values(without, x)[0]
    exact = Motion(
        without.unpack(x)[0][None], plan.motion.rate
    )  # with its boundary control points recomputed
    s = chebyshev(3000)
    states, world = (
        exact.at(s),
        World(plan.robot, plan.problem.obstacle, plan.problem.object_size),
    )
    density = np.empty(len(s))
    for i, state in enumerate(
        zip(states.q[0], states.dq[0], states.ddq[0], strict=True)
    ):
        world.set_state(*state, obstacle_poses(plan))
        v, a = np.array(world.tip_velocity), np.array(world.tip_acceleration)
        across = np.linalg.norm(a - (v @ a) / (v @ v + 1e-4) * v)
        density[i] = {
            "effort": np.sum((np.array(world.torque) / plan.robot.torque_limit) ** 2),
            "jerk": np.sum((states.jerk[0, i] / plan.robot.jerk_limit) ** 2),
            "centrifugal": np.hypot(across, 0.5)
            - 0.5,  # smoothed as in docs/concepts/refiner.md
        }[kind]
    tolerance = (
        2e-3 if kind == "centrifugal" else 1e-3
    )  # the smoothed norm is less smooth than sums of squares
    assert added == pytest.approx(
        np.trapezoid(density / states.rate[0], s), rel=tolerance
    )


def test_objectives_are_chosen_by_name_and_invalid_options_are_refused() -> None:
    problem = PROBLEMS["airhockey"]
    assert choose_cost_term(problem) == cost_term_of("centrifugal", 0.01)
    assert choose_cost_term(problem, "time", 0.0) is None
    assert choose_cost_term(PROBLEMS["heavy-object"]) is None
    assert choose_cost_term(problem, "jerk", 0.2) == cost_term_of("jerk", 0.2)
    with is_refused(UsageError, argument="objective"):
        RefineOptions(objective="tiem")
    with is_refused(UsageError, argument="weight"):
        RefineOptions(objective="effort", weight=-1.0)
    with is_refused(UsageError, argument="tolerance"):
        RefineOptions(tolerance=0)
    with is_refused(UsageError, argument="max_iterations"):
        RefineOptions(max_iterations=2.5)  # type: ignore[arg-type]


@pytest.mark.parametrize("label", LABELS)
def test_a_plan_without_input_is_valid_by_the_independent_verdict_and_has_exact_ends(
    label: str,
) -> None:
    plan = load(label)
    found = refine(plan)
    assert found.outcome in {
        Outcome.SOLVED,
        Outcome.TIME_SCALED,
        Outcome.SOLVED_FINE,
        Outcome.RESTARTED,
    }
    assert verdict(plan, plan.boundary, found.path, found.rate).valid
    states = Motion(found.path[None], found.rate[None]).at(np.array([0.0, 1.0]))
    b = plan.boundary
    np.testing.assert_allclose(states.q[0], [b.start_q[0], b.goal_q[0]], atol=1e-12)
    np.testing.assert_allclose(states.dq[0], [b.start_dq[0], b.goal_dq[0]], atol=1e-10)
    np.testing.assert_allclose(states.ddq[0, 0], b.start_ddq[0], atol=1e-9)


@pytest.mark.parametrize("label", LABELS)
def test_a_perturbed_plan_is_repaired_and_not_much_slower(label: str) -> None:
    plan = load(label)
    perturbed = plan.motion.path[0].copy()
    perturbed[3:-2] += 0.01 * np.sin(np.arange(perturbed[3:-2].size)).reshape(
        perturbed[3:-2].shape
    )
    found = refine(plan, path=perturbed, rate=plan.motion.rate[0] * 1.04)
    assert found.valid
    assert duration(found) < 1.02 * plan.motion.duration()[0]


@pytest.mark.parametrize(
    ("band", "up"),
    [(5e-3, 4e-3), (5e-3, 5.8e-3), (0.0, 8e-4), (0.0, -8e-4)],
    ids=["band", "tolerance", "above", "below"],
)
def test_a_start_off_the_table_within_the_tolerance_is_solved_on_the_coarse_level(
    band: float, up: float
) -> None:
    plan = raised(load("hit"), up).with_constraint("Table", start_band=band)
    found = refine(plan)
    assert found.outcome is Outcome.SOLVED
    assert verdict(plan, plan.boundary, found.path, found.rate).valid


@pytest.mark.parametrize("band", some([5e-3, 0.0], 1, "slow"))
def test_a_plan_that_starts_off_the_table_by_more_than_the_start_band_is_not_valid(
    band: float,
) -> None:
    high = raised(load("hit"), 0.2)
    allowed = high.with_constraint("Table", start_band=0.2)
    found = refine(allowed)
    assert verdict(allowed, high.boundary, found.path, found.rate).valid
    narrow = high.with_constraint("Table", start_band=band)
    refused = verdict(narrow, high.boundary, found.path, found.rate)
    assert refused.reason == "off the table"
    assert refused.worst.violation == pytest.approx(0.2 - band, abs=1e-6)
    assert not refine(narrow, path=found.path, rate=found.rate).valid


def test_a_goal_off_the_table_within_the_tolerance_is_solved_on_the_coarse_level() -> (
    None
):
    plan = load("hit")
    low = plan.with_constraint("Table", z=float(plan.goal_xyz[0, 2]) + 5e-4)
    found = refine(low)
    assert found.outcome is Outcome.SOLVED
    assert verdict(low, low.boundary, found.path, found.rate).valid


def test_an_optimal_plan_is_not_worse_after_refinement() -> None:
    plan = load("hit")
    once = refine(plan)
    again = refine(plan, path=once.path, rate=once.rate)
    assert again.valid
    assert again.cost <= once.cost


def test_the_plan_of_an_infeasible_problem_is_not_worse_after_refinement() -> None:
    plan = load("hit")
    too_fast = replace(plan.boundary, goal_dq=plan.boundary.goal_dq * 3.0)
    input_plan = {"path": plan.motion.path[0], "rate": plan.motion.rate[0]}
    found = refine(plan, too_fast, **input_plan)
    assert not found.valid
    worst = [
        max(
            margin.severity
            for margin in verdict(plan, too_fast, *control_points).margins.values()
        )
        for control_points in ((found.path, found.rate), tuple(input_plan.values()))
    ]
    assert worst[0] <= worst[1]


def test_an_infeasible_problem_gets_its_best_plan_and_a_reason() -> None:
    plan = load("hit")
    too_fast = replace(plan.boundary, goal_dq=plan.boundary.goal_dq * 3.0)
    found = refine(plan, too_fast)
    assert found.outcome is Outcome.UNSOLVED
    assert found.reason in {"joint velocity limit", "joint acceleration limit"}
    assert np.isfinite(found.path).all()


@pytest.mark.parametrize(
    "invalid",
    [
        {"path": np.full((15, 6), np.nan), "rate": np.ones(20)},
        {"path": np.zeros((15, 6)), "rate": -np.ones(20)},
        {"path": np.zeros((15, 6)), "rate": np.zeros(20)},
        {"path": np.full((15, 6), 50.0), "rate": np.ones(20)},
        {"path": np.full((15, 6), 1e200), "rate": np.full(20, 1e200)},
        {"path": np.zeros((15, 6)), "rate": np.full(20, np.inf)},
    ],
    ids=["nan", "backwards", "zero rate", "far away", "overflow", "infinite rate"],
)
def test_an_invalid_input_plan_is_not_used(invalid: dict[str, np.ndarray]) -> None:
    plan = load("hit")
    with np.errstate(all="ignore"):
        found = refine(plan, **invalid)
    assert found.valid


def test_boundary_conditions_that_are_not_finite_are_invalid_input() -> None:
    plan = load("hit")
    found = refine(plan, replace(plan.boundary, goal_q=plan.boundary.goal_q * np.nan))
    assert (found.outcome, found.reason) == (Outcome.INVALID_INPUT, "not finite")


def test_a_goal_at_the_start_is_solved() -> None:
    plan = load("transport")
    b = plan.boundary
    still = replace(b, goal_q=b.start_q, goal_dq=b.start_dq)
    same = replace(plan, goal_xyz=plan.start_xyz, boundary=still)
    assert refine(same).valid


def test_a_motion_from_rest_to_rest_that_is_too_fast_is_scaled_by_the_exact_factor() -> (
    None
):
    plan = load("transport")
    tool, problem = refiner("heavy-object"), task(plan)
    good = refine(plan)
    motion = tool.check.transcription(problem)
    x = motion.pack(good.path, good.rate * 1.1)
    _, before = tool.check.measure(problem, x)
    time_scaled, _, after = tool.check.scale_time(problem, x)
    assert before.worst > 1 >= after.worst
    path, rate = motion.unpack(time_scaled)
    np.testing.assert_allclose(path, motion.unpack(x)[0], atol=1e-14)
    factors = good.rate * 1.1 / rate
    assert np.ptp(factors) < 1e-12
    assert 1.0 < factors[0] < 1.12


@pytest.mark.parametrize(
    "kind",
    ["JointPosition", "JointVelocity", "JointAcceleration", "JointTorque", "Table"],
)
def test_a_tolerance_of_zero_is_met_exactly_or_the_plan_is_not_valid(kind: str) -> None:
    plan = load("hit").with_constraint(kind, tolerance=0.0)
    tool, problem = refiner_of(plan.problem), task(plan)
    x = tool.check.transcription(problem).pack(plan.motion.path[0], plan.motion.rate[0])
    assert np.isfinite(tool.check.measure(problem, x)[1].worst)
    found = refine(plan)
    assert verdict(plan, plan.boundary, found.path, found.rate).valid == found.valid
    assert found.valid == (
        kind not in {"Table", "JointVelocity"}
    )  # whose limit the goal is at


def test_with_zero_tolerance_a_faster_plan_with_a_larger_violation_is_not_returned() -> (
    None
):
    original = load("hit").with_constraint("JointVelocity", tolerance=0.0)
    too_fast = original.boundary.goal_dq * (
        1 + 1e-10
    )  # hits are at the limit of the joints
    plan = replace(original, boundary=replace(original.boundary, goal_dq=too_fast))
    nearly = refine(plan)
    assert not nearly.valid
    rate = nearly.rate.copy()
    rate[2:-2] *= 1.8
    found = refine(plan, path=nearly.path, rate=rate)
    assert found.outcome is Outcome.UNSOLVED
    violation = (
        verdict(plan, plan.boundary, found.path, found.rate)
        .margins["joint velocity"]
        .violation
    )
    assert 0 < violation < 1e-9


@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-3])
def test_an_input_plan_is_returned_with_exact_ends_and_reported_as_adjusted_if_that_changes_it(
    off: float,
) -> None:
    plan = load("hit")
    best = refine(plan)
    path = (
        best.path + off * np.eye(len(best.path))[-1][:, None]
    )  # its last control point
    without_iterations = refiner_of(plan.problem, max_iterations=0)
    checker = PlanChecker(plan.problem, plan.robot, degree=7)
    found = refine_task(
        without_iterations, checker, task(plan, path=path, rate=best.rate)
    )
    assert found.valid
    assert found.outcome is (Outcome.ADJUSTED if off else Outcome.UNCHANGED)
    assert np.array_equal(found.path, path) == (not off)
    ends = Motion(found.path[None], found.rate[None]).at(np.array([0.0, 1.0]))
    b = plan.boundary
    np.testing.assert_allclose(ends.q[0], [b.start_q[0], b.goal_q[0]], atol=1e-10)
    np.testing.assert_allclose(ends.dq[0], [b.start_dq[0], b.goal_dq[0]], atol=1e-10)
    np.testing.assert_allclose(
        ends.ddq[0, 0], b.start_ddq[0], atol=1e-10 * (1 + np.abs(b.start_ddq).max())
    )


@pytest.mark.parametrize(
    ("degree", "path", "rate"), [(3, 5, 4), (3, 6, 4), (5, 7, 6), (7, 9, 8)]
)
def test_plans_with_any_number_of_control_points_are_refined(
    degree: int, path: int, rate: int
) -> None:
    plan, spec = (
        load("hit"),
        TrajectorySpec(
            degree=degree, path_control_points=path, rate_control_points=rate
        ),
    )
    still = replace(plan.boundary, goal_dq=0 * plan.boundary.goal_dq)
    checker = PlanChecker(plan.problem, plan.robot, degree=degree)
    found = refine_task(refiner_of(plan.problem, spec=spec), checker, task(plan, still))
    assert (found.path.shape, found.rate.shape) == ((path, 6), (rate,))
    ends = (
        Motion(found.path[None], found.rate[None], degree).at(np.array([0.0, 1.0])).q[0]
    )
    np.testing.assert_allclose(ends, [still.start_q[0], still.goal_q[0]], atol=1e-12)
    assert found.valid == (
        degree > 3
    )  # the boundary conditions fix bound of so few control points


def test_the_iteration_never_ends_worse_than_it_began() -> None:
    plan = load("replan")
    motion = transcription(plan, 48)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0])
    cost, g = regularized_values(motion, x)
    bounds = Bounds(
        np.full(g.shape, -1.0),
        np.full(g.shape, 1.0),
        np.zeros(g.shape, bool),
        np.full(g.shape, np.inf),
    )
    result = minimize(motion, bounds, x, Settings(max_iterations=5))
    merit = Settings().penalty
    assert (
        result.cost + merit * result.violation
        <= cost + merit * bounds.max_violation(g) + 1e-12
    )


def test_an_iterate_becomes_feasible_once_its_objective_has_converged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, tool = task(load("replan")), refiner("airhockey")
    restored = tool.run_level(problem, tool.levels.coarse, tool.line_guess(problem))
    monkeypatch.setattr(sqp, "CONVERGED_PROXIMAL", Settings().proximal)
    usual = tool.run_level(problem, tool.levels.coarse, tool.line_guess(problem))
    assert restored.violation < Settings().violation_tolerance
    assert restored.iterations < usual.iterations
    assert restored.cost < 1.003 * usual.cost


@pytest.mark.slow
@pytest.mark.parametrize("label", LABELS)
def test_a_rejected_step_is_never_tried_again_unchanged(
    label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = load(label)
    problem, tool = task(plan), refiner(plan.problem.name, objective="jerk", weight=1.0)
    reject, rejections = sqp._Iterate._reject, []

    def record(
        iterate: sqp._Iterate, violations: np.ndarray, selected: np.ndarray, size: float
    ) -> None:
        before = iterate._radius, int(iterate._missed.sum())
        reject(iterate, violations, selected, size)
        rejections.append((before, (iterate._radius, int(iterate._missed.sum()))))

    monkeypatch.setattr(sqp._Iterate, "_reject", record)
    tool.run_level(problem, tool.levels.coarse, tool.line_guess(problem))
    assert rejections
    assert all(
        after[0] < before[0] or after[1] > before[1] for before, after in rejections
    )


@pytest.mark.slow
def test_cached_values_of_a_transcription_belong_to_its_variables() -> None:
    plan = load("hit")
    cost_term = cost_term_of("centrifugal", 0.01)
    motion = transcription(plan, 32, cost_term=cost_term)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0])
    for variables in (x, x + 0.01, x.copy(), x):
        value, at = regularized_values(motion, variables), evaluate(motion, variables)
        fresh = transcription(plan, 32, cost_term=cost_term)
        assert value[0] == pytest.approx(
            regularized_values(fresh, variables.copy())[0], rel=1e-14
        )
        np.testing.assert_array_equal(
            at.gradient, evaluate(fresh, variables.copy()).gradient
        )
        np.testing.assert_array_equal(
            value[1], regularized_values(fresh, variables.copy())[1]
        )


def test_a_feasible_coarse_level_is_yielded_at_once_and_measured_only_if_rejected() -> (
    None
):
    plan = load("hit")
    tool = refiner("airhockey")
    attempts = make_attempts(tool, task(plan), None)
    first, second = next(attempts), next(attempts)
    assert (first.outcome, first.violation) == (Outcome.SOLVED, 0.0)
    _, violation = tool.check.measure(task(plan), first.x)
    assert second.outcome is Outcome.SOLVED_FINE
    assert 0 < second.violation <= 1
    assert violation.worst < 3


def test_a_valid_plan_off_the_table_by_more_than_a_tenth_of_the_tolerance_is_solved_on_the_fine_level(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        sqp, "MAX_MIDPOINT_CORRECTIONS", 0
    )  # which would correct it at once
    plan = load("hit")
    usual = refiner("airhockey").levels
    wide = replace(usual.coarse, tightening=replace(usual.coarse.tightening, band=0.4))
    checker = CountingChecker(plan.problem, plan.robot, degree=7)

    def outcome_and_height(**levels: GridLevel) -> tuple[Outcome, float]:
        checker.count = 0
        found = refine_task(
            refiner_of(plan.problem, levels=replace(usual, **levels)),
            checker,
            task(plan),
        )
        result = verdict(plan, plan.boundary, found.path, found.rate)
        assert result.valid
        return found.outcome, result.margins["table height"].violation

    outcome, off = outcome_and_height(coarse=wide)
    assert (outcome, checker.count) == (Outcome.SOLVED_FINE, 2)
    assert off <= 1e-4
    _, off = outcome_and_height(coarse=wide, fine=replace(wide, points=256))
    assert checker.count == 2
    assert 1e-4 < off <= 1e-3
    outcome, off = outcome_and_height()
    assert (outcome, checker.count) == (Outcome.SOLVED, 1)
    assert off <= 1e-4


def test_only_errors_of_the_ends_in_equalities_are_accepted_in_precise_plans() -> None:
    plan, check = load("hit"), refiner("airhockey").check
    assert check.end_equality_error(task(plan)) < 1e-6
    off = raised(plan, 5.4e-3)  # the start band is 5 mm
    assert check.end_equality_error(task(off)) == pytest.approx(0.4, abs=0.01)


class CountingChecker(PlanChecker):
    count = 0

    def verdict(self, *arguments: object) -> Verdict:
        self.count += 1
        return super().verdict(*arguments)


@pytest.mark.parametrize("radius", [0.02, 0.3])
@pytest.mark.parametrize(
    "kind", [NumpyBackend, pytest.param(CompiledBackend, marks=needs_compiled_code)]
)
def test_the_solution_of_a_subproblem_meets_the_optimality_conditions(
    kind: type[NumpyBackend | CompiledBackend],
    radius: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in (
        numpy_solver,
        compiled_backend,
    ):  # a violation by 1e-6 of a row's length is too large here
        monkeypatch.setattr(module, "QP_TOLERANCE", 1e-9)
    plan, tool = load("hit"), refiner("airhockey")
    motion = tool.transcription(task(plan), tool.levels.coarse)
    bounds = tool.bounds(task(plan), tool.levels.coarse, motion.end_residuals())
    at, backend = evaluate(motion, tool.line_guess(task(plan))), kind(motion, bounds)
    selection = ResidualSelection(
        bounds.max_violation(at.g),
        max_distance=0.4,
        max_log_rate_change=0.45,
        missed=np.zeros(at.g.shape, bool),
        multipliers=None,
    )
    model = backend.subproblem(
        at.x, backend.value(at.x)[1], selection, proximal=0.02, penalty=2.0
    )
    selected, box = model.selected, np.full(motion.nx, radius)
    step = model.solve(box)
    assert step is not None

    k, residual = np.nonzero(selected)
    g, multipliers = at.g[k, residual], step.multipliers[k, residual]
    rows, lower, upper = (
        residual_gradients(motion, at, k, residual),
        bounds.lower[k, residual],
        bounds.upper[k, residual],
    )
    reached, left = g + rows @ step.dx, np.maximum(step.remaining, 0.0)
    above, below = np.maximum(g - upper, 0) * left, np.maximum(lower - g, 0) * left
    free_above, free_below = (
        np.where(g < lower, np.inf, upper + above),
        np.where(g > upper, -np.inf, lower - below),
    )
    assert np.all(np.abs(step.dx) <= radius * (1 + 1e-5))
    assert np.all(reached <= free_above + 1e-5)
    assert np.all(reached >= free_below - 1e-5)
    np.testing.assert_allclose(
        reached[multipliers > 1e-9], free_above[multipliers > 1e-9], atol=1e-5
    )
    np.testing.assert_allclose(
        reached[multipliers < -1e-9], free_below[multipliers < -1e-9], atol=1e-5
    )
    gradient = (
        at.curvature @ step.dx + 0.02 * step.dx + at.gradient + rows.T @ multipliers
    )
    inside = np.abs(step.dx) < radius * (1 - 1e-5)
    np.testing.assert_allclose(gradient[inside], 0, atol=1e-6)
    assert np.all(gradient[~inside] * np.sign(step.dx[~inside]) < 1e-6)
    assert inside.any()
    assert not inside.all()
    again = model.solve(box, warm=step.multipliers)
    np.testing.assert_allclose(again.dx, step.dx, atol=1e-6)
    assert model.solve(box, relax=True).remaining <= step.remaining + 1e-6


@pytest.mark.slow
def test_time_scaling_is_as_large_as_the_bound_of_the_tip_speed_requires(
    tmp_path: Path,
) -> None:
    plan = load("transport")
    states = plan.motion.at(np.linspace(0, 1, 500))
    world, fastest = (
        World(plan.robot, plan.problem.obstacle, plan.problem.object_size),
        0.0,
    )
    for state in zip(states.q[0], states.dq[0], states.ddq[0], strict=True):
        world.set_state(*state, obstacle_poses(plan))
        fastest = max(fastest, float(np.linalg.norm(world.tip_velocity)))
    limit = TipSpeed(highest=fastest / 1.05)
    problem = replace(plan.problem, constraint=(*plan.problem.constraint, limit))
    kernels = problem_kernels(problem, plan.robot, "numpy", tmp_path)
    tool = Refiner(
        problem,
        plan.robot,
        kernels=kernels,
        options=RefineOptions(max_iterations=0, weight=0.0),
    )
    checker = PlanChecker(problem, plan.robot, degree=7)
    found = refine_task(
        tool, checker, task(plan, path=plan.motion.path[0], rate=plan.motion.rate[0])
    )
    assert (found.outcome, found.reason) == (Outcome.TIME_SCALED, "ok")
    assert (
        1.04 < duration(found) / plan.motion.duration()[0] < 1.06
    )  # its residual grows with the rate's square
    problem = task(plan)
    line = initial_guesses.straight_line(
        plan.boundary, plan.robot.velocity_limit, tool.spec
    )
    assert (
        tool.check.speed_ratio(
            problem, np.concatenate([line[0].ravel(), np.log(line[1])])
        )
        > 1.2
    )
    assert tool.check.speed_ratio(problem, tool.line_guess(problem)) == 1


def test_midpoint_weights_interpolate_cubics_exactly() -> None:
    grid = make_grid(PROBLEMS["airhockey"].trajectory, 24)
    cubic = np.polynomial.Polynomial([0.3, -2.0, 5.0, 7.0])
    midpoint = (grid.s[1:-2] + grid.s[2:-1]) / 2
    around = np.lib.stride_tricks.sliding_window_view(cubic(grid.s), 4)
    np.testing.assert_allclose(
        (grid.midpoint_weights * around).sum(axis=1), cubic(midpoint), atol=1e-12
    )


def test_bounds_are_tightened_at_both_points_beside_a_violation_between_them() -> None:
    grid, tolerance, left = make_grid(PROBLEMS["airhockey"].trajectory, 128), 0.01, 50
    apex = (grid.s[left] + grid.s[left + 1]) / 2
    g = np.exp(-1000 * (grid.s - apex) ** 2)[:, None] * [1.0, 0.0]
    bound = g.max()  # of both points beside the apex, which is larger
    bounds = Bounds(
        np.full(g.shape, -bound),
        np.full(g.shape, bound),
        np.zeros(g.shape, bool),
        np.full(g.shape, tolerance),
    )
    violation = (
        float(grid.midpoint_weights[left - 1] @ g[left - 1 : left + 3, 0]) - bound
    )
    assert violation > tolerance
    for sign in (1, -1):  # above and below
        tighter = bounds.tightened(sign * g, grid.midpoint_weights)
        assert tighter is not None
        moved = np.nonzero(
            (tighter.upper < bounds.upper) | (tighter.lower > bounds.lower)
        )
        assert sorted(zip(*moved, strict=True)) == [(left, 0), (left + 1, 0)]
        assert tighter.violations(sign * g).max() == pytest.approx(
            violation - INTERVAL_FRACTION * tolerance, rel=1e-6
        )
    assert (
        replace(bounds, interval_tolerance=np.full(g.shape, 1.2 * violation)).tightened(
            g, grid.midpoint_weights
        )
        is None
    )


def n_solved_fine(refinement: Refinement) -> int:
    """Return the number of plans that needed a finer level."""
    return sum(result.outcome is Outcome.SOLVED_FINE for result in refinement.results)


@needs_compiled_code
def test_violations_between_points_are_corrected_on_the_same_level(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plans = Planner("airhockey-replan").plan_batch(
        draw_boundary_problems("airhockey-replan", 120, seed=7).boundary
    )
    found = {}
    for corrections in (0, sqp.MAX_MIDPOINT_CORRECTIONS):
        monkeypatch.setattr(sqp, "MAX_MIDPOINT_CORRECTIONS", corrections)
        found[corrections] = refine_plans(plans, workers=1)
        assert found[corrections].valid.all()
    fine = {
        corrections: n_solved_fine(refinement)
        for corrections, refinement in found.items()
    }
    assert fine[0] >= 6
    assert fine[sqp.MAX_MIDPOINT_CORRECTIONS] <= 2
    ratio = found[sqp.MAX_MIDPOINT_CORRECTIONS].plans.duration / found[0].plans.duration
    assert ratio.mean() < 1.001


def test_relaxed_bounds_at_an_end_reduce_the_interval_tolerance() -> None:
    plan = load("hit")
    tool = refiner("airhockey")
    usual = tool.bounds(
        task(plan),
        tool.levels.coarse,
        np.full((2, len(tool.check._bounds.tolerances)), np.nan),
    )
    ends, column = (
        np.full((2, usual.upper.shape[1]), np.nan),
        int(np.flatnonzero(usual.accelerated)[0]),
    )
    ends[0, column] = (
        usual.upper[0, column] + 1e-3
    )  # outside its limits, within the tolerance
    relaxed = tool.bounds(task(plan), tool.levels.coarse, ends)
    assert relaxed.upper[0, column] > usual.upper[0, column]
    np.testing.assert_allclose(
        (relaxed.upper + relaxed.interval_tolerance)[:, column],
        (usual.upper + usual.interval_tolerance)[:, column],
    )


@needs_compiled_code
def test_stalled_iterations_become_feasible_on_the_same_level(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = draw_boundary_problems("airhockey-hit", 100, seed=90_338)[[3, 8, 19, 96]]
    fine = {}
    for violation in (0.0, sqp.MAX_RESTORED_VIOLATION):
        monkeypatch.setattr(sqp, "MAX_RESTORED_VIOLATION", violation)
        found = solve_plans(drawn, workers=1)
        assert found.valid.all()
        fine[violation] = n_solved_fine(found)
    assert fine[sqp.MAX_RESTORED_VIOLATION] < fine[0.0]


@needs_compiled_code
def test_first_steps_from_a_plan_select_accelerations_far_from_their_limits() -> None:
    plans = Planner("airhockey-replan").plan_batch(
        draw_boundary_problems("airhockey-replan", 40, seed=8).boundary
    )
    tool = Refiner(*open_problem(plans.problem))
    steps = []
    for distances in (
        sqp.SELECTION_DISTANCES,
        tool.levels.warm.settings.selection_distances,
    ):
        warm = replace(
            tool.levels.warm,
            settings=replace(tool.levels.warm.settings, selection_distances=distances),
        )
        solver = Refiner(
            tool.problem, tool.robot, levels=replace(tool.levels, warm=warm)
        )
        results = [
            solver.run_level(problem, warm, solver.input_variables(problem))
            for problem in tasks_of(plans)
        ]
        steps.append(sum(result.iterations for result in results))
    assert steps[1] < 0.95 * steps[0]


def remaining_plans(min_duration: float, max_duration: float) -> Plans:
    """Return the ends of plans: a step of 1e-4 rad violates their limits by its square."""
    planner = Planner("airhockey-replan")
    plans = planner.plan_batch(
        draw_boundary_problems("airhockey-replan", 12, seed=61).boundary
    )
    time = plans.duration - np.linspace(min_duration, max_duration, len(plans))
    found = planner.replan(
        plans, time, goal_q=plans.boundary.goal_q, goal_dq=plans.boundary.goal_dq
    )
    np.testing.assert_allclose(found.duration, plans.duration - time)
    return found


@needs_compiled_code
def test_motions_of_hundredths_of_a_second_become_feasible_in_few_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plans, steps = remaining_plans(0.04, 0.1), []
    for short in (0.0, sqp.SHORT_MOTION_S):
        monkeypatch.setattr(sqp, "SHORT_MOTION_S", short)
        found = refine_plans(plans, workers=1)
        assert found.valid.all()
        steps.append(sum(result.iterations for result in found.results))
    assert steps[1] < 0.7 * steps[0]


@dataclass
class FewSteps(Deadline):
    """Deadline after so many steps of any duration."""

    steps_left: int = 5

    def allows(self, steps: int) -> bool:
        return steps <= self.steps_left

    def note(self, begun: float) -> None:
        self.steps_left -= 1


@needs_compiled_code
def test_before_a_deadline_motions_of_hundredths_of_a_second_become_feasible_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plans = remaining_plans(0.02, 0.05)
    tool, feasible = prepare(plans, RefineOptions()), []
    for short in (0.0, sqp.SHORT_MOTION_S):
        monkeypatch.setattr(sqp, "SHORT_MOTION_S", short)
        tasks = [replace(each, deadline=FewSteps(np.inf)) for each in tasks_of(plans)]
        found = [
            tool.run_level(each, tool.levels.warm, tool.input_variables(each))
            for each in tasks
        ]
        feasible.append(
            sum(each.violation < tool.settings.violation_tolerance for each in found)
        )
    assert feasible[1] > feasible[0] + 2


def test_equal_problems_share_their_bounds():
    plan = load("transport")
    world = World(plan.robot, plan.problem.obstacle, plan.problem.object_size)
    tight, other = (
        replace(NO_TIGHTENING, limit=0.01),
        replace(plan.problem, name="other"),
    )
    s = chebyshev(24)[1:]
    template = bounds_template(plan.problem, world, s, tight)
    assert bounds_template(replace(plan.problem), world, s.copy(), tight) is template
    others = [
        (plan.problem, s, NO_TIGHTENING),
        (plan.problem, s[:-1], tight),
        (other, s, tight),
    ]
    assert all(
        bounds_template(problem, world, phases, amount) is not template
        for problem, phases, amount in others
    )
