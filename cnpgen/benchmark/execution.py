"""Execution of the results of planners, plans and sampled trajectories, in the scene of their boundary problem."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.replanning_scenario import ExecutedPrefix
from cnpgen.benchmark.results_file import answer_from_dict
from cnpgen.benchmark.simulator.execute import Execution
from cnpgen.benchmark.simulator.executed import Executed
from cnpgen.benchmark.simulator.plant import Plant
from cnpgen.benchmark.simulator.reference import StatesAt, states_of
from cnpgen.benchmark.simulator.simulate import execute_states
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.trajectory.sampled_trajectory import Trajectory

Array = NDArray[np.float64]
Task = tuple[Plans, dict[str, Any], ExecutedPrefix | None]
"""One boundary problem, the stored answer, and the executed prefix of a replanning scenario."""


def execute_answer(task: Task, *, plant: Plant) -> Executed:
    """Execute an answer; if this is impossible, ``failure`` has the reason.

    Args:
        task: The problem and the answer.
        plant: The robot.
    """
    try:
        return execution_of(task, plant).executed
    except UsageError as error:
        return Executed(failure=str(error))


def execution_of(task: Task, plant: Plant) -> Execution:
    """Execute an answer.

    Args:
        task: The problem and the answer; of a replanning scenario, the first motion is executed up to the switch.
        plant: The robot.

    Raises:
        UsageError: The answer is invalid or cannot be executed.
        RecipeError: MuJoCo cannot simulate the robot.
        MachineError: MuJoCo is missing.
    """
    problem, content, prefix = task
    states, duration = _timed(answer_from_dict(problem, content))
    if prefix is None:
        return execute_states(problem, states, duration, plant, problem.boundary.start_dq[0])
    return execute_states(problem, joined(prefix, states), float(prefix.until[0]) + duration, plant)


def joined(prefix: ExecutedPrefix, states: StatesAt) -> StatesAt:
    """Join the first part of a motion with its continuation.

    Args:
        prefix: Prefix of one motion.
        states: The continuation, from time 0.
    """
    first, until = states_of(prefix.motion), float(prefix.until[0])

    def at(t: Array) -> tuple[Array, Array, Array]:
        before, after = first(np.minimum(t, until)), states(np.maximum(t - until, 0.0))
        q, dq, ddq = (np.where((t < until)[:, None], a, b) for a, b in zip(before, after, strict=True))
        return q, dq, ddq

    return at


def _timed(answer: Plans | Trajectory) -> tuple[StatesAt, float]:
    if isinstance(answer, Plans):
        return states_of(answer.motion), float(answer.duration[0])
    return answer.states, answer.duration
