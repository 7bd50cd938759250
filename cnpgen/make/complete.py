"""Completion of user tasks, positions to reach and hit directions, into boundary problems."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import Array
from cnpgen.errors import DatasetError, UsageError, counted, nearest
from cnpgen.kernels.library import choose_backend
from cnpgen.make.goal_poses import MAX_GOAL_STATES, PoseTasks, problem_of_poses
from cnpgen.make.recipe import DatasetRecipe, as_dataset_recipe
from cnpgen.pipelines.completion import Completion, given_fields, table_height
from cnpgen.pipelines.pipeline import Pipeline, steps_of
from cnpgen.pipelines.stages.stage import Context, load_context
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.plans.plans import Plans
from cnpgen.plans.stated_units import refuse_other_units
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import extrapolated, record_problem
from cnpgen.robots.plausible_values import UnitError, check_plausible
from cnpgen.robots.robot import Robot
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import check_memory_of_rows, numbers
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import machine_errors
from cnpgen.store.files.csv_table import read_csv_table
from cnpgen.store.files.hdf5 import open_hdf5
from cnpgen.store.files.kind import is_hdf5
from cnpgen.store.paths import HDF5_KINDS, require_file


@dataclass(frozen=True, eq=False)
class Completed:
    """Result of the completion of N tasks.

    Attributes:
        plans: Boundary problems of the solved tasks, as plans without motions;
            ``plans.sample_id`` is the index of the task. ``solve_plans`` and
            ``refine_plans`` compute the motions; a planner plans for
            ``plans.boundary``. A task with a goal pose has one row for each of its goal
            states, with the column ``goal_option``.
        reasons: Rejection reason of each task; empty for solved tasks.
    """

    plans: Plans
    reasons: tuple[str, ...]

    def __repr__(self) -> str:
        return f"<{len(self):,} of {counted(len(self.reasons), 'task')} of {self.plans.problem.name!r} completed>"

    def __len__(self) -> int:
        return self.reasons.count("")

    @property
    def rejections(self) -> dict[str, int]:
        """Number of rejected tasks per reason, the most frequent reason first."""
        return dict(Counter(reason for reason in self.reasons if reason).most_common())


@checked_arguments
def complete(
    recipe: str | Path | Pipeline | DatasetRecipe | Problem,
    table: str | Path | None = None,
    /,
    *,
    extrapolate: bool = False,
    **columns: ArrayLike,
) -> Completed:
    """Complete tasks: compute their missing columns with the stages of a pipeline, without random sampling.

    A start is given by ``start_q``, for moving starts with ``start_dq`` and
    ``start_ddq``, or by the tip position ``start_xyz``. The default start is the
    problem's base at rest. A goal is given by ``goal_xyz``, for hits with
    ``hit_angle``. Hits have the maximum speed unless ``hit_speed`` [m/s] or
    ``hit_speed_share``, from 0 to 1, is given. Positions on a table need no z. Missing
    random values are replaced by their mean: a hit goes towards the pipeline's target
    or along the line from start to goal. Restrictions of sampling only, such as the
    minimum distance of start and goal, do not apply to tasks. Tasks are completed
    independently of each other.

    Tasks of a robot's problem, such as "panda", have goal poses of the tip:
    ``goal_xyz`` with the quaternion ``goal_wxyz``, or any orientation,
    ``goal_xyz_tolerance`` [m] and ``goal_rotation_tolerance`` [rad] along and about the
    axes of the pose; pi frees an axis. Each task then has several rows, one for each
    goal state, and ``solve_plans`` returns the best valid motion to any of them.

    Args:
        recipe: Name of a shipped pipeline, dataset or problem, path of a recipe file,
            or a loaded recipe.
        table: Path of a table of tasks, CSV or HDF5, in place of the columns; see
            'cnpgen docs tasks'.
        extrapolate: Whether parameters may be outside of their ranges. The problem of
            the plans then has wider ranges, and a name that ends with "-extrapolated".
        columns: Name of a dataset column -> values in SI units, shape (w,) for one task
            or (N, w); scalars have shape () or (N,). The value of one task applies to
            all.

    Raises:
        UnitError: A value is so far outside of its range that it is probably in degrees
            or millimetres.
        UsageError: A column is unknown, has the wrong shape or is not finite, a goal is
            missing, there is no such table, or table and columns are both given.
        DatasetError: The table is damaged, lacks a goal, or has unknown or
            contradictory columns.
        RecipeError: The recipe has errors.
        MachineError: No backend works, or the table cannot be read.
    """
    completer = _completer_of(recipe, extrapolate=extrapolate)
    if table is None:
        return completer.run(columns)
    if columns:
        raise UsageError(
            f"give a table or columns, got the table {table} and {', '.join(columns)}",
            argument="table",
        )
    tasks = read_tasks(Path(table), completer.fields, flat=completer.flat)
    try:
        return completer.run(tasks)
    except UnitError as error:
        raise UnitError(f"{table}: {error}", concerns="table") from error
    except UsageError as error:
        raise DatasetError(f"{table}: {error}") from error


@dataclass(frozen=True)
class _Completer:
    """Completion of the tasks of a recipe.

    Attributes:
        run: Columns -> completed tasks.
        fields: Fields that a table of tasks may have.
        flat: Whether positions lie on a table, so that they need no z.
    """

    run: Callable[[Mapping[str, ArrayLike]], Completed]
    fields: Mapping[str, Field]
    flat: bool


def _completer_of(
    recipe: str | Path | Pipeline | DatasetRecipe | Problem, *, extrapolate: bool
) -> _Completer:
    problem = problem_of_poses(recipe)
    if problem is not None:
        if extrapolate:
            text = "has no effect on tasks with goal poses, which have no parameters"
            raise UsageError(text, argument="extrapolate")
        poses = PoseTasks(problem)
        return _Completer(partial(_completed_poses, poses), poses.fields, flat=False)
    pipeline = (
        recipe if isinstance(recipe, Pipeline) else as_dataset_recipe(recipe).pipeline
    )
    context = load_context(pipeline.problem, *choose_backend(None))
    return _Completer(
        partial(_completed, pipeline, context, extrapolate),
        given_fields(steps_of(pipeline), context),
        flat=table_height(context) is not None,
    )


def _completed(
    pipeline: Pipeline,
    context: Context,
    extrapolate: bool,
    columns: Mapping[str, ArrayLike],
) -> Completed:
    # Wider ranges are another problem, whose kernels and checks must be those of the
    # tasks.
    if extrapolate:
        wider = extrapolated(pipeline.problem, columns.get("parameters", ()))
        pipeline = replace(pipeline, problem=wider)
        context = load_context(wider, *choose_backend(None))
    completion = Completion(pipeline, context, columns)
    given = _given(
        completion.given,
        columns,
        completion.context.robot,
        flat=completion.height is not None,
    )
    if "parameters" in given:
        # Before a stage computes with them.
        pipeline.problem.parameters.checked(given["parameters"])
    check_memory_of_rows(
        {name: len(rows) for name, rows in given.items()}, completion.width
    )
    tasks = completion({name: rows.T for name, rows in given.items()})
    rows = {**completion.rows(tasks), "sample_id": tasks.alive.astype(np.int64)}
    problem = record_problem(pipeline.problem)
    source = f"tasks completed by {pipeline.name}"
    return Completed(plans_of_rows(problem, rows, source=source), tasks.why())


def _completed_poses(poses: PoseTasks, columns: Mapping[str, ArrayLike]) -> Completed:
    poses.check(columns)
    given = _given(poses.fields, columns, poses.robot, flat=False)
    check_memory_of_rows(
        {name: len(rows) for name, rows in given.items()},
        MAX_GOAL_STATES * 3 * poses.robot.n,
    )
    return Completed(*poses.complete(given))


def _given(
    fields: Mapping[str, Field],
    columns: Mapping[str, ArrayLike],
    robot: Robot,
    *,
    flat: bool,
) -> dict[str, Array]:
    """Return the columns of tasks as rows of equal number, or one row for all."""
    given = {
        name: _rows(fields[name], values, flat=flat) for name, values in columns.items()
    }
    # One row holds for all tasks.
    count = max(map(len, given.values()))
    for name, values in given.items():
        if len(values) not in {1, count}:
            raise UsageError(
                f"is given for {counted(len(values), 'task')}, another column for {count:,}",
                argument=name,
            )
    check_plausible(
        robot, given, {name: field.unit for name, field in fields.items()}, noun="task"
    )
    return given


def _rows(field: Field, values: ArrayLike, *, flat: bool) -> Array:
    """Return the values of a field as rows, shape (N, w).

    On a table (``flat``) the z of a position is optional.
    """
    array = numbers(field.name, values)
    width = max(field.width, 1)
    # On a table the height follows from the problem.
    widths = {width, 2} if flat and field.name.endswith("_xyz") else {width}
    if not field.width:
        array = array[..., None]
    if array.ndim not in {1, 2} or array.shape[-1] not in widths:
        expected = f"({width},) or (N, {width})" if field.width else "() or (N,)"
        raise UsageError(
            f"must have shape {expected}, got {np.shape(values)}", argument=field.name
        )
    rows = array.reshape(-1, array.shape[-1])
    if not np.isfinite(rows).all():
        row = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise UsageError(
            f"must be finite, got {rows[row]} in task {row}", argument=field.name
        )
    if not len(rows):
        raise UsageError("has no rows, expected at least one task", argument=field.name)
    return rows


def read_tasks(
    path: Path, fields: Mapping[str, Field], *, flat: bool
) -> dict[str, Array]:
    """Read tasks with known fields from a table; on a table (``flat``), positions need no z.

    The file is CSV with column names in the first line, or HDF5 whose datasets are
    columns or whole fields of shape (N, width), in SI units. Values have shape (N,) or
    (N, width); (N, 2) for positions without z.
    """
    require_file(
        path, "a table of tasks, CSV or HDF5", kinds=("a text file", *HDF5_KINDS)
    )
    with machine_errors("read", path):
        if is_hdf5(path):
            columns = _hdf5_columns(path, fields)
        else:
            table = read_csv_table(path, example="goal_xyz.x,goal_xyz.y")
            columns = {name: table.numbers(name) for name in table.names}
    if columns and not any(values.size for values in columns.values()):
        raise DatasetError(
            f"{path} has no tasks: it names columns ({', '.join(columns)}), but has no numbers"
        )
    known = {
        **fields,
        **{column: field for field in fields.values() for column in field.columns},
    }
    for name, values in columns.items():
        if name not in known:
            parts = [column for field in fields.values() for column in field.columns]
            hint = nearest(name, parts) or f", only {', '.join(fields)}"
            text = f"tasks of this pipeline cannot give {name!r}{hint}"
            raise DatasetError(f"{path}: {text}")
        if not (finite := np.isfinite(values)).all():
            row = int(np.argmin(finite.reshape(len(values), -1).all(axis=1)))
            text = f"{name} must be a finite number in every task, got {values[row]} in task {row}"
            raise DatasetError(f"{path}: {text}")
    # Tables of HDF5 have whole fields, CSV tables one column per component.
    found = {name: values for name, values in columns.items() if name in fields}
    for field in fields.values():
        own = [column for column in field.columns if field.width and column in columns]
        if own:
            found[field.name] = _joined(path, field, own, columns, flat=flat)
    return found


def _joined(
    path: Path,
    field: Field,
    parts: list[str],
    columns: Mapping[str, Array],
    *,
    flat: bool,
) -> Array:
    """Stack the components of a field.

    The height of a position on a table is optional.
    """
    without = {f"{field.name}.z"} if flat and field.name.endswith("_xyz") else set()
    missing = [column for column in field.columns if column not in {*parts, *without}]
    if missing:
        raise DatasetError(
            f"{path} lacks {', '.join(missing)} beside {', '.join(parts)}"
        )
    return np.stack([columns[name] for name in parts], axis=1)


def _hdf5_columns(path: Path, fields: Mapping[str, Field]) -> dict[str, Array]:
    units = {
        name: field.unit
        for field in fields.values()
        for name in (field.name, *field.columns)
    }
    with open_hdf5(path) as file:
        found = {name: column.read() for name, column in file.columns().items()}
        refuse_other_units(file, units)
    try:
        columns: dict[str, Array] = {
            name: numbers(name, values) for name, values in found.items()
        }
    except UsageError as error:
        raise DatasetError(f"{path}: {error}") from error
    if len({len(values) if values.ndim else -1 for values in columns.values()}) > 1:
        shapes = ", ".join(f"{name} {values.shape}" for name, values in columns.items())
        raise DatasetError(
            f"{path}: columns must have one value per task each, got {shapes}"
        )
    return columns
