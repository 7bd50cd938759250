"""Completing tasks: the stages of a pipeline find what tasks do not give, in their order, instead of drawing it."""

from collections.abc import Collection, Iterable, Mapping

import numpy as np

from cnpgen.errors import UsageError, lacks
from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.pipelines.acceptance import acceptance
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.stage import Array, TaskRound, Work
from cnpgen.pipelines.steps import Step, prepare_steps, steps_of, stored_fields, written_columns
from cnpgen.problems.constraints.constraint import End
from cnpgen.problems.constraints.table import Table
from cnpgen.store.field import Field

_EITHER = (("start_q", "start_xyz"), ("goal_q", "goal_xyz"))  # joints or a position


class Completion:
    """The stages of a pipeline, ready for tasks that give certain columns.

    A start of which nothing is given is the problem's base, at rest. Where joints are given the tip's position follows.

    Args:
        pipeline: The recipe.
        context: Its problem, robot and kernels.
        given: Names of the columns that tasks give.

    Attributes:
        context: Problem, robot and kernels.
        given: What tasks give: name -> field.
        height: Of positions on the problem's table [m], whose z may be left out; None where there is no table.

    Raises:
        UsageError: The pipeline does not take such a column, or needs others.
        RecipeError: The stages do not fit together, or to the problem.
    """

    def __init__(self, pipeline: Pipeline, context: Context, given: Collection[str]) -> None:
        steps = steps_of(pipeline)
        fields = given_fields(steps, context)
        _check(pipeline, fields, given)
        self.context, self.given = context, {name: fields[name] for name in given}
        self._fields = stored_fields(steps, context)[:-2]  # without those about draws
        self.height = table_height(context)
        self._derived = _derived(given)
        known = {*given, *self._derived}
        written = written_columns(pipeline.path, steps, context)
        with context.kernels.compiling_together():
            self._tip = context.kernels.load(tip_position)
            self._stages = _completing(_of_tasks(steps, context), context, known)
            self._accept = acceptance(context, written, given=_given_ends(given))
        self._random = np.random.default_rng(0)  # of plug-ins that draw past their round

    def __call__(self, columns: Mapping[str, Array]) -> TaskRound:
        """Complete N tasks, each for itself.

        Args:
            columns: What is given, name -> values, shape (width, N), or (width, 1) for all tasks, float64; of positions
                on a table the height may be missing.

        Returns:
            The tasks; those that have no answer are no longer among the survivors, and have a fate.
        """
        draws = TaskRound(max(values.shape[1] for values in columns.values()))
        for name, values in columns.items():
            whole = values if len(values) != 2 or not name.endswith("_xyz") else self._on_table(values)
            same = whole if whole.shape[1] == draws.size else np.broadcast_to(whole, (len(whole), draws.size))
            draws[name] = np.ascontiguousarray(same)
        self._derive(draws)
        for label, work in self._stages:
            draws.stage = label
            work(draws, self._random)
        draws.stage = "acceptance"
        self._accept(draws, self._random)
        return draws

    def rows(self, tasks: TaskRound) -> dict[str, Array]:
        """Return the fields of completed tasks as a dataset stores them, of those that have an answer.

        Returns:
            Name -> values, shape (M, width), or (M,) of scalars; tasks know which they are: ``tasks.alive``.
        """
        fields = [field for field in self._fields if field.name in tasks.columns]
        return {
            field.name: np.ascontiguousarray(tasks[field.name].T) if field.width else tasks[field.name][0]
            for field in fields
        }

    def _derive(self, draws: TaskRound) -> None:
        for name in self._derived:
            if name == "start_q":
                draws[name] = np.repeat(self.context.robot.base[:, None], draws.size, axis=1)
            else:
                (draws[name],) = self._tip(draws[name.replace("xyz", "q")])

    def _on_table(self, values: Array) -> Array:
        return np.concatenate([values, np.full((1, values.shape[1]), self.height)])


def table_height(context: Context) -> float | None:
    """Return the height of the tip that positions on the problem's table have [m]; None where there is no table."""
    table = context.problem.first(Table)
    return None if table is None else table.z


def given_fields(steps: Iterable[Step], context: Context) -> dict[str, Field]:
    """List what tasks may give: name -> field."""
    return {field.name: field for step in steps for field in step.stage.takes(context)}


def _check(pipeline: Pipeline, fields: Mapping[str, Field], given: Collection[str]) -> None:
    """Refuse tasks that give what a pipeline does not take, too much, or no goal.

    Raises:
        UsageError: They do.
    """
    for name in given:
        if name not in fields:
            raise UsageError(f"the pipeline {pipeline.name!r} {lacks('column to give', name, fields)}")
    for joints, position in _EITHER:
        if joints in given and position in given:
            raise UsageError(
                f"{joints} and {position} are both given: the joints say where the tip is, give one of them"
            )
    if not {"goal_q", "goal_xyz"} & set(given):
        raise UsageError(f"tasks of the pipeline {pipeline.name!r} must give goal_xyz, where the tip is to be")


def _derived(given: Collection[str]) -> tuple[str, ...]:
    """List the columns that follow from those that are given before any stage, in order."""
    start = () if "start_xyz" in given else ("start_xyz",) if "start_q" in given else ("start_q", "start_xyz")
    return start if "goal_xyz" in given else (*start, "goal_xyz")


def _given_ends(given: Collection[str]) -> list[End]:
    """List the ends of which joint states are given; those of which only the position is are solved for exactly."""
    ends: tuple[End, ...] = ("start", "goal")
    return [end for end in ends if {f"{end}_q", f"{end}_dq", f"{end}_ddq"} & set(given)]


def _of_tasks(steps: Iterable[Step], context: Context) -> list[Step]:
    """Leave out the stages that find or use, before a stage that renews them, what tasks need only after it."""
    left: list[Step] = []
    for step in steps:
        renewed = set(step.stage.renews)
        left = [each for each in left if not renewed & {*each.stage.needs, *each.stage.writes(context)}]
        left.append(step)
    return left


def _completing(steps: Iterable[Step], context: Context, known: Collection[str]) -> list[tuple[str, Work]]:
    """Prepare the stages for what is given."""
    return prepare_steps(list(steps), lambda stage: stage.complete(context, known))
