"""Sampled trajectories of any planner, loaded in the order and the units of a problem."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.array_tables import JOINT_NAMES
from cnpgen.addons.trajectories.bag_tables import has_bags
from cnpgen.addons.trajectories.load_options import LoadOptions
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.table_columns import TIME_NAMES
from cnpgen.addons.trajectories.table_reader import TableReader
from cnpgen.addons.trajectories.table_units import plain
from cnpgen.addons.trajectories.trajectory_scenes import problem_of_samples, with_scenes
from cnpgen.addons.trajectories.trajectory_table import TrajectoryTable
from cnpgen.addons.trajectories.trajectory_tables import read_trajectory_tables
from cnpgen.arrays import Array
from cnpgen.documents import AnyPath, NamedNumbers, Names
from cnpgen.errors import UsageError, either, nearest
from cnpgen.plans.stated_units import SCALE_ATTRIBUTES, UNIT_ATTRIBUTES
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import (
    ProblemRecord,
    extrapolated_record,
    open_problem,
)
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.problems.scenes.scene_reader import ReadingOptions
from cnpgen.robots.parameter_ranges import PARAMETER_UNITS
from cnpgen.robots.plausible_values import UnitError, find_implausible_value
from cnpgen.robots.robot import Robot
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.old_keywords import with_old_keywords
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.files.accounted import MISSPELT, check_allowed, unmatched

# Elements beside columns that say what their numbers mean.
_OF_NAMES = "joint_name", "joints", "names", "unit", "units"


@dataclass(frozen=True, eq=False)
class LoadedTrajectories:
    """Trajectories of a file, in the order of the problem's joints and in SI units.

    Attributes:
        problem: The problem, with further obstacles if scenes were given.
        trajectories: The trajectories.
        labels: Places in the file, such as ``"plans/plan_00000.csv"``.
        ignored: Names of columns that are not used, such as those of a gripper.
        notes: Sentences about the reading: units that the file does not state, dropped
            rows, and times before the first sample.
    """

    problem: ProblemRecord
    trajectories: tuple[Trajectory, ...]
    labels: Names
    ignored: Names
    notes: Names = ()


@checked_arguments
def load_trajectories(
    path: AnyPath,
    problem: Problem | StoredProblem | str | Path,
    *,
    joints: Sequence[str] | None = None,
    velocities: Sequence[str] | None = None,
    parameters: NamedNumbers | None = None,
    scenes: str | Path | Sequence[SceneProblem] | None = None,
    options: LoadOptions | None = None,
    **old_keywords: Any,
) -> LoadedTrajectories:
    """Load sampled trajectories from a file or a folder; 'cnpgen docs trajectories' lists formats and columns.

    Args:
        path: CSV, JSON, YAML, NPZ, HDF5 or Parquet file, bag of ROS, or a folder of
            files.
        problem: Problem, record, or name or path of a problem, pipeline or dataset.
        joints: Names of the problem's joints in the file, in the problem's order; by
            default the same names. For arrays without names: indices.
        velocities: Names of the columns with their velocities, in the same order, if
            they have other names.
        parameters: Values of the problem's parameters that the file does not have, by
            name, in SI units.
        scenes: Obstacles around the trajectories: a file of scenes or of plans, or
            loaded scenes; one for each trajectory in order, or one for all.
        options: Times, units, separators and repairs.
        old_keywords: Fields of the options, as keywords of version 1.0.

    Raises:
        UsageError: A column is missing, a value is not finite, times do not increase,
            or the file is damaged.
        UnitError: Positions without a unit are probably in degrees or millimetres, or
            times in milliseconds.
        MissingExtraError: The format needs a package that is not installed.
    """
    chosen = with_old_keywords(
        "load_trajectories", options, LoadOptions(), old_keywords
    )
    record = problem_of_samples(problem)
    _check_parameters(record, parameters or {})
    names = (
        _names(record, "joints", joints, record.joint_names),
        _names(record, "velocities", velocities, ()),
    )
    readers, trajectories = _read(path, record, chosen, names, parameters or {})
    ignored = dict.fromkeys(name for reader in readers for name in reader.unused())
    # Keys of messages may be missing in scenes; the other ones must be there.
    keys = unmatched(chosen.allow_unused, [*ignored, *map(_key_of, ignored)])
    _check_meaning(path, ignored, chosen.allow_unused)
    if scenes is None:
        check_allowed(keys, [], ignored)
    if chosen.extrapolate:
        record = _extrapolated(record, trajectories)
    if scenes is not None:
        elsewhere = sorted({*chosen.allow_unused}.difference(keys))
        of_scenes = ReadingOptions(keys, allowed_elsewhere=elsewhere)
        record, trajectories = with_scenes(
            record, trajectories, scenes, options=of_scenes
        )
    places = tuple(reader.table.place for reader in readers)
    notes = tuple(dict.fromkeys(note for reader in readers for note in reader.notes))
    return LoadedTrajectories(record, trajectories, places, tuple(ignored), notes)


def _read(
    path: AnyPath,
    record: ProblemRecord,
    options: LoadOptions,
    names: tuple[Sequence[str], Sequence[str]],
    parameters: NamedNumbers,
) -> tuple[list[TableReader], tuple[Trajectory, ...]]:
    """Return the readers of the tables of a file, with the names of joints and of their velocities, and trajectories."""
    robot = open_problem(record)[1]
    others = *names, parameters, robot.velocity_limit
    try:
        readers = [
            TableReader(part, record, options, *others)
            for table in read_trajectory_tables(Path(path), options)
            for part in _separated(table, options.separate_by)
        ]
        trajectories = tuple(reader.trajectory() for reader in readers)
    except UsageError as error:
        error.argument = error.argument or "path"
        raise
    _check_trajectories(path, options, robot, trajectories)
    if options.unit is not None and not any(reader.lacks_unit for reader in readers):
        text = "is for columns without a unit: all columns of joints state theirs"
        raise UsageError(text, argument="unit")
    for reader, trajectory in zip(readers, trajectories, strict=True):
        reader.check_units(trajectory)
    return readers, trajectories


def _extrapolated(
    record: ProblemRecord, trajectories: Iterable[Trajectory]
) -> ProblemRecord:
    """Return the problem with ranges of parameters that contain those of the trajectories."""
    values = [each.parameters for each in trajectories]
    stated = [row for row in values if row is not None]
    return extrapolated_record(record, np.array(stated))


def _check_trajectories(
    path: AnyPath,
    options: LoadOptions,
    robot: Robot,
    trajectories: Sequence[Trajectory],
) -> None:
    """Check that a file holds trajectories, of the kind and the unit that the options say."""
    if not trajectories:
        raise UsageError(f"{path} holds no trajectory", concerns="path")
    if options.topic is not None and not has_bags(Path(path)):
        text = f"is for bags of ROS, got {path}, which is none"
        raise UsageError(text, argument="topic")
    if options.unit != "deg":
        _check_unit(path, robot, [trajectory.q for trajectory in trajectories])


def _key_of(name: str) -> str:
    """Return the key of an unused element: "scale" of "attribute scale of q"."""
    return name.removeprefix("attribute ").partition(" of ")[0].lower()


def _check_meaning(
    path: AnyPath, ignored: Iterable[str], allowed: Sequence[str]
) -> None:
    """Refuse unused elements that say what numbers mean, unless their loss is accepted."""
    for name in ignored:
        key = _key_of(name)
        is_attribute = name.startswith("attribute ")
        known = {*_OF_NAMES, *SCALE_ATTRIBUTES} if is_attribute else _OF_NAMES
        similar = nearest(key, (JOINT_NAMES, *UNIT_ATTRIBUTES), similarity=MISSPELT)
        if (key in known or similar) and key not in allowed:
            text = (
                f"{path}: {name!r} is not used and may change the meaning of columns:"
            )
            raise UsageError(
                f"{text} expected 'joint_names', or units in the names of columns; {{allow_unused}} leaves it unused",
                concerns="path",
                remedies={"allow_unused": key},
            )


def _names(
    record: ProblemRecord,
    argument: str,
    names: Sequence[str] | None,
    default: Names,
) -> Names:
    """Return names of columns, a different one for each joint of the problem, or a default."""
    if names is None:
        return default
    count = len(record.joint_names)
    if len(names) != count or not all(isinstance(name, str) for name in names):
        expected = f"one for each of {', '.join(record.joint_names)}"
        raise UsageError(
            f"must have {count} names, {expected}, got {list(names)}", argument=argument
        )
    if twice := [name for name in names if list(names).count(name) > 1]:
        raise UsageError(
            f"must have different names, got {twice[0]!r} more than once",
            argument=argument,
        )
    return tuple(names)


def _check_unit(path: AnyPath, robot: Robot, positions: Sequence[Array]) -> None:
    """Check that positions are in rad or m, by their medians: single trajectories may be far outside of the limits."""
    median = np.median(np.concatenate(positions), axis=0)[None]
    wrong = find_implausible_value(robot, "q", median, robot.units("rad"))
    if wrong is not None:
        hint = " {unit} reads degrees." if wrong.unit == "rad" else ""
        text = f"{path}: the median position of {robot.joint_names[wrong.column]} {wrong}{hint}"
        raise UnitError(text, concerns="path", remedies={"unit": "deg"} if hint else {})


def _separated(
    table: TrajectoryTable, separate_by: str | None
) -> Iterator[TrajectoryTable]:
    """Yield the trajectories of a table: groups of rows, or the first axis of three."""
    stacked = [values for values in table.columns.values() if values.ndim == 3]
    if separate_by is not None:
        yield from _groups_of_rows(table, separate_by)
    elif stacked:
        count = len(stacked[0])
        for index in range(count):
            yield _of_stack(table, index, count)
    else:
        yield table


def _groups_of_rows(
    table: TrajectoryTable, separate_by: str
) -> Iterator[TrajectoryTable]:
    """Yield groups of consecutive rows with one value of a column."""
    lengths = {len(values) for values in table.columns.values() if values.ndim}
    if separate_by not in table.columns or table.columns[separate_by].ndim != 1:
        raise UsageError(
            f"{table.place}: there is no column {separate_by!r}, only {', '.join(table.columns)}"
        )
    if len(lengths) != 1:
        raise UsageError(
            f"{table.place}: columns must have one value per row each, got {sorted(lengths)} values"
        )
    key = table.columns[separate_by]
    first = np.flatnonzero(np.append(True, key[1:] != key[:-1])).tolist()
    begun = Counter[Any]()
    for low, high in pairwise([*first, len(key)]):
        value = key[low].item()
        begun[value] += 1
        again = f", part {begun[value]}" if begun[value] > 1 else ""
        rows = {
            name: values[low:high] if values.ndim else values
            for name, values in table.columns.items()
            if name != separate_by
        }
        yield replace(
            table,
            place=f"{table.place}: {separate_by} {value}{again}",
            columns=rows,
            lines=table.lines[low:high],
        )


def _of_stack(table: TrajectoryTable, index: int, count: int) -> TrajectoryTable:
    """Return one of the trajectories that are stacked along the first axis."""
    parts = {}
    for name, values in table.columns.items():
        # Times and parameters are those of one trajectory, or of all.
        is_own = values.ndim == 3
        if plain(name) in TIME_NAMES:
            is_own |= values.ndim == 2 and len(values) == count
        elif plain(name) in PARAMETER_UNITS:
            is_own |= values.shape == (count,)
        elif not is_own:
            continue
        parts[name] = values[index] if is_own else values
    return TrajectoryTable(
        f"{table.place}: trajectory {index}", parts, table.joint_names
    )


def _check_parameters(record: ProblemRecord, parameters: NamedNumbers) -> None:
    """Check the names of stated parameters."""
    known = record.parameters.names
    for name in parameters:
        if name not in known:
            expected = (
                f"expected {either(known)}{nearest(name, known)}"
                if known
                else "the problem has no parameters"
            )
            raise UsageError(
                f"{name!r} is not a parameter of {record.name!r}: {expected}",
                concerns="parameters",
            )
