"""Completion of tasks: the stages of a pipeline compute the missing columns of tasks without random sampling."""

from collections.abc import Collection, Iterable, Mapping

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError, lacks
from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.pipelines.acceptance import acceptance
from cnpgen.pipelines.pipeline import (
    Pipeline,
    PipelineStep,
    prepare_steps,
    steps_of,
    stored_fields,
    written_columns,
)
from cnpgen.pipelines.stages.stage import Context, TaskBatch
from cnpgen.problems.constraints.constraint import End
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import table_frame_of
from cnpgen.store.field import Field

# Joint positions or a tip position.
_EXCLUSIVE_COLUMNS = ("start_q", "start_xyz"), ("goal_q", "goal_xyz")


class Completion:
    """Stages of a pipeline, prepared for tasks with a fixed set of columns.

    A task without start columns starts at rest at the base configuration. Tip positions
    follow from given joint positions.

    Attributes:
        context: Problem, robot and kernels.
        given: Columns of the tasks: name -> field.
        height: Tip height on the problem's table [m], the default z of positions; None
            without a table.
    """

    def __init__(
        self, pipeline: Pipeline, context: Context, given: Collection[str]
    ) -> None:
        steps = steps_of(pipeline)
        fields = given_fields(steps, context)
        _check(pipeline, fields, given)
        self.context = context
        self.given = {name: fields[name] for name in given}
        # Tasks have no columns of the bookkeeping fields.
        self._fields = stored_fields(steps, context)
        self.height = table_height(context)
        self._derived = _derived(given)
        known = {*given, *self._derived}
        written = written_columns(pipeline.path, steps, context)
        self._tip = context.kernels.load(tip_position)
        self._stages = prepare_steps(
            _of_tasks(steps, context), lambda stage: stage.complete(context, known)
        )
        # Joint states of the user, and the base configuration of the problem file,
        # are rounded: the tolerances of motions apply to them.
        ends: tuple[End, ...] = ("start", "goal")
        stated = [
            end for end in ends if {f"{end}_q", f"{end}_dq", f"{end}_ddq"} & known
        ]
        self._accept = acceptance(context, written, given=stated)
        # For plug-ins that bypass candidates.draw.
        self._random = np.random.default_rng(0)

    @property
    def width(self) -> int:
        """Number of values of a completed task."""
        return sum(max(field.width, 1) for field in self._fields)

    def __call__(self, columns: Mapping[str, Array]) -> TaskBatch:
        """Complete N tasks independently of each other; unsolved tasks are rejected with an outcome.

        The given columns have shape (width, N), or (width, 1) for all tasks. Positions
        on a table may omit the height.
        """
        candidates = TaskBatch(max(values.shape[1] for values in columns.values()))
        for name, values in columns.items():
            # Positions on a table may have x and y only.
            flat = len(values) == 2 and name.endswith("_xyz")
            whole = (
                self._on_table(values, columns.get("parameters")) if flat else values
            )
            same = (
                whole
                if whole.shape[1] == candidates.size
                else np.broadcast_to(whole, (len(whole), candidates.size))
            )
            candidates[name] = np.ascontiguousarray(same)
        # Joint positions are derived before the tip positions that follow from them.
        for name in self._derived:
            if name == "start_q":
                candidates[name] = np.repeat(
                    self.context.robot.home[:, None], candidates.size, axis=1
                )
            else:
                candidates[name] = self.tip_positions(
                    candidates[name.replace("xyz", "q")]
                )
        for label, run_stage in self._stages:
            candidates.stage = label
            run_stage(candidates, self._random)
        candidates.stage = "acceptance"
        self._accept(candidates, self._random)
        if len(candidates.alive) < candidates.size:
            self._name_touching_starts(candidates)
        return candidates

    def tip_positions(self, q: Array) -> Array:
        """Compute tip positions [m], shape (3, N), at joint positions q [rad], shape (n, N)."""
        (position,) = self._tip(np.ascontiguousarray(q))
        return np.asarray(position)

    def rows(self, tasks: TaskBatch) -> dict[str, Array]:
        """Return the fields of the M solved tasks in the layout of a dataset, shape (M, width), or (M,) for scalars."""
        fields = [field for field in self._fields if field.name in tasks.columns]
        return {
            field.name: np.ascontiguousarray(tasks[field.name].T)
            if field.width
            else tasks[field.name][0]
            for field in fields
        }

    def _name_touching_starts(self, tasks: TaskBatch) -> None:
        """Set the reason of rejected hits whose start touches the puck, which earlier stages do not notice."""
        problem = self.context.problem
        drawn = tasks.drawn
        contact = problem.first(PuckContact)
        if (
            contact is None
            or not {"start_xyz", "goal_xyz", "hit_angle"} <= drawn.keys()
        ):
            return
        start = drawn["start_xyz"].T
        goal = drawn["goal_xyz"].T
        angle = drawn["hit_angle"][0]
        frame = table_frame_of(
            problem, drawn["parameters"].T if problem.parameters else None
        )
        if frame is not None:
            start = frame.to_table(start)
            goal = frame.to_table(goal)
        # Unit velocity along the hit: only its direction determines the puck.
        direction = np.stack(
            [np.cos(angle), np.sin(angle), np.zeros(tasks.size)], axis=1
        )
        touching = contact.touches(start, contact.scene_values(goal, direction)) & (
            tasks.outcome > 0
        )
        tasks.outcome[touching] = 1 + tasks.reasons.index(contact.boundary_reason)

    def _on_table(self, values: Array, parameters: Array | None) -> Array:
        """Return positions on the table of the tasks, shape (2, N), in the world frame, shape (3, N)."""
        positions = np.concatenate([values, np.full((1, values.shape[1]), self.height)])
        if parameters is None or not self.context.problem.parameters.tilts_table:
            return positions
        count = max(positions.shape[1], parameters.shape[1])
        frame = table_frame_of(
            self.context.problem,
            np.broadcast_to(parameters.T, (count, len(parameters))),
        )
        assert frame is not None
        return frame.to_world(np.broadcast_to(positions.T, (count, 3))).T


def table_height(context: Context) -> float | None:
    """Return the tip height on the problem's table [m].

    None if the problem has no table.
    """
    table = context.problem.first(Table)
    return None if table is None else table.z


def given_fields(steps: Iterable[PipelineStep], context: Context) -> dict[str, Field]:
    """Return the columns that tasks may have: name -> field."""
    return {
        field.name: field for step in steps for field in step.stage.task_inputs(context)
    }


def _check(
    pipeline: Pipeline, fields: Mapping[str, Field], given: Collection[str]
) -> None:
    """Raise UsageError for columns that the pipeline does not accept or that exclude each other, or without a goal."""
    for name in given:
        if name not in fields:
            raise UsageError(
                f"the pipeline {pipeline.name!r} {lacks('column to give', name, fields)}",
                concerns=name,
            )
    for joints, position in _EXCLUSIVE_COLUMNS:
        if joints in given and position in given:
            raise UsageError(
                f"{joints} and {position} are both given: joint positions determine the tip position, give one of them",
                concerns=position,
            )
    if not {"goal_q", "goal_xyz"} & set(given):
        raise UsageError(
            f"tasks of the pipeline {pipeline.name!r} must give goal_xyz, the tip position of the goal",
            concerns="goal_xyz",
        )


def _derived(given: Collection[str]) -> tuple[str, ...]:
    """List the columns that are derived from the given columns before the first stage, in order."""
    start = (
        ()
        if "start_xyz" in given
        else ("start_xyz",)
        if "start_q" in given
        else ("start_q", "start_xyz")
    )
    return start if "goal_xyz" in given else (*start, "goal_xyz")


def _of_tasks(steps: Iterable[PipelineStep], context: Context) -> list[PipelineStep]:
    """Omit stages that write or read columns which a later stage replaces: tasks need only the replaced values."""
    kept: list[PipelineStep] = []
    for step in steps:
        replaced = set(step.stage.replaces)
        kept = [
            other
            for other in kept
            if not replaced & {*other.stage.inputs, *other.stage.writes(context)}
        ]
        kept.append(step)
    return kept
