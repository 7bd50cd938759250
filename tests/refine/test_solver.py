"""The refiner: exact derivatives, plans that the independent verdict calls valid, honest outcomes."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.judges.plans import Verdict
from cnpgen.kernels.library import problem_kernels
from cnpgen.make.boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.plans import Plans
from cnpgen.problems.record import open_problem
from cnpgen.refine.engine import load_refiner, prepare, tasks_of
from cnpgen.refine.jury import Jury
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.passes import Pass
from cnpgen.refine.plans import refine_plans, solve_plans
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver import compiled, quadratic, sqp, starts
from cnpgen.refine.solver.bounds import FULL, Bounds
from cnpgen.refine.solver.compiled import CompiledSteps
from cnpgen.refine.solver.criterion import Criterion, choose_criterion, criterion_residuals
from cnpgen.refine.solver.deadline import Deadline
from cnpgen.refine.solver.grid import make_grid
from cnpgen.refine.solver.quadratic import Near, PlainSteps, Steps
from cnpgen.refine.solver.residuals import stage_jacobian, stage_values
from cnpgen.refine.solver.sqp import Settings, minimise
from cnpgen.refine.solver.transcription import ResidualKernels, Transcription
from cnpgen.refine.task import Outcome, Refined
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.spec import TrajectorySpec
from cnpgen.trajectory.spline import chebyshev
from cnpgen.world.state import World
from tests.conftest import some
from tests.examples.constraints import TipSpeed
from tests.examples.plans import PROBLEMS, Plan, load, raised
from tests.examples.refiner import library, needs_compiler, refine, refiner, refiner_of, task, tops, verdict

LABELS = ("hit", "replan", "transport")


def transcription(
    plan: Plan, points: int, boundary: Boundary | None = None, criterion: Criterion | None = None
) -> Transcription:
    kernels, spec = library(plan.problem.name), plan.problem.trajectory
    interpreted = replace(kernels, backend="numpy")  # for some points that is quicker than compiling
    residuals = None if criterion is None else interpreted.load(criterion_residuals, kind=criterion.kind)
    stage = ResidualKernels(spec, kernels.load(stage_values), kernels.load(stage_jacobian), criterion, residuals)
    return Transcription(stage, make_grid(spec, points), boundary=boundary or plan.boundary, tops=tops(plan))


def duration(found: Refined) -> float:
    return float(Motion(found.path[None], found.rate[None]).duration()[0])


@pytest.mark.parametrize("label", some(LABELS, 1, "slow"))
@pytest.mark.parametrize(
    ("kind", "goal_acceleration"),
    [(None, False), (None, True), ("centrifugal", True), ("effort", False), ("jerk", True)]
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
    motion = transcription(plan, 24, boundary, Criterion(kind, 0.3) if kind else None)
    random = np.random.default_rng(0)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0]) + 0.02 * random.normal(size=motion.nx)
    at = motion.evaluate(x)
    k, which = np.nonzero(np.ones(at.g.shape, bool))
    rows = motion.rows(at, k, which)
    step = 1e-6
    for variable in random.choice(motion.nx, 12, replace=False):
        up, down = (motion.value(x + sign * step * np.eye(motion.nx)[variable]) for sign in (1, -1))
        slope = (up[1] - down[1]).ravel() / (2 * step)
        size = 1 + np.abs(rows[:, variable]).max()
        np.testing.assert_allclose(rows[:, variable], slope, atol=2e-6 * size)
        expected = (up[0] - down[0]) / (2 * step)
        assert at.gradient[variable] == pytest.approx(expected, abs=1e-7 * (1 + np.abs(at.gradient).max()))
    assert at.cost == pytest.approx(motion.value(x)[0], rel=1e-13)
    assert np.linalg.eigvalsh(at.curvature).min() > -1e-9 * np.abs(at.curvature).max()


def test_residuals_are_the_constraints_of_the_problem_in_their_natural_sizes() -> None:
    plan = load("hit")
    motion = transcription(plan, 32)
    _, g = motion.value(motion.pack(plan.motion.path[0], plan.motion.rate[0]))
    states = plan.motion.at(motion.grid.s)
    np.testing.assert_allclose(g[:, 6:12], states.dq[0] / plan.robot.velocity_limit, atol=1e-12)
    np.testing.assert_allclose(g[:, 12:18], states.ddq[0] / plan.robot.acceleration_limit, atol=1e-10)


@pytest.mark.parametrize("kind", some(["effort", "jerk", "centrifugal"], 1, "slow"))
def test_the_objective_is_an_integral_over_time_as_pinocchio_evaluates_it(kind: str) -> None:
    plan = load("hit")
    with_it, without = (transcription(plan, 24, criterion=each) for each in (Criterion(kind, 1.0), None))
    x = without.pack(plan.motion.path[0], plan.motion.rate[0])
    added = with_it.value(x)[0] - without.value(x)[0]
    exact = Motion(without.unpack(x)[0][None], plan.motion.rate)  # with its boundary control points recomputed
    s = chebyshev(3000)
    states, world = exact.at(s), World(plan.robot, plan.problem.obstacle, plan.problem.object_size)
    density = np.empty(len(s))
    for i, state in enumerate(zip(states.q[0], states.dq[0], states.ddq[0], strict=True)):
        world.set_state(*state, tops(plan))
        v, a = np.array(world.tip_velocity), np.array(world.tip_acceleration)
        across = np.linalg.norm(a - (v @ a) / (v @ v + 1e-4) * v)
        density[i] = {
            "effort": np.sum((np.array(world.torque) / plan.robot.torque_limit) ** 2),
            "jerk": np.sum((states.jerk[0, i] / plan.robot.jerk_limit) ** 2),
            "centrifugal": np.hypot(across, 0.5) - 0.5,  # as rounded as docs/refiner.md says
        }[kind]
    near = 2e-3 if kind == "centrifugal" else 1e-3  # the rounded norm is less smooth than the sums of squares
    assert added == pytest.approx(np.trapezoid(density / states.rate[0], s), rel=near)


def test_objectives_are_chosen_by_name_and_nonsense_is_refused() -> None:
    problem = PROBLEMS["airhockey"]
    assert choose_criterion(problem) == Criterion("centrifugal", 0.01)
    assert choose_criterion(problem, "time", 0.0) is None
    assert choose_criterion(PROBLEMS["heavy-object"]) is None
    assert choose_criterion(problem, "jerk", 0.2) == Criterion("jerk", 0.2)
    with pytest.raises(UsageError, match=r"objective 'tiem' .*did you mean 'time'"):
        RefineOptions(objective="tiem")
    with pytest.raises(UsageError, match="weight= must not be negative, got -1"):
        RefineOptions(objective="effort", weight=-1.0)
    with pytest.raises(UsageError, match="tolerance= must be above 0 and below 1, got 0"):
        RefineOptions(tolerance=0)
    with pytest.raises(UsageError, match=r"max_iterations must be an integer from 0 on, got 2\.5"):
        RefineOptions(max_iterations=2.5)  # type: ignore[arg-type]


@pytest.mark.parametrize("label", LABELS)
def test_a_plan_from_nothing_is_valid_by_the_independent_verdict_and_begins_and_ends_exactly(label: str) -> None:
    plan = load(label)
    found = refine(plan)
    assert found.outcome in {Outcome.SOLVED, Outcome.SLOWED, Outcome.POLISHED, Outcome.RESTARTED}
    assert verdict(plan, plan.boundary, found.path, found.rate).valid
    states = Motion(found.path[None], found.rate[None]).at(np.array([0.0, 1.0]))
    b = plan.boundary
    np.testing.assert_allclose(states.q[0], [b.start_q[0], b.goal_q[0]], atol=1e-12)
    np.testing.assert_allclose(states.dq[0], [b.start_dq[0], b.goal_dq[0]], atol=1e-10)
    np.testing.assert_allclose(states.ddq[0, 0], b.start_ddq[0], atol=1e-9)


@pytest.mark.parametrize("label", LABELS)
def test_a_disturbed_plan_is_repaired_and_not_much_slower(label: str) -> None:
    plan = load(label)
    bent = plan.motion.path[0].copy()
    bent[3:-2] += 0.01 * np.sin(np.arange(bent[3:-2].size)).reshape(bent[3:-2].shape)
    found = refine(plan, path=bent, rate=plan.motion.rate[0] * 1.04)
    assert found.valid
    assert duration(found) < 1.02 * plan.motion.duration()[0]


@pytest.mark.parametrize(
    ("band", "up"), [(5e-3, 4e-3), (5e-3, 5.8e-3), (0.0, 8e-4), (0.0, -8e-4)], ids=["band", "beyond", "above", "below"]
)
def test_a_start_off_the_table_by_what_the_verdict_allows_is_planned_in_the_first_pass(band: float, up: float) -> None:
    plan = raised(load("hit"), up).with_constraint("Table", start_band=band)
    found = refine(plan)
    assert found.outcome is Outcome.SOLVED
    assert verdict(plan, plan.boundary, found.path, found.rate).valid


@pytest.mark.parametrize("band", some([5e-3, 0.0], 1, "slow"))
def test_a_plan_from_further_off_the_table_than_the_start_band_is_not_valid(band: float) -> None:
    high = raised(load("hit"), 0.2)
    allowed = high.with_constraint("Table", start_band=0.2)
    found = refine(allowed)
    assert verdict(allowed, high.boundary, found.path, found.rate).valid
    narrow = high.with_constraint("Table", start_band=band)
    refused = verdict(narrow, high.boundary, found.path, found.rate)
    assert refused.reason == "off the table"
    assert refused.worst.excess == pytest.approx(0.2 - band, abs=1e-6)
    assert not refine(narrow, path=found.path, rate=found.rate).valid


def test_a_goal_off_the_table_by_what_the_verdict_allows_is_planned_in_the_first_pass() -> None:
    plan = load("hit")
    low = plan.with_constraint("Table", z=float(plan.goal_xyz[0, 2]) + 5e-4)
    found = refine(low)
    assert found.outcome is Outcome.SOLVED
    assert verdict(low, low.boundary, found.path, found.rate).valid


def test_a_plan_that_is_good_comes_back_no_worse() -> None:
    plan = load("hit")
    once = refine(plan)
    again = refine(plan, path=once.path, rate=once.rate)
    assert again.valid
    assert again.cost <= once.cost


def test_a_hopeless_plan_comes_back_as_good_as_it_was() -> None:
    plan = load("hit")
    too_fast = replace(plan.boundary, goal_dq=plan.boundary.goal_dq * 3.0)
    given = {"path": plan.motion.path[0], "rate": plan.motion.rate[0]}
    found = refine(plan, too_fast, **given)
    assert not found.valid
    worst = [
        max(margin.severity for margin in verdict(plan, too_fast, *each).margins.values())
        for each in ((found.path, found.rate), tuple(given.values()))
    ]
    assert worst[0] <= worst[1]


def test_an_impossible_problem_ends_with_its_best_plan_and_says_why() -> None:
    plan = load("hit")
    too_fast = replace(plan.boundary, goal_dq=plan.boundary.goal_dq * 3.0)
    found = refine(plan, too_fast)
    assert found.outcome is Outcome.UNSOLVED
    assert found.reason in {"joint velocity limit", "joint acceleration limit"}
    assert np.isfinite(found.path).all()


@pytest.mark.parametrize(
    "garbage",
    [
        {"path": np.full((15, 6), np.nan), "rate": np.ones(20)},
        {"path": np.zeros((15, 6)), "rate": -np.ones(20)},
        {"path": np.zeros((15, 6)), "rate": np.zeros(20)},
        {"path": np.full((15, 6), 50.0), "rate": np.ones(20)},
        {"path": np.full((15, 6), 1e200), "rate": np.full(20, 1e200)},
        {"path": np.zeros((15, 6)), "rate": np.full(20, np.inf)},
    ],
    ids=["nan", "backwards", "standing", "far away", "overflow", "at once"],
)
def test_from_garbage_a_plan_is_made_from_nothing(garbage: dict[str, np.ndarray]) -> None:
    plan = load("hit")
    with np.errstate(all="ignore"):
        found = refine(plan, **garbage)
    assert found.valid


def test_boundary_conditions_that_are_no_numbers_are_said_to_be_unusable() -> None:
    plan = load("hit")
    found = refine(plan, replace(plan.boundary, goal_q=plan.boundary.goal_q * np.nan))
    assert (found.outcome, found.reason) == (Outcome.UNUSABLE, "not finite")


def test_a_goal_that_is_the_start_is_planned_too() -> None:
    plan = load("transport")
    b = plan.boundary
    still = replace(b, goal_q=b.start_q, goal_dq=b.start_dq)
    same = replace(plan, goal_xyz=plan.start_xyz, boundary=still)
    assert refine(same).valid


def test_a_motion_at_rest_that_is_too_fast_is_slowed_down_exactly() -> None:
    plan = load("transport")
    tool, asked = refiner("heavy-object"), task(plan)
    good = refine(plan)
    motion = tool.check.transcription(asked)
    x = motion.pack(good.path, good.rate * 1.1)
    _, before = tool.check.measure(asked, x)
    slowed, _, after = tool.check.slow_down(asked, motion, x)
    assert before.worst > 1 >= after.worst
    path, rate = motion.unpack(slowed)
    np.testing.assert_allclose(path, motion.unpack(x)[0], atol=1e-14)
    factors = good.rate * 1.1 / rate
    assert np.ptp(factors) < 1e-12
    assert 1.0 < factors[0] < 1.12


@pytest.mark.parametrize("kind", ["JointPosition", "JointVelocity", "JointAcceleration", "JointTorque", "Table"])
def test_a_tolerance_of_zero_is_held_exactly_or_honestly_missed(kind: str) -> None:
    plan = load("hit").with_constraint(kind, tolerance=0.0)
    tool, asked = refiner_of(plan.problem), task(plan)
    x = tool.check.transcription(asked).pack(plan.motion.path[0], plan.motion.rate[0])
    assert np.isfinite(tool.check.measure(asked, x)[1].worst)
    found = refine(plan)
    assert verdict(plan, plan.boundary, found.path, found.rate).valid == found.valid
    assert found.valid == (kind not in {"Table", "JointVelocity"})  # whose limit the goal is at


def test_where_nothing_is_allowed_a_plan_that_breaks_more_does_not_win_by_its_time() -> None:
    given = load("hit").with_constraint("JointVelocity", tolerance=0.0)
    too_fast = given.boundary.goal_dq * (1 + 1e-10)  # of hits it is the fastest that the joints allow
    plan = replace(given, boundary=replace(given.boundary, goal_dq=too_fast))
    nearly = refine(plan)
    assert not nearly.valid
    rate = nearly.rate.copy()
    rate[2:-2] *= 1.8
    found = refine(plan, path=nearly.path, rate=rate)
    assert found.outcome is Outcome.UNSOLVED
    excess = verdict(plan, plan.boundary, found.path, found.rate).margins["joint velocity"].excess
    assert 0 < excess < 1e-9


@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-3])
def test_a_plan_that_is_kept_comes_back_with_exact_ends_and_says_so_if_it_had_others(off: float) -> None:
    plan = load("hit")
    best = refine(plan)
    path = best.path + off * np.eye(len(best.path))[-1][:, None]  # its last control point
    as_it_is = refiner_of(plan.problem, settings=Settings(max_iterations=0))
    jury = Jury(plan.problem, plan.robot, degree=7)
    found = refine_task(as_it_is, jury, task(plan, path=path, rate=best.rate))
    assert found.valid
    assert found.outcome is (Outcome.ADJUSTED if off else Outcome.KEPT)
    assert np.array_equal(found.path, path) == (not off)
    ends = Motion(found.path[None], found.rate[None]).at(np.array([0.0, 1.0]))
    b = plan.boundary
    np.testing.assert_allclose(ends.q[0], [b.start_q[0], b.goal_q[0]], atol=1e-10)
    np.testing.assert_allclose(ends.dq[0], [b.start_dq[0], b.goal_dq[0]], atol=1e-10)
    np.testing.assert_allclose(ends.ddq[0, 0], b.start_ddq[0], atol=1e-10 * (1 + np.abs(b.start_ddq).max()))


@pytest.mark.parametrize(("degree", "path", "rate"), [(3, 5, 4), (3, 6, 4), (5, 7, 6), (7, 9, 8)])
def test_any_number_of_control_points_that_plans_may_have_is_refined(degree: int, path: int, rate: int) -> None:
    plan, asked = load("hit"), TrajectorySpec(degree=degree, path_control_points=path, rate_control_points=rate)
    still = replace(plan.boundary, goal_dq=0 * plan.boundary.goal_dq)
    jury = Jury(plan.problem, plan.robot, degree=degree)
    found = refine_task(refiner_of(plan.problem, spec=asked), jury, task(plan, still))
    assert (found.path.shape, found.rate.shape) == ((path, 6), (rate,))
    ends = Motion(found.path[None], found.rate[None], degree).at(np.array([0.0, 1.0])).q[0]
    np.testing.assert_allclose(ends, [still.start_q[0], still.goal_q[0]], atol=1e-12)
    assert found.valid == (degree > 3)  # the boundary conditions alone fix most of so few control points


def test_the_iteration_never_ends_worse_than_it_began() -> None:
    plan = load("replan")
    motion = transcription(plan, 48)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0])
    cost, g = motion.value(x)
    bounds = Bounds(np.full(g.shape, -1.0), np.full(g.shape, 1.0), np.zeros(g.shape, bool), np.full(g.shape, np.inf))
    result = minimise(motion, bounds, x, Settings(max_iterations=5))
    merit = Settings().penalty
    assert result.cost + merit * result.violation <= cost + merit * bounds.violation(g) + 1e-12


def test_an_iterate_lands_once_its_objective_has_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, tool = task(load("replan")), refiner("airhockey")
    landed = tool.minimise(asked, tool.passes.first, tool.straight(asked))
    monkeypatch.setattr(sqp, "LANDING", Settings().proximal)
    wandered = tool.minimise(asked, tool.passes.first, tool.straight(asked))
    assert landed.violation < Settings().violation_tolerance
    assert landed.iterations < wandered.iterations
    assert landed.cost < 1.003 * wandered.cost


@pytest.mark.slow
@pytest.mark.parametrize("label", LABELS)
def test_a_refused_step_is_never_tried_again_as_it_was(label: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = load(label)
    asked, tool = task(plan), refiner(plan.problem.name, Criterion("jerk", 1.0))
    learn, refused = sqp._Descent._learn, []

    def watch(descent: sqp._Descent, excess: np.ndarray, held: np.ndarray, size: float) -> None:
        before = descent._radius, int(descent._missed.sum())
        learn(descent, excess, held, size)
        refused.append((before, (descent._radius, int(descent._missed.sum()))))

    monkeypatch.setattr(sqp._Descent, "_learn", watch)
    tool.minimise(asked, tool.passes.first, tool.straight(asked))
    assert refused
    assert all(after[0] < before[0] or after[1] > before[1] for before, after in refused)


@pytest.mark.slow
def test_what_a_transcription_remembers_is_of_the_variables_that_it_is_asked_about() -> None:
    plan = load("hit")
    criterion = Criterion("centrifugal", 0.01)
    one = transcription(plan, 32, criterion=criterion)
    x = one.pack(plan.motion.path[0], plan.motion.rate[0])
    for asked in (x, x + 0.01, x.copy(), x):
        value, at = one.value(asked), one.evaluate(asked)
        fresh = transcription(plan, 32, criterion=criterion)
        assert value[0] == pytest.approx(fresh.value(asked.copy())[0], rel=1e-14)
        np.testing.assert_array_equal(at.gradient, fresh.evaluate(asked.copy()).gradient)
        np.testing.assert_array_equal(value[1], fresh.value(asked.copy())[1])


def test_a_first_pass_that_ends_within_its_bounds_is_offered_at_once_and_measured_only_if_refused() -> None:
    plan = load("hit")
    tool = refiner("airhockey")
    attempts = tool.attempts(task(plan), None)
    first, second = next(attempts), next(attempts)
    assert (first.outcome, first.excess) == (Outcome.SOLVED, 0.0)
    _, excess = tool.check.measure(task(plan), first.x)
    assert second.outcome is Outcome.POLISHED
    assert 0 < second.excess <= 1
    assert excess.worst < 3


def test_a_valid_plan_that_is_off_the_table_by_more_than_a_tenth_of_the_tolerance_is_polished_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sqp, "LOOKS", 0)  # which would mend it at once
    plan = load("hit")
    usual = refiner("airhockey").passes
    wide = replace(usual.first, tightening=replace(usual.first.tightening, band=0.4))
    jury = CountingJury(plan.problem, plan.robot, degree=7)

    def outcome_and_height(**passes: Pass) -> tuple[Outcome, float]:
        jury.count = 0
        found = refine_task(refiner_of(plan.problem, passes=replace(usual, **passes)), jury, task(plan))
        seen = verdict(plan, plan.boundary, found.path, found.rate)
        assert seen.valid
        return found.outcome, seen.margins["table height"].excess

    outcome, off = outcome_and_height(first=wide)
    assert (outcome, jury.count) == (Outcome.POLISHED, 2)
    assert off <= 1e-4
    _, off = outcome_and_height(first=wide, polish=replace(wide, points=256))
    assert jury.count == 2
    assert 1e-4 < off <= 1e-3
    outcome, off = outcome_and_height()
    assert (outcome, jury.count) == (Outcome.SOLVED, 1)
    assert off <= 1e-4


def test_only_what_the_ends_miss_of_equalities_makes_plans_less_precise() -> None:
    plan, check = load("hit"), refiner("airhockey").check
    fast = replace(plan.boundary, goal_dq=1.5 * plan.boundary.goal_dq)
    assert check.refutes_ends(task(plan, fast))
    assert check.imprecision_of_ends(task(plan)) < 1e-6
    off = raised(plan, 5.4e-3)  # of which the start band allows 5 mm
    assert check.imprecision_of_ends(task(off)) == pytest.approx(0.4, abs=0.01)


class CountingJury(Jury):
    count = 0

    def verdict(self, *arguments: object) -> Verdict:
        self.count += 1
        return super().verdict(*arguments)


@pytest.mark.parametrize("radius", [0.02, 0.3])
@pytest.mark.parametrize("kind", [PlainSteps, pytest.param(CompiledSteps, marks=needs_compiler)])
def test_the_step_of_a_quadratic_programme_meets_the_optimality_conditions(
    kind: type[Steps], radius: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (quadratic, compiled):  # rows are long: what is broken by 1e-6 of their length shows
        monkeypatch.setattr(module, "FEASIBLE", 1e-9)
    plan, tool = load("hit"), refiner("airhockey")
    motion = tool.transcription(task(plan), tool.passes.first)
    bounds = tool.bounds(task(plan), tool.passes.first, motion.end_residuals())
    at, steps = motion.evaluate(tool.straight(task(plan))), kind(motion, bounds, 6)
    near = Near(bounds.violation(at.g), near=0.4, leap=0.45, missed=np.zeros(at.g.shape, bool), multipliers=None)
    model = steps.model(at.x, steps.value(at.x)[1], near, proximal=0.02, penalty=2.0)
    held, box = model.held, np.full(motion.nx, radius)
    step = model.solve(box)
    assert step is not None

    k, which = np.nonzero(held)
    g, multipliers = at.g[k, which], step.multipliers[k, which]
    rows, lower, upper = motion.rows(at, k, which), bounds.lower[k, which], bounds.upper[k, which]
    reached, left = g + rows @ step.dx, np.maximum(step.left, 0.0)
    above, below = np.maximum(g - upper, 0) * left, np.maximum(lower - g, 0) * left
    free_above, free_below = np.where(g < lower, np.inf, upper + above), np.where(g > upper, -np.inf, lower - below)
    assert np.all(np.abs(step.dx) <= radius * (1 + 1e-5))
    assert np.all(reached <= free_above + 1e-5)
    assert np.all(reached >= free_below - 1e-5)
    np.testing.assert_allclose(reached[multipliers > 1e-9], free_above[multipliers > 1e-9], atol=1e-5)
    np.testing.assert_allclose(reached[multipliers < -1e-9], free_below[multipliers < -1e-9], atol=1e-5)
    slope = at.curvature @ step.dx + 0.02 * step.dx + at.gradient + rows.T @ multipliers
    inside = np.abs(step.dx) < radius * (1 - 1e-5)
    np.testing.assert_allclose(slope[inside], 0, atol=1e-6)
    assert np.all(slope[~inside] * np.sign(step.dx[~inside]) < 1e-6)
    assert inside.any()
    assert not inside.all()
    again = model.solve(box, warm=step.multipliers)
    np.testing.assert_allclose(again.dx, step.dx, atol=1e-6)
    assert model.solve(box, relax=True).left <= step.left + 1e-6


@pytest.mark.slow
def test_a_slow_down_is_as_large_as_the_bound_asks_for_whatever_its_size(tmp_path: Path) -> None:
    plan = load("transport")
    states = plan.motion.at(np.linspace(0, 1, 500))
    world, fastest = World(plan.robot, plan.problem.obstacle, plan.problem.object_size), 0.0
    for state in zip(states.q[0], states.dq[0], states.ddq[0], strict=True):
        world.set_state(*state, tops(plan))
        fastest = max(fastest, float(np.linalg.norm(world.tip_velocity)))
    limit = TipSpeed(highest=fastest / 1.05)
    problem = replace(plan.problem, constraint=(*plan.problem.constraint, limit))
    kernels = problem_kernels(problem, plan.robot, "numpy", tmp_path)
    world = World(plan.robot, problem.obstacle, problem.object_size)
    tool = Refiner(problem, plan.robot, kernels=kernels, world=world, settings=Settings(max_iterations=0))
    jury = Jury(problem, plan.robot, degree=7)
    found = refine_task(tool, jury, task(plan, path=plan.motion.path[0], rate=plan.motion.rate[0]))
    assert (found.outcome, found.reason) == (Outcome.SLOWED, "ok")
    assert 1.04 < duration(found) / plan.motion.duration()[0] < 1.06  # its residual grows with the rate's square
    asked, line = task(plan), starts.straight(plan.boundary, plan.robot.velocity_limit, tool.spec)
    assert tool.check.too_fast(asked, np.concatenate([line[0].ravel(), np.log(line[1])])) > 1.2
    assert tool.check.too_fast(asked, tool.straight(asked)) == 1


def test_four_points_tell_of_cubics_what_lies_in_the_middle_of_the_inner_two() -> None:
    grid = make_grid(PROBLEMS["airhockey"].trajectory, 24)
    cubic = np.polynomial.Polynomial([0.3, -2.0, 5.0, 7.0])
    middle = (grid.s[1:-2] + grid.s[2:-1]) / 2
    around = np.lib.stride_tricks.sliding_window_view(cubic(grid.s), 4)
    np.testing.assert_allclose((grid.midway * around).sum(axis=1), cubic(middle), atol=1e-12)


def test_bounds_are_tightened_beside_what_lies_too_far_outside_between_points() -> None:
    grid, spare, left = make_grid(PROBLEMS["airhockey"].trajectory, 128), 0.01, 50
    apex = (grid.s[left] + grid.s[left + 1]) / 2
    g = np.exp(-1000 * (grid.s - apex) ** 2)[:, None] * [1.0, 0.0]
    most = g.max()  # at both points beside the apex, which is further outside
    bounds = Bounds(np.full(g.shape, -most), np.full(g.shape, most), np.zeros(g.shape, bool), np.full(g.shape, spare))
    apart = float(grid.midway[left - 1] @ g[left - 1 : left + 3, 0]) - most
    assert apart > spare
    for sign in (1, -1):  # above and below
        tighter = bounds.tightened(sign * g, grid.midway)
        assert tighter is not None
        moved = np.nonzero((tighter.upper < bounds.upper) | (tighter.lower > bounds.lower))
        assert sorted(zip(*moved, strict=True)) == [(left, 0), (left + 1, 0)]
        assert tighter.excess(sign * g).max() == pytest.approx(apart - FULL * spare, rel=1e-6)
    assert replace(bounds, spare=np.full(g.shape, 1.2 * apart)).tightened(g, grid.midway) is None


@needs_compiler
def test_what_lies_between_points_is_mended_in_the_same_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    plans = Planner("airhockey-replan").plan_batch(draw_boundary_problems("airhockey-replan", 120, seed=7).boundary)
    found = {}
    for looks in (0, sqp.LOOKS):
        monkeypatch.setattr(sqp, "LOOKS", looks)
        found[looks] = refine_plans(plans, workers=1)
        assert found[looks].valid.all()
    polished = {looks: sum(each.outcome is Outcome.POLISHED for each in made.refined) for looks, made in found.items()}
    assert polished[0] >= 6
    assert polished[sqp.LOOKS] <= 2
    slower = found[sqp.LOOKS].plans.duration / found[0].plans.duration
    assert slower.mean() < 1.001


def test_bounds_that_an_end_widens_leave_as_much_less_to_spare() -> None:
    plan = load("hit")
    tool = refiner("airhockey")
    usual = tool.bounds(task(plan), tool.passes.first, np.full((2, len(tool.check._bounds.allowed)), np.nan))
    ends, column = np.full((2, usual.upper.shape[1]), np.nan), int(np.flatnonzero(usual.accelerated)[0])
    ends[0, column] = usual.upper[0, column] + 1e-3  # beyond its limit, within the tolerance
    wide = tool.bounds(task(plan), tool.passes.first, ends)
    assert wide.upper[0, column] > usual.upper[0, column]
    np.testing.assert_allclose((wide.upper + wide.spare)[:, column], (usual.upper + usual.spare)[:, column])


@needs_compiler
def test_what_creeps_along_its_limits_lands_in_the_same_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = draw_boundary_problems("airhockey-hit", 100, seed=90_338)[[3, 8, 19, 96]]
    polished = {}
    for nearly in (0.0, sqp.NEARLY):
        monkeypatch.setattr(sqp, "NEARLY", nearly)
        found = solve_plans(drawn, workers=1)
        assert found.valid.all()
        polished[nearly] = sum(each.outcome is Outcome.POLISHED for each in found.refined)
    assert polished[sqp.NEARLY] < polished[0.0]


@needs_compiler
def test_first_steps_from_a_plan_hold_accelerations_that_are_far_from_their_limits() -> None:
    plans = Planner("airhockey-replan").plan_batch(draw_boundary_problems("airhockey-replan", 40, seed=8).boundary)
    tool = load_refiner(*open_problem(plans.problem))
    steps = []
    for near in (sqp.NEAR, tool.passes.given.settings.near):
        given = replace(tool.passes.given, settings=replace(tool.passes.given.settings, near=near))
        each = load_refiner(tool.problem, tool.robot, passes=replace(tool.passes, given=given))
        results = [each.minimise(one, given, each.given(one)) for one in tasks_of(plans)]
        steps.append(sum(result.iterations for result in results))
    assert steps[1] < 0.95 * steps[0]


def rests(shortest: float, longest: float) -> Plans:
    """What is left of plans shortly before they end: a step of 1e-4 rad breaks their limits by its square."""
    planner = Planner("airhockey-replan")
    plans = planner.plan_batch(draw_boundary_problems("airhockey-replan", 12, seed=61).boundary)
    time = plans.duration - np.linspace(shortest, longest, len(plans))
    found = planner.replan(plans, time, goal_q=plans.boundary.goal_q, goal_dq=plans.boundary.goal_dq)
    np.testing.assert_allclose(found.duration, plans.duration - time)
    return found


@needs_compiler
def test_rests_of_hundredths_of_a_second_land_in_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    plans, steps = rests(0.04, 0.1), []
    for brief in (0.0, sqp.BRIEF):
        monkeypatch.setattr(sqp, "BRIEF", brief)
        found = refine_plans(plans, workers=1)
        assert found.valid.all()
        steps.append(sum(each.iterations for each in found.refined))
    assert steps[1] < 0.7 * steps[0]


@dataclass
class FewSteps(Deadline):
    """A deadline after so many steps, however long they take."""

    left: int = 5

    def allows(self, steps: int) -> bool:
        return steps <= self.left

    def note(self, begun: float) -> None:
        self.left -= 1


@needs_compiler
def test_before_a_deadline_rests_of_hundredths_of_a_second_land_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    plans = rests(0.02, 0.05)
    tool, landed = prepare(plans, RefineOptions()), []
    for brief in (0.0, sqp.BRIEF):
        monkeypatch.setattr(sqp, "BRIEF", brief)
        tasks = [replace(each, deadline=FewSteps(np.inf)) for each in tasks_of(plans)]
        found = [tool.minimise(each, tool.passes.given, tool.given(each)) for each in tasks]
        landed.append(sum(each.violation < tool.settings.violation_tolerance for each in found))
    assert landed[1] > landed[0] + 2
