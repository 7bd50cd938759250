"""What planners return, executed: plans and sampled trajectories alike, in the scene of their boundary problem."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.replanning_scenario import Lead
from cnpgen.benchmark.results import answer_from_dict
from cnpgen.benchmark.simulator.execute import Execution
from cnpgen.benchmark.simulator.executed import Executed
from cnpgen.benchmark.simulator.plant import Plant
from cnpgen.benchmark.simulator.reference import Reference, StatesAt, states_of
from cnpgen.benchmark.simulator.simulate import execute_states
from cnpgen.benchmark.simulator.simulator_scene import Scene
from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans

Array = NDArray[np.float64]
Task = tuple[Plans, dict[str, Any], Lead | None]
"""One boundary problem, the answer as results keep it, and of a turn the first motion."""


def execute_answer(task: Task, *, plant: Plant) -> Executed:
    """Execute what a planner returned; what cannot be executed is said in ``failure``.

    Args:
        task: The problem and the answer.
        plant: The robot.
    """
    try:
        return execution_of(task, plant)[2].executed
    except UsageError as error:
        return Executed(failure=str(error))


def execution_of(task: Task, plant: Plant) -> tuple[Scene, Reference, Execution]:
    """Execute what a planner returned.

    Args:
        task: The problem and the answer; of a turn, the first motion is executed up to the turn.
        plant: The robot.

    Returns:
        The world, what the controller followed, and what happened.

    Raises:
        UsageError: It cannot be executed, or is no answer.
        RecipeError: MuJoCo cannot simulate the robot.
        MachineError: MuJoCo is missing.
    """
    problem, content, lead = task
    states, duration = _timed(answer_from_dict(problem, content))
    if lead is None:
        return execute_states(problem, states, duration, plant, problem.boundary.start_dq[0])
    return execute_states(problem, joined(lead, states), float(lead.until[0]) + duration, plant)


def joined(lead: Lead, states: StatesAt) -> StatesAt:
    """Join the first part of a motion with what follows at the turn.

    Args:
        lead: One first motion.
        states: What follows, from time 0 on.
    """
    first, until = states_of(lead.motion), float(lead.until[0])

    def at(t: Array) -> tuple[Array, Array, Array]:
        before, after = first(np.minimum(t, until)), states(np.maximum(t - until, 0.0))
        q, dq, ddq = (np.where((t < until)[:, None], a, b) for a, b in zip(before, after, strict=True))
        return q, dq, ddq

    return at


def _timed(answer: Plans | Trajectory) -> tuple[StatesAt, float]:
    if isinstance(answer, Plans):
        return states_of(answer.motion), float(answer.duration[0])
    return answer.states, answer.duration
