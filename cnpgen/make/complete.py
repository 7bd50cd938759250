"""Completing tasks that users give: positions to reach and directions to hit in, for boundary problems to solve."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import DatasetError, UsageError, counted
from cnpgen.kernels.library import choose_backend
from cnpgen.make.load import as_dataset_recipe
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.make.task_table import read_tasks
from cnpgen.pipelines.completion import Completion, given_fields, table_height
from cnpgen.pipelines.context import Context, load_context
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.steps import steps_of
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.plans.plans import Plans
from cnpgen.problems.record import record_problem
from cnpgen.schema.arguments import numbers
from cnpgen.store.field import Field

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Completed:
    """What came of N tasks.

    Attributes:
        plans: The boundary problems of those that have an answer, as plans that are still to be made: ``solve_plans``
            and ``refine_plans`` make them, a planner plans for ``plans.boundary``. ``plans.sample_id`` says which task
            each is.
        reasons: Why each task has no answer; empty where it has one.
    """

    plans: Plans
    reasons: tuple[str, ...]

    def __repr__(self) -> str:
        return f"<{len(self.plans):,} of {counted(len(self.reasons), 'task')} of {self.plans.problem.name!r} completed>"

    @property
    def rejections(self) -> dict[str, int]:
        """How many tasks have no answer for each reason, the most frequent one first."""
        return dict(Counter(reason for reason in self.reasons if reason).most_common())


def complete(recipe: str | Path | Pipeline | DatasetRecipe, /, **columns: ArrayLike) -> Completed:
    """Complete tasks: find by the stages of a pipeline, in their order, what is not given, instead of drawing it.

    A start is given by ``start_q``, with ``start_dq`` and ``start_ddq`` where it moves, or by the tip's position
    ``start_xyz``; else it is the problem's base at rest. A goal is given by ``goal_xyz``, for hits with ``hit_angle``
    and, unless the hit is to be as fast as possible, with ``hit_speed`` [m/s] or ``hit_speed_share``, from 0 to 1. On a
    table positions need no z. What a stage would draw and no task gives is the middle of what it could be: a hit goes
    towards the pipeline's target or along the line from start to goal. What restricts draws only, such as the least
    distance of start and goal, restricts no task. Every task is completed for itself.

    Args:
        recipe: Name of a shipped pipeline or dataset, path of a recipe file, or a loaded recipe.
        columns: Name -> values in SI units, as datasets name them: shape (w,) for one task or (N, w), scalars one
            number or shape (N,). One task's value holds for all.

    Raises:
        UsageError: There is no such column, something has the wrong shape or is not finite, or a goal is missing.
        RecipeError: The recipe has mistakes.
        MachineError: No backend works.
    """
    pipeline = _pipeline(recipe)
    return _completed(pipeline, load_context(pipeline.problem, *choose_backend(None)), columns)


def _completed(pipeline: Pipeline, context: Context, columns: Mapping[str, ArrayLike]) -> Completed:
    completion = Completion(pipeline, context, columns)
    flat = completion.height is not None
    given = {name: _rows(completion.given[name], values, flat=flat) for name, values in columns.items()}
    count = max(map(len, given.values()))
    for name, values in given.items():
        if len(values) not in {1, count}:
            raise UsageError(f"{name} is given for {counted(len(values), 'task')}, another column for {count:,}")
    tasks = completion({name: rows.T for name, rows in given.items()})
    rows = {**completion.rows(tasks), "sample_id": tasks.alive.astype(np.int64)}
    problem, source = record_problem(pipeline.problem), f"tasks completed by {pipeline.name}"
    return Completed(plans_of_rows(problem, rows, source=source), tasks.why())


def complete_table(recipe: str | Path | Pipeline | DatasetRecipe, path: str | Path) -> Completed:
    """Complete the tasks of a table, CSV or HDF5; see ``complete`` and docs/tasks.md.

    Args:
        recipe: As of ``complete``.
        path: The table.

    Raises:
        UsageError: There is no such file.
        DatasetError: The table is damaged, lacks a goal, or has columns that tasks cannot give, or not together.
        RecipeError: The recipe has mistakes.
        MachineError: No backend works, or the file cannot be read.
    """
    pipeline = _pipeline(recipe)
    context = load_context(pipeline.problem, *choose_backend(None))
    fields, flat = given_fields(steps_of(pipeline), context), table_height(context) is not None
    tasks = read_tasks(Path(path), fields, flat=flat)
    try:
        return _completed(pipeline, context, tasks)
    except UsageError as error:
        raise DatasetError(f"{path}: {error}") from error


def _pipeline(recipe: str | Path | Pipeline | DatasetRecipe) -> Pipeline:
    return recipe if isinstance(recipe, Pipeline) else as_dataset_recipe(recipe).pipeline


def _rows(field: Field, values: ArrayLike, *, flat: bool) -> Array:
    """Return the values of a field as rows, shape (N, w); on a table (``flat``) a position may have no z."""
    array, width = numbers(field.name, values), max(field.width, 1)
    widths = {width, 2} if flat and field.name.endswith("_xyz") else {width}
    if not field.width:
        array = array[..., None]
    if array.ndim not in {1, 2} or array.shape[-1] not in widths:
        expected = f"({width},) or (N, {width})" if field.width else "() or (N,)"
        raise UsageError(f"{field.name} must have shape {expected}, got {np.shape(values)}")
    rows = array.reshape(-1, array.shape[-1])
    if not np.isfinite(rows).all():
        row = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise UsageError(f"{field.name} must be finite, got {rows[row]} in task {row}")
    if not len(rows):
        raise UsageError(f"{field.name} is of no task")
    return rows
