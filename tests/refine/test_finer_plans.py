"""Plans with two or three spans for each of their problem's: refined with the problem's own control points first."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.plans.plans import make_plans
from cnpgen.refine.engine import load_refiner, prepare
from cnpgen.refine.jury import Jury
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.deadline import Deadline
from cnpgen.refine.task import Attempt, Outcome, Refined, Task
from cnpgen.trajectory.motion import Motion
from cnpgen.trajectory.rest import finer, with_fewer_knots, with_finer_knots
from cnpgen.trajectory.spec import TrajectorySpec
from tests.examples.plans import Plan, load
from tests.examples.refiner import task


def slower(plan: Plan, spec: TrajectorySpec) -> Task:
    """The boundary problem of a plan, which begins and ends as it does, 10 % slower in between, with other knots."""
    motion = with_finer_knots(plan.motion, spec)
    rate = motion.rate.copy()
    rate[:, 2:-2] *= 0.9
    return task(plan, path=motion.path[0], rate=rate[0])


def refined(plan: Plan, tool: Refiner, asked: Task) -> Refined:
    return refine_task(tool, Jury(plan.problem, plan.robot, degree=tool.spec.degree), asked)


def tool_of(plan: Plan, spec: TrajectorySpec) -> Refiner:
    """The refiner that ``refine_plans`` takes for plans with so many control points."""
    path, rate = np.zeros((1, spec.path_control_points, plan.robot.n)), np.ones((1, spec.rate_control_points))
    plans = make_plans(plan.problem, plan.boundary, path_control_points=path, rate_control_points=rate)
    return prepare(plans, RefineOptions())


@pytest.mark.parametrize("spans", [2, 3])
def test_a_plan_with_more_spans_is_refined_with_the_control_points_of_its_problem(spans: int) -> None:
    plan = load("hit")
    own = plan.problem.trajectory
    asked = slower(plan, finer(own, spans))
    found = refined(plan, tool_of(plan, finer(own, spans)), asked)
    assert found.outcome is Outcome.SOLVED
    assert found.valid
    motion = Motion(found.path[None], found.rate[None])
    fewer = with_fewer_knots(motion, asked.boundary, own)
    again = with_finer_knots(fewer, finer(own, spans))
    np.testing.assert_allclose(again.path[0], found.path, atol=1e-9)
    np.testing.assert_allclose(again.rate[0], found.rate, rtol=1e-9)
    alone = refined(plan, tool_of(plan, own), replace(asked, path=fewer.path[0], rate=fewer.rate[0]))
    assert motion.duration()[0] <= 1.005 * Motion(alone.path[None], alone.rate[None]).duration()[0]


def test_where_that_gives_no_valid_plan_all_of_its_control_points_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = load("hit")
    spec = finer(plan.problem.trajectory, 2)
    tool, asked, passes = tool_of(plan, spec), slower(plan, spec), Refiner._passes

    def over_its_limits(self: Refiner, *arguments: object) -> Iterator[Attempt]:
        for attempt in passes(self, *arguments):  # type: ignore[arg-type]
            faster = np.zeros_like(attempt.x)
            faster[-self.spec.rate_control_points + 3 : -3] = 0.3 if self is tool.coarser else 0.0
            yield replace(attempt, x=attempt.x + faster)

    monkeypatch.setattr(Refiner, "_passes", over_its_limits)
    found = refined(plan, tool, asked)
    assert found.valid
    motion = Motion(found.path[None], found.rate[None])
    again = with_finer_knots(with_fewer_knots(motion, asked.boundary, plan.problem.trajectory), spec)
    assert np.abs(again.path[0] - found.path).max() > 1e-6


def test_plans_with_other_numbers_of_control_points_are_refined_with_their_own() -> None:
    plan = load("hit")
    own = plan.problem.trajectory
    for spec in (own, replace(own, path_control_points=own.path_control_points + 4)):
        assert tool_of(plan, spec).coarser is None


def test_where_the_problem_has_too_few_control_points_the_plan_is_refined_with_its_own() -> None:
    shipped = load("hit")
    own = TrajectorySpec(degree=7, path_control_points=8, rate_control_points=8)
    plan = replace(shipped, problem=replace(shipped.problem, trajectory=own))
    tool = load_refiner(plan.problem, plan.robot, spec=finer(own, 2), coarser=load_refiner(plan.problem, plan.robot))
    motion = tool.check.transcription(task(plan))
    path, rate = motion.unpack(tool.straight(task(plan)))
    assert refined(plan, tool, task(plan, path=path, rate=rate)).valid
    beyond = replace(plan.boundary, goal_dq=plan.boundary.goal_dq + 100)  # faster than any joint may be
    assert not refined(plan, tool, task(plan, beyond, path=path, rate=rate)).valid


def test_before_a_deadline_steps_with_all_control_points_are_known_to_take_longer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = load("hit")
    spec = finer(plan.problem.trajectory, 3)
    tool, deadline = tool_of(plan, spec), Deadline(np.inf)
    asked = replace(slower(plan, spec), deadline=deadline)
    attempts, given = tool.attempts(asked, tool.given(asked)), tool.given(asked)
    assert given is not None
    coarse = [next(attempts) for _ in range(3)]
    before = deadline.longest
    monkeypatch.setattr(tool, "_passes", lambda *_: iter([coarse[-1]]))
    next(attempts)
    assert deadline.longest > 5 * before > 0
