"""Plans with two or three spans per span of their problem are refined with the problem's own control points first."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cnpgen.plans.plans import make_plans
from cnpgen.refine import attempts
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refine_engine import prepare
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.sqp import Deadline
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Attempt, Outcome, RefinementTask
from cnpgen.trajectory.remaining_trajectory import (
    finer,
    with_fewer_knots,
    with_finer_knots,
)
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.examples.plans import Plan, load
from tests.examples.refiner import task


def slower_task(plan: Plan, spec: TrajectorySpec) -> RefinementTask:
    """Return the task of a plan that is 10 % slower except at its ends, with finer knots."""
    motion = with_finer_knots(plan.motion, spec)
    rate = motion.rate.copy()
    rate[:, 2:-2] *= 0.9
    return task(plan, path=motion.path[0], rate=rate[0])


def refined(plan: Plan, tool: Refiner, problem: RefinementTask) -> Attempt:
    return refine_task(
        tool, PlanChecker(plan.problem, plan.robot, degree=tool.spec.degree), problem
    )


def tool_of(plan: Plan, spec: TrajectorySpec) -> Refiner:
    """Return the refiner of ``refine_plans`` for plans with so many control points."""
    path, rate = (
        np.zeros((1, spec.path_control_points, plan.robot.n)),
        np.ones((1, spec.rate_control_points)),
    )
    plans = make_plans(
        plan.problem, plan.boundary, path_control_points=path, rate_control_points=rate
    )
    return prepare(plans, RefineOptions())


@pytest.mark.parametrize("spans", [2, 3])
def test_a_plan_with_more_spans_is_refined_with_the_control_points_of_its_problem(
    spans: int,
) -> None:
    plan = load("hit")
    own = plan.problem.trajectory
    problem = slower_task(plan, finer(own, spans))
    found = refined(plan, tool_of(plan, finer(own, spans)), problem)
    assert found.outcome is Outcome.SOLVED
    assert found.valid
    motion = Motion(found.path[None], found.rate[None])
    fewer = with_fewer_knots(motion, problem.boundary, own)
    again = with_finer_knots(fewer, finer(own, spans))
    np.testing.assert_allclose(again.path[0], found.path, atol=1e-9)
    np.testing.assert_allclose(again.rate[0], found.rate, rtol=1e-9)
    alone = refined(
        plan,
        tool_of(plan, own),
        replace(problem, path=fewer.path[0], rate=fewer.rate[0]),
    )
    assert (
        motion.duration()[0]
        <= 1.005 * Motion(alone.path[None], alone.rate[None]).duration()[0]
    )


def test_if_that_gives_no_valid_plan_all_control_points_are_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = load("hit")
    spec = finer(plan.problem.trajectory, 2)
    tool, problem, run_levels = (
        tool_of(plan, spec),
        slower_task(plan, spec),
        attempts.run_levels,
    )

    def violating(
        refiner: Refiner, *arguments: Any, **options: Any
    ) -> Iterator[Attempt]:
        for attempt in run_levels(refiner, *arguments, **options):
            factor = np.ones_like(attempt.rate)
            factor[3:-3] = np.exp(0.3) if refiner is tool.coarser else 1.0
            yield replace(attempt, rate=attempt.rate * factor)

    monkeypatch.setattr(attempts, "run_levels", violating)
    found = refined(plan, tool, problem)
    assert found.valid
    motion = Motion(found.path[None], found.rate[None])
    again = with_finer_knots(
        with_fewer_knots(motion, problem.boundary, plan.problem.trajectory), spec
    )
    assert np.abs(again.path[0] - found.path).max() > 1e-6


def test_plans_with_other_numbers_of_control_points_are_refined_with_their_own() -> (
    None
):
    plan = load("hit")
    own = plan.problem.trajectory
    for spec in (own, replace(own, path_control_points=own.path_control_points + 4)):
        assert tool_of(plan, spec).coarser is None


def test_if_the_problem_has_too_few_control_points_the_plan_is_refined_with_its_own() -> (
    None
):
    shipped = load("hit")
    own = TrajectorySpec(degree=7, path_control_points=8, rate_control_points=8)
    plan = replace(shipped, problem=replace(shipped.problem, trajectory=own))
    tool = Refiner(
        plan.problem,
        plan.robot,
        spec=finer(own, 2),
        coarser=Refiner(plan.problem, plan.robot),
    )
    motion = tool.check.transcription(task(plan))
    path, rate = motion.unpack(tool.line_guess(task(plan)))
    assert refined(plan, tool, task(plan, path=path, rate=rate)).valid
    too_fast = replace(
        plan.boundary, goal_dq=plan.boundary.goal_dq + 100
    )  # [rad/s], above all limits
    assert not refined(plan, tool, task(plan, too_fast, path=path, rate=rate)).valid


def test_before_a_deadline_steps_with_all_control_points_are_expected_to_take_longer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = load("hit")
    spec = finer(plan.problem.trajectory, 3)
    tool, deadline = tool_of(plan, spec), Deadline(np.inf)
    problem = replace(slower_task(plan, spec), deadline=deadline)
    x = tool.input_variables(problem)
    assert x is not None
    made = attempts.make_attempts(tool, problem, x)
    coarse = [next(made) for _ in range(3)]
    before = deadline.max_duration
    monkeypatch.setattr(attempts, "run_levels", lambda *_, **__: iter([coarse[-1]]))
    next(made)
    assert deadline.max_duration > 5 * before > 0
