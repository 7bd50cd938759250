"""Tasks of hits: state of the arm, puck and target become the columns of a boundary problem."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.pipelines.completion import Completion
from cnpgen.pipelines.pipeline import restore_pipeline
from cnpgen.pipelines.stages.hit_angle import behind
from cnpgen.pipelines.stages.hitting_velocity import SPEED_SHARE_COLUMN
from cnpgen.pipelines.stages.stage import Context, TaskBatch
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.model import Model
from cnpgen.planner.plan_requests import drawing_stages
from cnpgen.plans.format import CONDITIONS
from cnpgen.plans.plausible import check_units_of_states
from cnpgen.robots.plausible_values import MAX_LIMIT_RATIO, check_plausible
from cnpgen.schema.arguments import check_memory_of_rows, concerning, numbers
from cnpgen.trajectory.boundary import Boundary

HIT_COLUMNS = (
    "start_q",
    "start_dq",
    "start_ddq",
    "goal_xyz",
    "hit_angle",
    SPEED_SHARE_COLUMN,
)

_ARGUMENT_OF = {
    "goal_xyz": "puck",
    "hit_angle": "target",
    SPEED_SHARE_COLUMN: "speed_share",
} | dict.fromkeys(HIT_COLUMNS[:3], "state")

State = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Positions [rad], velocities [rad/s], accelerations [rad/s^2], shape (n,) or (N, n), as from ``Plans.states_at``."""


def load_completion(model: Model, backend: str | None) -> Completion:
    """Load the pipeline stages that completed the model's training rows, with the columns of hits as input.

    Raises:
        UsageError: The model does not record its stages, or they do not complete hits.
        CnpgenError: The stages do not fit this version of cnpgen, or a backend is
            missing.
    """
    stages = model.training.get("stages")
    if stages is None:
        raise UsageError(
            "the model does not record the pipeline stages of its training rows, so it cannot plan hits"
        )
    name = str(model.training.get("dataset", {}).get("name", model.problem.name))
    with loaded_problem(model.problem, backend) as loaded:
        context = Context(loaded.problem, loaded.robot, loaded.kernels)
        # Parameters are a column only if the problem has some.
        given = (
            (*HIT_COLUMNS, "parameters") if loaded.problem.parameters else HIT_COLUMNS
        )
        return Completion(
            restore_pipeline(name, drawing_stages(stages), loaded.problem),
            context,
            given,
        )


def state_lanes(state: State, n: int) -> list[Array]:
    """Return positions, velocities and accelerations of n joints, shape (n, N) or (n, 1) each."""
    if len(state) != 3 or np.ndim(state[0]) == 0:
        raise UsageError(
            f"must be positions, velocities and accelerations, got {len(state)} values or arrays",
            argument="state",
        )
    return [lanes("state", values, {n}) for values in state]


def hit_tasks(
    completion: Completion,
    state: State,
    puck: ArrayLike,
    target: ArrayLike,
    *,
    contact_distance: float,
    share: ArrayLike,
    angle: Array | None = None,
    parameters: ArrayLike | None = None,
) -> TaskBatch:
    """Complete the tasks of N hits; see ``plan_hits``.

    Their angles [rad], shape (N,), are by default to the target.
    """
    n = completion.context.robot.n
    parts = state_lanes(state, n)
    with concerning("state"):
        states = {
            name: values.T for name, values in zip(HIT_COLUMNS[:3], parts, strict=True)
        }
        check_units_of_states(completion.context.robot, states, noun="hit")
    centre = lanes("puck", puck, {2, 3})
    goal = lanes("target", target, {2})
    direction = goal - centre[:2]
    # Equal positions have no direction.
    if not np.count_nonzero(direction, axis=0).all():
        raise UsageError(
            f"must differ from the puck's position, got {goal.T.tolist()} for both",
            argument="target",
        )
    angles = np.arctan2(direction[1:], direction[:1]) if angle is None else angle[None]
    shares = lanes(
        "speed_share", np.reshape(numbers("speed_share", share), (-1, 1)), {1}
    )
    _check_distance(completion, contact_distance, {"puck": centre, "target": goal})
    # The goal of the mallet is behind the puck, seen from the target.
    mallet = behind(centre, angles, contact_distance)
    columns = dict(zip(HIT_COLUMNS, [*parts, mallet, angles, shares], strict=True))
    columns |= _parameter_columns(completion.context, parameters)
    _check_counts(columns, completion.width)
    return completion(columns)


def _check_counts(columns: Mapping[str, Array], width: int) -> None:
    """Check that the columns have one number of hits, or 1, and that their tasks fit into the memory."""
    counts = [
        (_ARGUMENT_OF.get(column, column), values.shape[1])
        for column, values in columns.items()
    ]
    largest = max(count for _, count in counts)
    for name, count in counts:
        if count == 0:
            raise UsageError("is empty, expected at least 1 hit", argument=name)
        if count not in {1, largest}:
            raise UsageError(
                f"has {count:,} hits, another argument has {largest:,}", argument=name
            )
    check_memory_of_rows(dict(counts), width)


def _parameter_columns(
    context: Context, parameters: ArrayLike | None
) -> dict[str, Array]:
    """Return the column of the parameters, shape (width, N), if the problem has any."""
    ranges = context.problem.parameters
    if not ranges:
        if parameters is not None:
            raise UsageError(
                f"must be None: {context.problem.name!r} has no parameters",
                argument="parameters",
            )
        return {}
    values = (
        context.robot.nominal_parameters
        if parameters is None
        else numbers("parameters", parameters)
    )
    return {"parameters": ranges.checked(values).T}


def _check_distance(
    completion: Completion, contact_distance: float, positions: Mapping[str, Array]
) -> None:
    """Check that lengths are not in millimetres."""
    values = np.concatenate(
        [[contact_distance], *(values.ravel() for values in positions.values())]
    )
    if np.abs(values).max() <= MAX_LIMIT_RATIO * completion.context.robot.reach:
        # The usual case: the check takes 50 microseconds.
        return
    lengths = {"contact_distance": np.array([[contact_distance]])}
    lengths |= {name: values.T for name, values in positions.items()}
    check_plausible(
        completion.context.robot, lengths, dict.fromkeys(lengths, "m"), noun="hit"
    )


def boundary_of_tasks(tasks: TaskBatch, fixed_at_goal: int) -> Boundary:
    """Return the boundary conditions of the tasks that have an answer, with goal accelerations if they are fixed."""
    names = [
        name
        for name in CONDITIONS
        if name in tasks.columns and (name != "goal_ddq" or fixed_at_goal == 3)
    ]
    return Boundary(**{name: np.ascontiguousarray(tasks[name].T) for name in names})


def lanes(name: str, values: ArrayLike, widths: set[int]) -> Array:
    """Return values of shape (w,) or (N, w) as (w, N)."""
    array = numbers(name, values)
    if array.ndim == 1:
        array = array[None]
    if array.ndim != 2 or array.shape[1] not in widths:
        expected = " or ".join(
            f"({width},) or (N, {width})" for width in sorted(widths)
        )
        raise UsageError(
            f"must have shape {expected}, got {np.shape(values)}", argument=name
        )
    if not math.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():
        # vdot takes a third of the time
        raise UsageError(f"must be finite, got {array}", argument=name)
    return array.T
