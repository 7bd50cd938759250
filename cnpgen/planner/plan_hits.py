"""Plan air hockey hits: from arm state, puck and target to a boundary problem and its plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError, counted
from cnpgen.machine.threads import one_thread
from cnpgen.pipelines.completion import Completion
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.pipeline_file import restore_pipeline
from cnpgen.pipelines.stages.behind_puck import behind
from cnpgen.pipelines.stages.hitting_velocity import SPEED_SHARE_COLUMN
from cnpgen.pipelines.stages.stage import TaskBatch
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.model import Model
from cnpgen.planner.plan_requests import drawing_stages
from cnpgen.planner.planner import Planner
from cnpgen.plans.boundary_file import CONTEXT
from cnpgen.plans.format import BOUNDARY, CONDITIONS
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.problem_record import ProblemRecord, as_problem
from cnpgen.robots.plausible_values import check_plausible
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import number, numbers
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

CONTACT_DISTANCE_M = 0.07  # from the centre of the paper's puck to that of its mallet at contact
HIT_COLUMNS = ("start_q", "start_dq", "start_ddq", "goal_xyz", "hit_angle", SPEED_SHARE_COLUMN)

_ARGUMENT_OF = {"goal_xyz": "puck", "hit_angle": "target", SPEED_SHARE_COLUMN: "speed_share"} | dict.fromkeys(
    HIT_COLUMNS[:3], "state"
)

State = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Positions [rad], velocities [rad/s], accelerations [rad/s^2], shape (n,) or (N, n), as from ``Plans.states_at``."""

_COMPLETIONS: WeakKeyDictionary[Planner, Completion] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class PlannedHits:
    """Plans of N hits.

    Attributes:
        plans: Plans of the hits that have an answer, not checked yet; ``plans.sample_id`` is the index of each hit.
        reasons: Reason why a hit has no answer; empty if it has one. One entry per hit.
    """

    plans: Plans
    reasons: tuple[str, ...]

    def __repr__(self) -> str:
        return f"<{len(self.plans):,} of {counted(len(self.reasons), 'hit')} of {self.plans.problem.name!r} planned>"


@checked_arguments
@one_thread()
def plan_hits(
    planner: Planner,
    state: State,
    puck: ArrayLike,
    target: ArrayLike,
    *,
    contact_distance: float | None = None,
    speed_share: ArrayLike = 1.0,
) -> PlannedHits:
    """Plan hits from a state of the arm that send a puck towards a target.

    The pipeline stages of the model's training rows compute the goal configuration and velocity (``cnpgen.complete``
    does the same for files). They are loaded at the first call for a planner.

    Args:
        planner: A planner whose model was trained on hits.
        state: Positions [rad], velocities [rad/s] and accelerations [rad/s^2] of the arm, shape (n,) or (N, n) each,
            as returned by ``Plans.states_at``; the distance to the table must be within the tolerance of plans.
        puck: Position of the puck's centre, x and y [m], shape (2,) or (N, 2); x, y and z for problems without table.
        target: Position to hit the puck towards, x and y [m], shape (2,) or (N, 2).
        contact_distance: Distance from the puck's centre to the mallet's at the goal [m]; by default that of the
            problem's constraint ``puck-contact``, or 0.07 without one.
        speed_share: Speed of the hit as a fraction of the highest possible one, a number or shape (N,).

    Returns:
        Plans of the hits that have an answer, not checked yet, and the reasons why the others have none.

    Raises:
        UsageError: A shape is wrong, a value is not finite, the contact distance differs from that of the problem, or
            the model was not trained on hits.
    """
    completion = _COMPLETIONS.get(planner)
    if completion is None:
        completion = _COMPLETIONS[planner] = load_completion(planner.model, planner.backend)
    distance = _contact_distance(planner.model.problem, contact_distance)
    tasks = hit_tasks(completion, state, puck, target, contact_distance=distance, share=speed_share)
    columns = {name: tasks[name][0] for name in CONTEXT}
    boundary = boundary_of_tasks(tasks, planner.model.fixed_at_goal)
    return PlannedHits(planner.plan_batch(boundary, sample_id=tasks.alive, columns=columns), tasks.why())


def _contact_distance(problem: ProblemRecord, given: float | None) -> float:
    """Return the contact distance of a problem [m]; it must equal the given one, if there is any."""
    constraint = as_problem(problem).first(PuckContact)
    if given is None:
        return CONTACT_DISTANCE_M if constraint is None else constraint.contact_distance
    distance = number("contact_distance", given)
    if constraint is not None and distance != constraint.contact_distance:
        expected = f"{constraint.contact_distance:g} m, as in the problem's constraint puck-contact"
        raise UsageError(f"must be {expected}, got {distance:g} m", argument="contact_distance")
    return distance


def load_completion(model: Model, backend: str | None) -> Completion:
    """Load the pipeline stages that completed the model's training rows, with the columns of hits as input.

    Raises:
        UsageError: The model does not record its stages, or they do not complete hits.
        CnpgenError: The stages do not fit this version of cnpgen, or a backend is missing.
    """
    stages = model.training.get("stages")
    if stages is None:
        raise UsageError("the model does not record the pipeline stages of its training rows, so it cannot plan hits")
    name = str(model.training.get("dataset", {}).get("name", model.problem.name))
    with loaded_problem(model.problem, backend) as loaded:
        context = Context(loaded.problem, loaded.robot, loaded.kernels)
        return Completion(restore_pipeline(name, drawing_stages(stages), loaded.problem), context, HIT_COLUMNS)


def hit_tasks(
    completion: Completion,
    state: State,
    puck: ArrayLike,
    target: ArrayLike,
    *,
    contact_distance: float,
    share: ArrayLike,
) -> TaskBatch:
    """Complete the tasks of N hits; see ``plan_hits``."""
    n = completion.context.robot.n
    if len(state) != 3 or np.ndim(state[0]) == 0:
        raise UsageError(
            f"must be positions, velocities and accelerations, got {len(state)} values or arrays", argument="state"
        )
    parts = [_lanes("state", values, {n}) for values in state]
    centre, goal = _lanes("puck", puck, {2, 3}), _lanes("target", target, {2})
    direction = goal - centre[:2]
    if not np.count_nonzero(direction, axis=0).all():
        raise UsageError(f"must differ from the puck's position, got {goal.T.tolist()} for both", argument="target")
    angle = np.arctan2(direction[1:], direction[:1])
    shares = _lanes("speed_share", np.reshape(numbers("speed_share", share), (-1, 1)), {1})
    _check_distance(completion, contact_distance, {"puck": centre, "target": goal})
    columns = [*parts, behind(centre, angle, contact_distance), angle, shares]
    counts = {name: values.shape[1] for name, values in zip(HIT_COLUMNS, columns, strict=True)}
    largest = max(counts.values())
    for column, count in counts.items():
        name = _ARGUMENT_OF[column]
        if count == 0:
            raise UsageError("is empty, expected at least 1 hit", argument=name)
        if count not in {1, largest}:
            raise UsageError(f"has {count:,} hits, another argument has {largest:,}", argument=name)
    return completion(dict(zip(HIT_COLUMNS, columns, strict=True)))


def _check_distance(completion: Completion, contact_distance: float, positions: Mapping[str, Array]) -> None:
    """Check that lengths are not in millimetres."""
    lengths = {"contact_distance": np.array([[contact_distance]])}
    lengths |= {name: values.T for name, values in positions.items()}
    if max(np.abs(values).max(initial=0) for values in lengths.values()) < completion.context.robot.reach:
        return  # the usual case: the check takes 50 microseconds
    check_plausible(completion.context.robot, lengths, dict.fromkeys(lengths, "m"), noun="hit")


def boundary_of_tasks(tasks: TaskBatch, fixed_at_goal: int) -> Boundary:
    """Return the boundary conditions of the tasks that have an answer, with goal accelerations if they are fixed."""
    names = BOUNDARY if fixed_at_goal == 2 else CONDITIONS
    return Boundary(*(np.ascontiguousarray(tasks[name].T) for name in names))


def _lanes(name: str, values: ArrayLike, widths: set[int]) -> Array:
    """Return values of shape (w,) or (N, w) as (w, N)."""
    array = numbers(name, values)
    if array.ndim == 1:
        array = array[None]
    if array.ndim != 2 or array.shape[1] not in widths:
        expected = " or ".join(f"({width},) or (N, {width})" for width in sorted(widths))
        raise UsageError(f"must have shape {expected}, got {np.shape(values)}", argument=name)
    if not math.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():  # vdot takes a third of the time
        raise UsageError(f"must be finite, got {array}", argument=name)
    return array.T
