"""Reader of one trajectory: the columns of a table as times, positions and derivatives of a problem's joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.load_options import LoadOptions
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.table_columns import (
    KIND_NAMES,
    TIME_NAMES,
    column_of,
    is_number,
    joint_columns,
    key_of,
)
from cnpgen.addons.trajectories.table_units import (
    DEGREE,
    Readings,
    check_units,
    plain,
    stated_factor,
)
from cnpgen.addons.trajectories.trajectory_table import (
    MAX_RATE_DEVIATION,
    TrajectoryTable,
)
from cnpgen.arrays import Array
from cnpgen.documents import NamedNumbers
from cnpgen.errors import UsageError, listed, nearest
from cnpgen.plans.format import PHASE_COLUMN
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.robots.urdf import urdf_tree
from cnpgen.store.scene_table import OBSTACLE_POSES

MAX_EXACT_START_S = 1e6  # later times of the first sample lose digits in float64
MAX_HELD_DIFFERENCE = 1e-9  # rad or m, of joints that are not planned
MAX_START_DIFFERENCE = 1e-4  # rad or m, and 1/s, of a start from the first sample
MAX_LISTED = 12  # columns in messages
# Whether the first time is positive -> note.
_FIRST_TIMES = {
    True: "the motion before its first sample is not known",
    False: "controllers skip the samples before 0, which count as part of the motion here",
}


@dataclass
class TableReader:
    """Reader of one trajectory of a table.

    The joints, and columns with their velocities, have one name in the file for each of the problem.
    ``used`` has the names of the columns that were read, ``notes`` sentences about how,
    ``other_joints`` the joints of arrays that the problem does not plan, ``lacks_unit`` whether a column of
    revolute joints states no unit, ``lacks_joint_unit`` whether one of any joint does.
    """

    table: TrajectoryTable
    record: ProblemRecord
    options: LoadOptions
    joints: Sequence[str]
    velocities: Sequence[str]
    parameters: NamedNumbers
    velocity_limit: Array
    used: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    other_joints: list[str] = field(default_factory=list)
    lacks_unit: bool = False
    lacks_joint_unit: bool = False

    def trajectory(self) -> Trajectory:
        """Return the trajectory; its parameters are None if some are missing."""
        self._check_names()
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
        phase = (
            self._numbers(PHASE_COLUMN, ndim=1)
            if PHASE_COLUMN in self.table.columns
            else None
        )
        rows: dict[str, Any] = {"t": t, **columns, "phase": phase}
        if self.options.drop_repeats:
            rows = self._without_repeats(rows)
        if self.options.unwrap:
            turning = [not sliding for sliding in self.record.prismatic_joints]
            rows["q"][:, turning] = np.unwrap(rows["q"][:, turning], axis=0)
        first = rows["t"][0]
        if first != 0 and self.options.separate_by is None:
            self.notes.append(
                f"{self.table.place} begins at t = {first:.6g} s: {_FIRST_TIMES[bool(first > 0)]}"
            )
        rows["t"] = rows["t"] - first
        self._note_start(rows)
        return self._checked(rows)

    def _note_start(self, rows: dict[str, Any]) -> None:
        """Note a start state of a message that is not that of the first sample, and a robot of another name."""
        q, dq = (rows[kind] for kind in ("q", "dq"))
        points = {
            joint: (q[0, k], 0.0 if dq is None else dq[0, k])
            for k, joint in enumerate(self.joints)
        }
        held = self.record.held_joints
        points |= {joint: (position, 0.0) for joint, position in held.items()}
        unplanned = [joint for joint in self.table.start if joint not in points]
        texts = [f"{joint}, which is not planned" for joint in unplanned]
        for joint, state in self.table.start.items():
            for value, other in zip(state, points.get(joint, state), strict=True):
                # nan is an unknown velocity.
                if abs(value - other) > MAX_START_DIFFERENCE:
                    texts.append(
                        f"{joint} at {value:.6g}, where the motion has {other:.6g}"
                    )
        place = self.table.place
        if texts:
            listing = listed(texts, MAX_LISTED)
            self.notes.append(f"{place}: the start state of the message has {listing}")
        name = self.table.robot_name
        actual = urdf_tree(self.record.urdf).get("name", "") if name else ""
        if name != actual:
            self.notes.append(
                f"{place} is for the robot {name!r}, the URDF is that of {actual!r}: joints are matched by name"
            )

    def _checked(self, rows: dict[str, Any]) -> Trajectory:
        """Return the trajectory of rows with parameters and scene, after a check of its units."""
        parameters = self._parameters()
        poses = self._obstacle_poses()
        try:
            if parameters is not None and not self.options.extrapolate:
                self.record.parameters.checked(parameters)
            trajectory = Trajectory(**rows, parameters=parameters, obstacle_poses=poses)
        except UsageError as error:
            # The command spells the remedies.
            text = str(error.args[0] if error.remedies else error)
            raise self._error(text, remedies=error.remedies) from error
        return trajectory

    def check_units(self, trajectory: Trajectory) -> None:
        """Check the units that the columns of the trajectory do not state; see ``table_units``."""
        time = self._time_column()
        unknown = self.options.rate is None and time is not None
        stated = not unknown or self._stated(time or "") is not None
        if not stated or (self.lacks_joint_unit and not self.table.has_units):
            angle = self.options.unit or "rad"
            self.notes.append(
                f"columns without a unit are read in s, {angle} and m, and their derivatives"
            )
        readings = Readings(
            self.table.place,
            None if stated else time,
            joints=not self._has_unit("q"),
            velocities=not self._has_unit("dq"),
        )
        check_units(readings, trajectory, self.velocity_limit)

    def _without_repeats(self, rows: dict[str, Any]) -> dict[str, Any]:
        """Drop rows that repeat the time and the positions of the row before."""
        repeated = np.append(False, np.diff(rows["t"]) == 0)
        moved = repeated & np.append(False, (np.diff(rows["q"], axis=0) != 0).any(1))
        if moved.any():
            raise self._error(
                f"{self._row_text(int(moved.argmax()))} has the time of the row before and other positions"
            )
        if repeated.any():
            self.notes.append(
                f"{self.table.place}: {int(repeated.sum()):,} repeated rows are dropped"
            )
        return {
            name: None if values is None else values[~repeated]
            for name, values in rows.items()
        }

    def unused(self) -> list[str]:
        """Return the names of the columns and other elements that were not read."""
        names = [name for name in self.table.columns if name not in self.used]
        return [*names, *dict.fromkeys(self.other_joints), *self.table.unused]

    def _error(self, text: str, **details: Any) -> UsageError:
        return UsageError(f"{self.table.place}: {text}", **details)

    def _check_names(self) -> None:
        """Check that no name is there twice, also with different units, and that options name columns."""
        known: dict[str, str] = {}
        for name in self.table.columns:
            if (other := known.setdefault(key_of(name), name)) != name:
                raise self._error(f"the columns {other!r} and {name!r} have one name")
        names = self.table.joint_names
        if twice := [name for name in names if names.count(name) > 1]:
            raise self._error(f"the joint {twice[0]!r} is there more than once")
        if not self.table.has_head:
            self._check_numbered()
        self._check_held_joints()

    def _check_held_joints(self) -> None:
        """Check that joints that are not planned are where the problem holds them."""
        held = self.record.held_joints
        for joint, position in self.table.held_joints.items():
            if joint in held and abs(position - held[joint]) > MAX_HELD_DIFFERENCE:
                raise self._error(
                    f"the joint {joint!r} is held at {position:g}, the problem holds it at {held[joint]:g}"
                )

    def _check_numbered(self) -> None:
        """Check that columns without names are those of times and joints, or named by options."""
        width = len(self.table.columns)
        n = len(self.joints)
        if all(joint.isdecimal() for joint in self.joints) or (
            width == n + (self.options.rate is None)
        ):
            return
        raise self._error(
            f"{width} columns without a head, expected {n + 1} of times and joints:"
            " {joints} gives the columns of the joints, {time} that of the times, numbered from 0",
            remedies={"joints": ",".join(map(str, range(1, n + 1))), "time": "0"},
        )

    def _parameters(self) -> Array | None:
        """Return the values of the problem's parameters, shape (p,)."""
        ranges = self.record.parameters
        columns = {plain(name): name for name in self.table.columns}
        found = dict(self.parameters)
        for parameter, unit in zip(ranges.names, ranges.value_units, strict=True):
            if (name := columns.get(parameter)) is None:
                continue
            values = np.unique(
                self._numbers(name, ndim=self.table.columns[name].ndim and 1)
            )
            if len(values) != 1:
                raise self._error(
                    f"{name} must have one value, got {values[0]:g} and {values[-1]:g}"
                )
            value = float(values[0]) * self._factor(name, unit, 1.0)
            if found.setdefault(parameter, value) != value:
                raise self._error(
                    f"{name} is {value:g}, {{parameters}} gives another value",
                    remedies={"parameters": f"{parameter}={found[parameter]:g}"},
                )
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
        return np.asarray(rows[0])

    def _times(self, count: int) -> Array:
        """Return the times of the samples [s]."""
        name = self._time_column()
        rate = self.options.rate
        if rate is not None and (
            name is None or not self._has_times_of_rate(name, rate)
        ):
            return np.arange(count) / rate
        if name is not None:
            return self._seconds(name)
        text = f"no column of times ({', '.join(TIME_NAMES)})"
        if similar := self._increasing_columns(count):
            raise self._error(
                f"{text}: {listed(similar, MAX_LISTED)} increases as times do, {{time}} names the column",
                remedies={"time": similar[0]},
            )
        raise self._error(f"{text}: state {{rate}}", remedies={"rate": 100})

    def _increasing_columns(self, count: int) -> list[str]:
        """Return the columns that may be times: numbers that increase, and do not count the rows."""
        return [
            name
            for name, values in self.table.columns.items()
            if name not in self.used
            and values.shape == (count,)
            and values.dtype.kind in "iuf"
            and count > 1
            and (np.diff(values) > 0).all()
            and not (np.diff(values) == 1).all()
        ]

    def _seconds(self, name: str) -> Array:
        stated = self._stated(name)
        if stated is not None and stated[0] != "s":
            raise self._error(f"{name} must have a unit of s")
        factor = 1.0 if stated is None else stated[1]
        values = self._numbers(name, ndim=1)
        # Integers of times since 1970 in ns have more digits than a float.
        first = self.table.columns[name][0]
        if self.table.columns[name].dtype.kind in "iu":
            values = (self.table.columns[name] - first).astype(float) + (
                float(first) if abs(float(first) * factor) < MAX_EXACT_START_S else 0.0
            )
        return values * factor

    def _stated(self, name: str) -> tuple[str, float] | None:
        """Return the unit of a column of times: that of its name, or that of the option."""
        return stated_factor(name) or stated_factor(self.options.time or "")

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
        if self.options.time is not None:
            return self._named_column(self.options.time, "time")
        if not self.table.has_head:
            return None if self.options.rate is not None else "0"
        return next(
            (name for name in self.table.columns if plain(name).lower() in TIME_NAMES),
            None,
        )

    def _named_column(self, name: str, argument: str) -> str:
        """Return the column that an option names, with or without its unit."""
        columns = self.table.columns
        if name in columns:
            return name
        keys = {key_of(column): column for column in columns}
        if (key := key_of(name)) not in keys:
            raise UsageError(
                f"{self.table.place}: there is no column {name!r}, only {listed(list(columns), MAX_LISTED)}"
                f"{nearest(name, columns)}",
                concerns=argument,
            )
        return keys[key]

    def _kind(self, kind: str) -> Array | None:
        """Return positions, velocities or accelerations of the problem's joints, shape (K, n), or None."""
        if kind == "dq" and self.velocities:
            names = [self._named_column(name, "velocities") for name in self.velocities]
            return self._stacked(names, kind)
        for word in KIND_NAMES[kind]:
            for name, values in self.table.columns.items():
                if plain(name).lower() == word and values.ndim == 2:
                    return self._selected(name) * self._factors(
                        [name] * len(self.joints), kind
                    )
        found = self._scalar_columns(kind)
        return None if found is None else self._stacked(found, kind)

    def _stacked(self, names: list[str], kind: str) -> Array:
        columns = np.stack([self._numbers(name, ndim=1) for name in names], axis=1)
        return columns * self._factors(names, kind)

    def _selected(self, name: str) -> Array:
        """Return the problem's joints of an array with one column per joint."""
        values = self._numbers(name, ndim=2)
        joints = self.joints
        width = values.shape[1]
        named = self.table.joint_names
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
            self.other_joints += [joint for joint in named if joint not in joints]
            return values[:, [named.index(joint) for joint in joints]]
        if all(joint.isdecimal() and int(joint) < width for joint in joints):
            others = set(map(str, range(width))) - set(joints)
            self.other_joints += [f"{name}[{index}]" for index in sorted(others)]
            return values[:, [int(joint) for joint in joints]]
        if width != len(joints):
            raise self._error(
                f"{name} has {width} columns, the problem plans {len(joints)} joints"
            )
        self._note_order(f"the columns of {name}")
        return values

    def _note_order(self, columns: str) -> None:
        """Note that columns without names of joints are read in the problem's order."""
        names = self.record.joint_names
        if self.joints != names:
            raise self._error(
                f"{columns} have no names of joints: {{joints}} must give their numbers",
                remedies={"joints": None},
            )
        self.notes.append(
            f"columns without names of joints are read in the problem's order: {', '.join(names)}"
        )

    def _scalar_columns(self, kind: str) -> list[str] | None:
        """Return the column of every joint, or None without any."""
        joints = self.joints
        table = self.table
        if not table.has_head:
            if kind != "q":
                return None
            if all(joint.isdecimal() for joint in joints):
                return [self._named_column(joint, "joints") for joint in joints]
            first = int(self.options.rate is None)
            self._note_order("columns without a head")
            return [str(k + first) for k in range(len(joints))]
        keys = {
            key_of(name): name
            for name, values in table.columns.items()
            if values.ndim == 1
        }
        try:
            names = joint_columns(keys, joints, kind)
        except ValueError as error:
            raise self._error(str(error)) from error
        if names and column_of(keys, joints[0], kind) is None:
            self._note_order(f"the columns {names[0]!r} to {names[-1]!r}")
        return names

    def _has_unit(self, kind: str) -> bool:
        """Return whether a column of a kind states its unit."""
        words = KIND_NAMES[kind]
        return any(
            stated_factor(name) is not None
            for name in self.used
            if any(word in plain(name).lower() for word in words) or kind == "q"
            if name != self._time_column()
        )

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
                (k for k, value in enumerate(values.tolist()) if not is_number(value)),
                0,
            )
            raise self._error(
                f"{self._row_text(row)}: {name} must be a number, got {values[row].item()!r:.60}"
            )
        return values.astype(float)

    def _row_text(self, row: int) -> str:
        lines = self.table.lines
        return f"line {lines[row]}" if lines else f"row {row}"

    def _factors(self, names: Sequence[str], kind: str) -> Array:
        """Return the factors to SI units of the columns of a kind, one per joint, shape (n,)."""
        exponent = {"q": "", "dq": "/s", "ddq": "/s^2"}[kind]
        turning = ("rad", DEGREE if self.options.unit == "deg" else 1.0)
        units = [
            ("m", 1.0) if slides else turning for slides in self.record.prismatic_joints
        ]
        parts = list(zip(names, units, strict=True))
        lacking = [unit for name, (unit, _) in parts if stated_factor(name) is None]
        self.lacks_joint_unit |= bool(lacking)
        self.lacks_unit |= "rad" in lacking
        return np.array(
            [
                self._factor(name, unit + exponent, usual)
                for name, (unit, usual) in parts
            ]
        )

    def _factor(self, name: str, unit: str, default: float) -> float:
        """Return the factor to SI of a column by the unit in its name, such as ``[deg/s]``; a default without one."""
        stated = stated_factor(name)
        if stated is None:
            return default
        if stated[0] != unit:
            text = name[name.rindex("[") + 1 :].rstrip(" ]")
            raise self._error(f"{name} must have a unit of {unit}, got {text!r}")
        return stated[1]

    def _missing(self) -> str:
        """Return the message for missing positions."""
        joint = self.joints[0]
        columns = ", ".join(list(self.table.columns)[:12])
        expected = f"q {joint}, {joint}_position, {joint} and so on, or an array q"
        return f"no columns with joint positions, expected {expected}; there are {columns or 'no columns'}"
