"""Strikes: from a puck and where it is to go to the boundary problem that a planner plans for."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError, counted
from cnpgen.pipelines.completion import Completion
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.load import restore_pipeline
from cnpgen.pipelines.stages.behind_puck import behind
from cnpgen.pipelines.stages.hitting_velocity import SHARE
from cnpgen.pipelines.stages.stage import TaskRound
from cnpgen.planner.kit import surroundings
from cnpgen.planner.model import Model
from cnpgen.planner.requests import drawing_stages
from cnpgen.plans.format import BOUNDARY, CONDITIONS
from cnpgen.plans.plans import Plans
from cnpgen.schema.arguments import number, numbers
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

MEETING = 0.07  # m, from the centre of the paper's puck to that of its mallet when they meet
GIVEN = ("start_q", "start_dq", "start_ddq", "goal_xyz", "hit_angle", SHARE)

State = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Positions [rad], velocities [rad/s] and accelerations [rad/s^2], shape (n,) or (N, n) each; see ``states_at``."""


@dataclass(frozen=True, eq=False)
class Strikes:
    """What came of N strikes.

    Attributes:
        plans: Plans for those that have an answer, not checked yet; ``plans.sample_id`` says which strike each is.
        reasons: Why each strike has no answer; empty where it has one.
    """

    plans: Plans
    reasons: tuple[str, ...]

    def __repr__(self) -> str:
        return f"<{len(self.plans):,} of {counted(len(self.reasons), 'strike')} of {self.plans.problem.name!r} planned>"


def load_completion(model: Model, backend: str | None) -> Completion:
    """Load the stages that completed the rows which a model was trained on, for strikes.

    Raises:
        UsageError: The model does not say how its rows were drawn, or they were no hits.
        CnpgenError: The stages do not fit this cnpgen, or the machine lacks what it needs.
    """
    stages = model.training.get("stages")
    if stages is None:
        raise UsageError("the model does not say how the rows were drawn that it was trained on: it cannot strike")
    name = str(model.training.get("dataset", {}).get("name", model.problem.name))
    with surroundings(model.problem, backend) as given:
        context = Context(given.problem, given.robot, given.kernels)
        return Completion(restore_pipeline(name, drawing_stages(stages), given.problem), context, GIVEN)


def strike_tasks(
    completion: Completion, state: State, puck: ArrayLike, towards: ArrayLike, *, meeting: float, share: ArrayLike
) -> TaskRound:
    """Complete strikes; see ``Planner.strike``."""
    n = completion.context.robot.n
    if np.ndim(state[0]) == 0 or len(state) != 3:
        raise UsageError(f"state must be positions, velocities and accelerations, got {len(state)} values or arrays")
    parts = [_lanes(name, values, {n}) for name, values in zip(GIVEN, state, strict=False)]
    place, target = _lanes("puck", puck, {2, 3}), _lanes("towards", towards, {2})
    way = target - place[:2]
    if not np.count_nonzero(way, axis=0).all():
        raise UsageError(f"towards must be another place than the puck, got {target.T.tolist()} for both")
    angle = np.arctan2(way[1:], way[:1])
    shares = _lanes("speed_share", np.reshape(numbers("speed_share", share), (-1, 1)), {1})
    columns = [*parts, behind(place, angle, number("meeting", meeting)), angle, shares]
    counts = {name: values.shape[1] for name, values in zip(GIVEN, columns, strict=True)}
    most = max(counts.values())
    for name, count in counts.items():
        if count == 0:
            raise UsageError(f"{name} is of no strike")
        if count not in {1, most}:
            raise UsageError(f"{name} is given for {count:,} strikes, another argument for {most:,}")
    return completion(dict(zip(GIVEN, columns, strict=True)))


def boundary_of_tasks(tasks: TaskRound, fixed_at_goal: int) -> Boundary:
    """Return the boundary conditions of the tasks that have an answer, with goal accelerations where they are fixed."""
    names = BOUNDARY if fixed_at_goal == 2 else CONDITIONS
    return Boundary(*(np.ascontiguousarray(tasks[name].T) for name in names))


def _lanes(name: str, values: ArrayLike, widths: set[int]) -> Array:
    """Return values of shape (w,) or (N, w) as (w, N)."""
    array = numbers(name, values)
    if array.ndim == 1:
        array = array[None]
    if array.ndim != 2 or array.shape[1] not in widths:
        expected = " or ".join(f"({width},) or (N, {width})" for width in sorted(widths))
        raise UsageError(f"{name} must have shape {expected}, got {np.shape(values)}")
    if not math.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():  # the first in a third of the time
        raise UsageError(f"{name} must be finite, got {array}")
    return array.T
