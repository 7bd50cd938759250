"""Transports of several seconds: solved within their limits, and optimized again after uniform time scaling."""

import numpy as np
import pytest

from cnpgen.refine import attempts
from cnpgen.refine import refiner as refiner_module
from cnpgen.refine.solver.sqp import Result
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Outcome, RefinementTask
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.plans import PROBLEMS, ROBOTS, load
from tests.examples.refiner import refiner, task, verdict

# A start with a joint at its limit, and a goal of another start: 3.5 s, where other transports take 1.3 s.
START = (-2.5945132091534022, 2.0943951023931953, 1.4655683111694977, -2.010448647361632, -0.7675272464217613,
         0.49019704680923076, 0.28086811098966424)  # fmt: skip
GOAL = (1.3863047942929525, 1.4057591633344235, -0.2559910277347963, -0.7963404569420073, 1.9281020427410656,
        -1.6420558031787835, 0.6048804021567377)  # fmt: skip


def long_task() -> RefinementTask:
    from cnpgen.problems.obstacles import scene_of
    from cnpgen.problems.problem_record import record_problem

    problem, zero = PROBLEMS["heavy-object"], np.zeros((1, 7))
    start, goal = np.array([START]), np.array([GOAL])
    tips = record_problem(problem).tip_positions
    scene = scene_of(problem, tips(start), tips(goal))
    return RefinementTask(
        Boundary(start, zero, zero, goal, zero), scene, tips(start)[0], tips(goal)[0]
    )


def test_a_motion_of_seconds_does_not_trade_violations_for_time() -> None:
    assert START[1] == pytest.approx(
        ROBOTS["heavy-object"].position_upper[1], abs=1e-15
    )
    tool, problem = refiner("heavy-object"), long_task()
    found = refine_task(
        tool,
        PlanChecker(PROBLEMS["heavy-object"], ROBOTS["heavy-object"], degree=7),
        problem,
    )
    assert found.valid
    assert found.outcome in {
        Outcome.SOLVED,
        Outcome.SOLVED_FINE,
    }  # without another initial guess
    assert (
        tool.settings.penalty < found.cost < 3.6
    )  # the initial weight of violations suffices for shipped problems only


def attempt_after(monkeypatch: pytest.MonkeyPatch, continuations: int):
    """Return the first attempt at a transport whose coarse level ends too fast at some phases."""
    plan, tool = load("transport"), refiner("heavy-object")
    problem = task(plan)
    rate = 0.4 * plan.motion.rate[0] + 0.6 / plan.motion.duration()[0]
    x = tool.check.transcription(problem).pack(plan.motion.path[0], rate)
    monkeypatch.setattr(
        attempts, "run_coarse_level", lambda *_: Result(x, 0.0, 1.0, 1, True)
    )
    monkeypatch.setattr(refiner_module, "MAX_CONTINUATIONS", continuations)
    found = next(attempts.make_attempts(tool, problem, None))
    path, rate = tool.check.transcription(problem).unpack(found.x)
    return (
        found,
        verdict(plan, problem.boundary, path, rate).valid,
        Motion(path[None], rate[None]).duration()[0],
    )


def test_a_motion_scaled_in_time_is_optimized_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    time_scaled, valid, longer = attempt_after(monkeypatch, 0)
    assert time_scaled.outcome is Outcome.TIME_SCALED
    assert valid
    found, valid, shorter = attempt_after(monkeypatch, 4)
    assert found.outcome is Outcome.SOLVED
    assert valid
    assert shorter < 0.95 * longer
    assert found.iterations > time_scaled.iterations
