"""Sampled trajectories of any planner, loaded in the order and the units of a problem."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.trajectory_scenes import problem_of_samples, with_scenes
from cnpgen.addons.trajectories.trajectory_tables import (
    TrajectoryTable,
    read_trajectory_tables,
)
from cnpgen.errors import UsageError, either, nearest
from cnpgen.plans.format import PHASE_COLUMN
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.robots.parameter_ranges import PARAMETER_UNITS
from cnpgen.robots.plausible_values import UnitError, find_implausible_value
from cnpgen.robots.robot import Robot
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import number
from cnpgen.schema.units import UNITS as KNOWN_UNITS
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.scene_table import OBSTACLE_POSES

Array = NDArray[np.float64]

TIME_NAMES = ("t", "time", "timestamp", "time_from_start", "seconds")
KIND_NAMES = {
    "q": ("q", "position", "positions", "pos"),
    "dq": ("dq", "qd", "velocity", "velocities", "vel"),
    "ddq": ("ddq", "qdd", "acceleration", "accelerations", "acc"),
}
MAX_RATE_DEVIATION = 0.01  # of a stated rate from that of the file's times, relative
MIN_DOUBTFUL_STEP_S = 0.5  # of times without a unit
MAX_DOUBTFUL_SPEED = 2e-3  # relative to the velocity limits; twice the limit if the times are milliseconds
UNUSED_KINDS = ("jerk", "effort", "efforts")  # not reported as ignored
_UNIT = re.compile(r"\s*\[([^\]]*)\]\s*$")
_SEPARATORS = (" ", "_", ".", "/", ":", "")
_DEGREE = float(np.pi / 180)


@dataclass(frozen=True, eq=False)
class LoadedTrajectories:
    """Trajectories of a file, in the order of the problem's joints and in SI units.

    Attributes:
        problem: The problem, with further obstacles if scenes were given.
        trajectories: The trajectories.
        labels: Places in the file, such as ``"plans/plan_00000.csv"``.
        ignored: Names of columns that are not used, such as those of a gripper.
    """

    problem: ProblemRecord
    trajectories: tuple[Trajectory, ...]
    labels: tuple[str, ...]
    ignored: tuple[str, ...]


@checked_arguments
def load_trajectories(
    path: str | Path,
    problem: Problem | StoredProblem | str | Path,
    *,
    joints: Sequence[str] | None = None,
    unit: Literal["rad", "deg"] = "rad",
    rate: float | None = None,
    separate_by: str | None = None,
    unwrap: bool = False,
    parameters: Mapping[str, float] | None = None,
    scenes: str | Path | Sequence[SceneProblem] | None = None,
) -> LoadedTrajectories:
    """Load sampled trajectories from a file or a folder; 'cnpgen docs trajectories' lists formats and columns.

    Args: path: CSV, JSON, YAML, NPZ, HDF5 or Parquet file, or a folder of them.
        problem: Problem, record, or name or path of a problem, pipeline or dataset.
        joints: Names of the problem's joints in the file, in the problem's order; by
        default the same names. For arrays
            without names: indices.
        unit: Unit of revolute joints in columns without a unit in their name.
        rate: Samples per second [Hz] of a file without times.
        separate_by: Column whose value differs from trajectory to trajectory.
        unwrap: Whether revolute joints that jump by more than half a turn have passed
            the end of the range of angles.
        parameters: Values of the problem's parameters that the file does not have, by
            name, in SI units.
        scenes: Obstacles around the trajectories: a file of scenes or of plans, or
            loaded scenes; one for each trajectory in order, or one for all.

    Raises: UsageError: A column is missing, a value is not finite, times do not
        increase, or the file is damaged. UnitError: Positions without a unit are
        probably in degrees or millimetres, or times in milliseconds. MissingExtraError:
        The format needs a package that is not installed.
    """
    record = problem_of_samples(problem)
    names = record.joint_names if joints is None else tuple(joints)
    if len(names) != len(record.joint_names) or not all(
        isinstance(name, str) for name in names
    ):
        expected = f"one for each of {', '.join(record.joint_names)}"
        raise UsageError(
            f"must have {len(record.joint_names)} names, {expected}, got {list(names)}",
            argument="joints",
        )
    if rate is not None and not number("rate", rate) > 0:
        raise UsageError(f"must be above 0, got {rate}", argument="rate")
    _check_parameters(record, parameters or {})
    robot = open_problem(record)[1]
    try:
        tables = [
            part
            for table in read_trajectory_tables(Path(path))
            for part in _separated(table, separate_by)
        ]
        readers = [
            _Reader(
                table,
                record,
                names,
                unit == "deg",
                rate,
                unwrap,
                parameters or {},
                robot.velocity_limit,
            )
            for table in tables
        ]
        trajectories = tuple(reader.trajectory() for reader in readers)
    except UsageError as error:
        error.argument = error.argument or "path"
        raise
    if not trajectories:
        raise UsageError(f"{path} holds no trajectory", argument="path")
    if unit == "rad":
        _check_unit(path, robot, [trajectory.q for trajectory in trajectories])
    ignored = dict.fromkeys(name for reader in readers for name in reader.unused())
    if scenes is not None:
        record, trajectories = with_scenes(record, trajectories, scenes)
    return LoadedTrajectories(
        record, trajectories, tuple(table.place for table in tables), tuple(ignored)
    )


def _check_unit(path: str | Path, robot: Robot, positions: Sequence[Array]) -> None:
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
    lengths = {len(values) for values in table.columns.values() if values.ndim}
    stacked = {
        name: values for name, values in table.columns.items() if values.ndim == 3
    }
    if separate_by is not None:
        if separate_by not in table.columns or table.columns[separate_by].ndim != 1:
            raise UsageError(
                f"{table.place}: there is no column {separate_by!r}, only {', '.join(table.columns)}"
            )
        if len(lengths) != 1:
            raise UsageError(
                f"{table.place}: columns must have one value per row each, got {sorted(lengths)} values"
            )
        key = table.columns[separate_by]
        for value in dict.fromkeys(key.tolist()):
            rows = {
                name: values[key == value] if values.ndim else values
                for name, values in table.columns.items()
                if name != separate_by
            }
            lines = (
                tuple(np.array(table.lines)[key == value].tolist())
                if table.lines
                else ()
            )
            yield TrajectoryTable(
                f"{table.place}: {separate_by} {value}", rows, table.joint_names, lines
            )
    elif stacked:
        count = len(next(iter(stacked.values())))
        for index in range(count):
            parts = {
                name: values[index]
                if values.ndim == 3 or (values.ndim == 2 and len(values) == count)
                else values
                for name, values in table.columns.items()
                if values.ndim == 3 or _plain(name) in TIME_NAMES
            }
            of_all = {
                name: values
                for name, values in table.columns.items()
                if _plain(name) in PARAMETER_UNITS
            }
            parts |= {
                name: values[index] if values.shape == (count,) else values
                for name, values in of_all.items()
            }
            yield TrajectoryTable(
                f"{table.place}: trajectory {index}", parts, table.joint_names
            )
    else:
        yield table


def _check_parameters(record: ProblemRecord, parameters: Mapping[str, float]) -> None:
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
                argument="parameters",
            )


@dataclass
class _Reader:
    """Reader of one trajectory of a table.

    ``used`` has the names of the columns that were read.
    """

    table: TrajectoryTable
    record: ProblemRecord
    joints: tuple[str, ...]
    degrees: bool
    rate: float | None
    unwrap: bool
    parameters: Mapping[str, float]
    velocity_limit: Array
    used: set[str] = field(default_factory=set)

    def trajectory(self) -> Trajectory:
        """Return the trajectory; its parameters are None if some are missing."""
        columns = {kind: self._kind(kind) for kind in KIND_NAMES}
        q = columns["q"]
        if q is None:
            raise self._error(self._missing())
        if not len(q):
            raise self._error("there are no positions, expected at least one row")
        t = self._times(len(q))
        for name, values in (("times", t), *columns.items()):
            if values is not None and len(values) != len(q):
                raise self._error(f"{len(values)} {name} for {len(q)} positions")
        if self.unwrap:
            turning = [not sliding for sliding in self.record.prismatic_joints]
            q[:, turning] = np.unwrap(q[:, turning], axis=0)
        parameters = self._parameters()
        poses = self._obstacle_poses()
        phase = (
            self._numbers(PHASE_COLUMN, ndim=1)
            if PHASE_COLUMN in self.table.columns
            else None
        )
        try:
            if parameters is not None:
                self.record.parameters.checked(parameters)
            trajectory = Trajectory(
                t - t[0], q, columns["dq"], columns["ddq"], parameters, phase, poses
            )
        except UsageError as error:
            raise self._error(str(error)) from error
        self._check_times(trajectory)
        return trajectory

    def unused(self) -> list[str]:
        """Return the names of the columns that were not read, except those of known other kinds."""
        names = [name for name in self.table.columns if name not in self.used]
        return [
            name for name in names if not _plain(name).lower().startswith(UNUSED_KINDS)
        ]

    def _error(self, text: str, **details: Any) -> UsageError:
        return UsageError(f"{self.table.place}: {text}", **details)

    def _parameters(self) -> Array | None:
        """Return the values of the problem's parameters, shape (p,)."""
        ranges, plain = (
            self.record.parameters,
            {_plain(name): name for name in self.table.columns},
        )
        found = dict(self.parameters)
        for parameter, unit in zip(ranges.names, ranges.value_units, strict=True):
            if (name := plain.get(parameter)) is None:
                continue
            values = np.unique(
                self._numbers(name, ndim=self.table.columns[name].ndim and 1)
            )
            if len(values) != 1:
                raise self._error(
                    f"{name} must have one value, got {values[0]:g} and {values[-1]:g}"
                )
            found[parameter] = float(values[0]) * self._factor(name, unit, 1.0)
        if not ranges or found.keys() != set(ranges.names):
            return None
        return np.array([found[name] for name in ranges.names])

    def _obstacle_poses(self) -> Array | None:
        """Return the poses and sizes of obstacles in the rows of a file, shape (width,), or None without any."""
        if OBSTACLE_POSES not in self.table.columns:
            return None
        rows = self._numbers(OBSTACLE_POSES, ndim=2)
        if (rows != rows[0]).any():
            raise self._error(
                f"{OBSTACLE_POSES} must be the same in every row: obstacles do not move"
            )
        return rows[0]

    def _times(self, count: int) -> Array:
        """Return the times of the samples [s]."""
        name, rate = self._time_column(), self.rate
        if rate is not None and (
            name is None or not self._has_times_of_rate(name, rate)
        ):
            return np.asarray(np.arange(count) / rate)
        if name is None:
            text = f"no column of times ({', '.join(TIME_NAMES)}): state {{rate}}"
            raise self._error(text, remedies={"rate": 100})
        return self._seconds(name)

    def _seconds(self, name: str) -> Array:
        return self._numbers(name, ndim=1) * self._factor(name, "s", 1.0)

    def _has_times_of_rate(self, name: str, rate: float) -> bool:
        """Return whether the file has increasing times.

        Raise UsageError if they do not agree with a stated rate.
        """
        try:
            steps = np.diff(self._seconds(name))
        except UsageError:
            return False
        step = float(np.median(steps)) if len(steps) else 0.0
        if step > 0 and abs(step * rate - 1) > MAX_RATE_DEVIATION:
            steps_of = f"{name} of {self.table.place} has steps of {step:.3g} s"
            text = f"must agree with the times of the file, got {rate:g} Hz; {steps_of}: omit it"
            raise UsageError(text, argument="rate")
        return step > 0

    def _time_column(self) -> str | None:
        return next(
            (name for name in self.table.columns if _plain(name).lower() in TIME_NAMES),
            None,
        )

    def _check_times(self, trajectory: Trajectory) -> None:
        """Check that times without a unit are in seconds: milliseconds make long steps and slow joints."""
        name, step = self._time_column(), float(np.median(np.diff(trajectory.t)))
        if (
            name is None
            or self.rate is not None
            or _UNIT.search(name)
            or step < MIN_DOUBTFUL_STEP_S
        ):
            return
        speeds = np.abs(np.diff(trajectory.q, axis=0)) / np.diff(trajectory.t)[:, None]
        share = float((speeds / self.velocity_limit).max())
        if 0 < share < MAX_DOUBTFUL_SPEED:
            slow = f"all joints are slower than {share:.2g} of their velocity limits"
            text = f"{self.table.place}: {name} has steps of {step:.3g} s, and {slow}"
            raise UnitError(
                f"{text}; name the column '{name} [ms]' or '{name} [s]'",
                concerns="path",
            )

    def _kind(self, kind: str) -> Array | None:
        """Return positions, velocities or accelerations of the problem's joints, shape (K, n), or None."""
        for name, values in self.table.columns.items():
            if _plain(name).lower() in KIND_NAMES[kind] and values.ndim == 2:
                return self._selected(name) * self._factors(
                    [name] * len(self.joints), kind
                )
        names = self._scalar_columns(kind)
        if names is None:
            return None
        columns = np.stack([self._numbers(name, ndim=1) for name in names], axis=1)
        return np.asarray(columns * self._factors(names, kind))

    def _selected(self, name: str) -> Array:
        """Return the problem's joints of an array with one column per joint."""
        values, joints = self._numbers(name, ndim=2), self.joints
        width, named = values.shape[1], self.table.joint_names
        if named and len(named) != width:
            raise self._error(
                f"{name} has {width} columns, joint_names has {len(named)}"
            )
        if named:
            missing = [joint for joint in joints if joint not in named]
            if missing:
                raise self._error(
                    f"there is no joint {missing[0]!r}, only {', '.join(named)}"
                )
            return values[:, [named.index(joint) for joint in joints]]
        if all(joint.isdecimal() and int(joint) < width for joint in joints):
            return values[:, [int(joint) for joint in joints]]
        if width != len(joints):
            raise self._error(
                f"{name} has {width} columns, the problem plans {len(joints)} joints"
            )
        return values

    def _scalar_columns(self, kind: str) -> list[str] | None:
        """Return the column of every joint, or None without any.

        Positions may have the joint's name alone.
        """
        plain = {
            _plain(name).lower(): name
            for name, values in self.table.columns.items()
            if values.ndim == 1
        }
        joints = self.joints
        naming = [list(joints)]
        if not any(joint.isdecimal() for joint in joints):
            naming += [[str(k + first) for k in range(len(joints))] for first in (0, 1)]
        most = 0  # columns of a numbering that is not complete
        for names in naming:
            found = [_column_of(plain, name.lower(), kind) for name in names]
            if all(found):
                return [name for name in found if name]
            if any(found) and names is naming[0]:
                missing = names[found.index(None)]
                raise self._error(
                    f"no column with the {KIND_NAMES[kind][1]} of {missing!r}"
                )
            most = max(most, len(joints) - found.count(None))
        if kind == "q" and most > 1:
            raise self._error(
                f"{most} columns with joint positions, the problem plans {len(joints)} joints"
            )
        return None

    def _numbers(self, name: str, *, ndim: int) -> Array:
        """Return a column as numbers."""
        self.used.add(name)
        values = self.table.columns[name]
        if values.ndim != ndim or values.dtype.kind not in "biuf":
            if values.ndim != 1 or ndim != 1:
                raise self._error(
                    f"{name} must have {ndim} dimensions of numbers, got shape {values.shape}"
                )
            # The column has texts; the first one that is not a number is named.
            row = next(
                (k for k, value in enumerate(values.tolist()) if not _is_number(value)),
                0,
            )
            place = (
                f"line {self.table.lines[row]}" if self.table.lines else f"row {row}"
            )
            raise self._error(
                f"{place}: {name} must be a number, got {values[row].item()!r:.60}"
            )
        return values.astype(float)

    def _factors(self, names: Sequence[str], kind: str) -> Array:
        """Return the factors to SI units of the columns of a kind, one per joint, shape (n,)."""
        exponent = {"q": "", "dq": "/s", "ddq": "/s^2"}[kind]
        turning = ("rad", _DEGREE if self.degrees else 1.0)
        units = [
            ("m", 1.0) if slides else turning for slides in self.record.prismatic_joints
        ]
        parts = zip(names, units, strict=True)
        return np.array(
            [
                self._factor(name, unit + exponent, usual)
                for name, (unit, usual) in parts
            ]
        )

    def _factor(self, name: str, unit: str, default: float) -> float:
        """Return the factor to SI of a column by the unit in its name, such as ``[deg/s]``; a default without one."""
        match = _UNIT.search(name)
        if not match:
            return default
        si, factor = KNOWN_UNITS.get(match[1].strip(), ("", 1))
        if si != unit:
            raise self._error(f"{name} must have a unit of {unit}, got {match[1]!r}")
        return float(factor)

    def _missing(self) -> str:
        """Return the message for missing positions."""
        joint, columns = self.joints[0], ", ".join(list(self.table.columns)[:12])
        expected = f"q {joint}, {joint}_position, {joint} and so on, or an array q"
        return f"no columns with joint positions, expected {expected}; there are {columns or 'no columns'}"


def _column_of(plain: dict[str, str], joint: str, kind: str) -> str | None:
    """Return the column of a joint and a kind, such as ``"q joint_1 [rad]"`` or ``"joint_1_position"``."""
    if kind == "q" and joint in plain and not joint.isdecimal():
        return plain[joint]
    for word in KIND_NAMES[kind]:
        for separator in _SEPARATORS:
            for name in (f"{word}{separator}{joint}", f"{joint}{separator}{word}"):
                if name in plain:
                    return plain[name]
    return None


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _plain(name: str) -> str:
    """Return the name of a column without its unit."""
    return _UNIT.sub("", name).strip()
