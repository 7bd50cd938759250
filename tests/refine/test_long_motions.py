"""Transports that take seconds: they are solved rather than left breaking limits, and iterated on where slowed down."""

import numpy as np
import pytest

from cnpgen.refine import refiner as refiner_module
from cnpgen.refine.jury import Jury
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.sqp import Result
from cnpgen.refine.task import Outcome, Task
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion
from tests.examples.plans import PROBLEMS, ROBOTS, load
from tests.examples.refiner import refiner, task, verdict

# A start with a joint at its limit, and a goal that was found from another start: 3.5 s, where others take 1.3 s.
START = (-2.5945132091534022, 2.0943951023931953, 1.4655683111694977, -2.010448647361632, -0.7675272464217613,
         0.49019704680923076, 0.28086811098966424)  # fmt: skip
GOAL = (1.3863047942929525, 1.4057591633344235, -0.2559910277347963, -0.7963404569420073, 1.9281020427410656,
        -1.6420558031787835, 0.6048804021567377)  # fmt: skip


def long_task() -> Task:
    from cnpgen.problems.obstacles import obstacle_tops
    from cnpgen.problems.record import record_problem

    problem, zero = PROBLEMS["heavy-object"], np.zeros((1, 7))
    start, goal = np.array([START]), np.array([GOAL])
    tips = record_problem(problem).tip_positions
    tops = obstacle_tops(problem, tips(start), tips(goal))[0]
    return Task(Boundary(start, zero, zero, goal, zero), tops, tips(start)[0], tips(goal)[0])


def test_slowing_down_pays_in_a_motion_of_seconds_too() -> None:
    assert START[1] == pytest.approx(ROBOTS["heavy-object"].position_upper[1], abs=1e-15)
    tool, asked = refiner("heavy-object"), long_task()
    found = refine_task(tool, Jury(PROBLEMS["heavy-object"], ROBOTS["heavy-object"], degree=7), asked)
    assert found.valid
    assert found.outcome in {Outcome.SOLVED, Outcome.POLISHED}  # one start is enough
    assert tool.settings.penalty < found.cost < 3.6  # a weight of violations that was enough for shipped problems


def attempt_after(monkeypatch: pytest.MonkeyPatch, rounds: int):
    """The first attempt at a transport whose first pass ends with a rate that is too even: somewhere too fast."""
    plan, tool = load("transport"), refiner("heavy-object")
    asked = task(plan)
    rate = 0.4 * plan.motion.rate[0] + 0.6 / plan.motion.duration()[0]
    x = tool.check.transcription(asked).pack(plan.motion.path[0], rate)
    monkeypatch.setattr(Refiner, "_first", lambda *_: Result(x, 0.0, 1.0, 1, True))
    monkeypatch.setattr(refiner_module, "ROUNDS", rounds)
    found = next(tool.attempts(asked, None))
    path, rate = tool.check.transcription(asked).unpack(found.x)
    return found, verdict(plan, asked.boundary, path, rate).valid, Motion(path[None], rate[None]).duration()[0]


def test_a_motion_that_was_slowed_down_is_iterated_on_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    slowed, valid, longer = attempt_after(monkeypatch, 0)
    assert slowed.outcome is Outcome.SLOWED
    assert valid
    found, valid, shorter = attempt_after(monkeypatch, 4)
    assert found.outcome is Outcome.SOLVED
    assert valid
    assert shorter < 0.95 * longer
    assert found.iterations > slowed.iterations
