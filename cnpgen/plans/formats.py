"""Built-in export formats: archives of NumPy, tables, messages of ROS 2, and path splines."""

import csv
import io
import json
import re
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray, Array, Integers
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError, requires_extra
from cnpgen.plans.exporter import ExportedSet, Exporter, SampledPlan, parameter_columns
from cnpgen.plans.format import JOINT_NAMES_KEY, PHASE_COLUMN, PLAN_COLUMN
from cnpgen.store.files.atomic import committing, write_file
from cnpgen.store.files.hdf5 import create_hdf5
from cnpgen.store.joint_units import unit_of, units_of_joints
from cnpgen.trajectory.spline_motion import Motion

NANOSECONDS = 10**9  # per second, of stamps of ROS
PATH_WAYPOINTS = 128  # of a path spline, equidistant in phase
# YAML 1.1, which ROS's tools read, parses 1e-05 as text: a number needs a point before
# its exponent.
_WITHOUT_POINT = re.compile(r"(?<![\d.])(\d+)(?=e[+-])")


@dataclass(frozen=True)
class NumpyArchive(Exporter):
    """One NumPy archive with all plans.

    Its arrays are numbered by the indices of the plans ('cnpgen docs plan-format').
    """

    suffix = ".npz"
    single_file = True

    def write(
        self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet
    ) -> None:
        """Write the archive plan by plan, since ``numpy.savez`` requires all in memory; see ``Exporter.write``."""
        held = exported.held_joints
        common = {
            "plan": exported.index,
            "sample_id": exported.sample_id,
            "joint_names": np.array(exported.joint_names),
            "held_joint_names": np.array([*held], np.str_),
            "held_joint_positions": np.array([*held.values()], np.float64),
        }
        with committing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for name, values in common.items():
                _add(archive, name, values)
            for plan in plans:
                for name in ("t", *exported.columns):
                    _add(archive, f"plan_{plan.index:05d}_{name}", getattr(plan, name))
                if plan.phase is not None:
                    _add(archive, f"plan_{plan.index:05d}_{PHASE_COLUMN}", plan.phase)
                for name, value in zip(
                    exported.parameters, plan.parameters, strict=True
                ):
                    _add(archive, f"plan_{plan.index:05d}_{name}", np.array(value))


@dataclass(frozen=True)
class CsvTables(Exporter):
    """A folder with one CSV table per plan; numbers read back as the same float64.

    'cnpgen docs plan-format' lists its columns.
    """

    suffix = ".csv"

    def write(
        self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet
    ) -> None:
        """Write a table with names and units as header; see ``Exporter.write``."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        units = {
            name: units_of_joints(unit, exported.prismatic)
            for name, unit in exported.columns.items()
        }
        joints = list(enumerate(exported.joint_names))
        heads = [
            f"{name} {joint} [{unit_of(units[name], i)}]"
            for name in exported.columns
            for i, joint in joints
        ]
        # This format has one file per plan.
        (plan,) = plans
        phase = [] if plan.phase is None else [plan.phase]
        writer.writerow(
            [
                "t [s]",
                *heads,
                *[PHASE_COLUMN] * len(phase),
                *parameter_columns(exported.parameters),
            ]
        )
        columns = [getattr(plan, name) for name in exported.columns]
        columns += [*phase, *(np.full(len(plan.t), value) for value in plan.parameters)]
        writer.writerows(np.column_stack([plan.t, *columns]).tolist())
        write_file(path, text.getvalue())


@dataclass(frozen=True)
class ParquetTable(Exporter):
    """One Parquet file with all plans, one row per sample.

    Every plan is a row group ('cnpgen docs plan-format'). The metadata have the names
    of the joints and the units.
    """

    suffix = ".parquet"
    single_file = True

    def write(
        self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet
    ) -> None:
        """Write the table plan by plan; see ``Exporter.write``."""
        with requires_extra("parquet", "pyarrow"):
            import pyarrow
            import pyarrow.parquet

        schema = _parquet_schema(exported)
        samples = dict(
            zip(exported.index.tolist(), exported.sample_id.tolist(), strict=True)
        )
        with (
            committing(path) as temporary,
            pyarrow.parquet.ParquetWriter(temporary, schema) as writer,
        ):
            for plan in plans:
                count = len(plan.t)
                ids = np.full(count, plan.index), np.full(count, samples[plan.index])
                columns = [pyarrow.array(values) for values in (*ids, plan.t)]
                columns += [
                    fixed_lists(getattr(plan, name)) for name in exported.columns
                ]
                phase = [] if exported.motion is None else [plan.phase]
                others = *phase, *(np.full(count, value) for value in plan.parameters)
                columns += [pyarrow.array(values) for values in others]
                writer.write_table(pyarrow.table(columns, schema=schema))


def _parquet_schema(exported: ExportedSet) -> Any:
    """Return names and types of the columns, with names of joints and units as metadata."""
    import pyarrow

    units = {"t": "s"} | {
        name: units_of_joints(unit, exported.prismatic)
        for name, unit in exported.columns.items()
    }
    metadata = {
        JOINT_NAMES_KEY: json.dumps(exported.joint_names),
        "units": json.dumps(units),
        "held_joints": json.dumps(exported.held_joints),
    }
    whole = pyarrow.int64()
    real = pyarrow.float64()
    per_joint = pyarrow.list_(real, len(exported.joint_names))
    phase = [] if exported.motion is None else [PHASE_COLUMN]
    columns = {
        PLAN_COLUMN: whole,
        "sample_id": whole,
        "t": real,
        **dict.fromkeys(exported.columns, per_joint),
        **dict.fromkeys([*phase, *parameter_columns(exported.parameters)], real),
    }
    return pyarrow.schema(columns, metadata=metadata)


@dataclass(frozen=True)
class JointTrajectory(Exporter):
    """A folder with one message of ROS 2 per plan, ``trajectory_msgs/JointTrajectory`` as JSON, one point per line.

    Positions, velocities and accelerations are included, efforts are not. The header
        time is 0: start immediately.
    """

    suffix = ".json"
    ticks_per_s = NANOSECONDS

    def write(
        self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet
    ) -> None:
        """Write a message; see ``Exporter.write``."""
        (plan,) = plans
        points = ",\n    ".join(_point_text(plan, k) for k in range(len(plan.t)))
        header = json.dumps({"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""})
        names = json.dumps(exported.joint_names)
        write_file(
            path,
            f'{{\n  "header": {header},\n  "joint_names": {names},\n  "points": [\n    {points}\n  '
            "]\n}\n",
        )


@dataclass(frozen=True)
class TrajectoryControllerGoal(Exporter):
    """A folder with one goal of ``control_msgs/action/FollowJointTrajectory`` per plan, as YAML.

    ``ros2 action send_goal`` takes the content as its goal.
    """

    suffix = ".yaml"
    ticks_per_s = NANOSECONDS

    def write(
        self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet
    ) -> None:
        """Write a goal; see ``Exporter.write``."""
        (plan,) = plans
        lines = [
            "trajectory:",
            f"  joint_names: {json.dumps(exported.joint_names)}",
            "  points:",
            *(
                f"    - {_point_text(plan, k, effort=False)}"
                for k in range(len(plan.t))
            ),
        ]
        write_file(path, "\n".join(lines) + "\n")


@dataclass(frozen=True)
class PathSplines(Exporter):
    """One HDF5 file with the paths of all plans as clamped B-splines over [0, 1]; durations are in a column.

    Motion Planning Diffusion trains on it (Carvalho et al. 2025).

    For N paths with C control points: ``bspline_params_tt`` (N, C + d + 1),
    ``bspline_params_cc`` (N, n, C), ``bspline_params_k`` (N,), ``sol_path`` (N, 128, n)
    [rad], ``task_id`` (N,), ``q_start`` and ``q_goal`` (N, n), and ``duration`` (N,)
    [s].
    """

    suffix = ".hdf5"
    single_file = True
    samples = False

    def write(
        self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet
    ) -> None:
        """Write the file; see ``Exporter.write``."""
        # Splines are not sampled in time.
        del plans
        motion = exported.motion
        if motion is None:
            raise UsageError(
                "joined plans have no single spline: choose another format",
                concerns="to",
            )
        import h5py

        buffer = io.BytesIO()
        with h5py.File(create_hdf5(buffer)) as file:
            for name, values in _spline_columns(motion, exported).items():
                file.create_dataset(name, data=values, track_times=False)
            file.attrs["joint_names"] = list(exported.joint_names)
            file.attrs["problem"] = exported.problem
        write_file(path, buffer.getvalue())


def _point_text(plan: SampledPlan, k: int, *, effort: bool = True) -> str:
    """Return sample k of a plan as a ``trajectory_msgs/JointTrajectoryPoint`` in one line of JSON that is also YAML."""
    # Stamps are integers: whole seconds and the nanoseconds in them.
    sec, nanosec = divmod(round(plan.t[k] * NANOSECONDS), NANOSECONDS)
    values = {"positions": plan.q, "velocities": plan.dq, "accelerations": plan.ddq}
    point: JsonObject = {name: rows[k].tolist() for name, rows in values.items()}
    if effort:
        point["effort"] = []
    text = json.dumps({**point, "time_from_start": {"sec": sec, "nanosec": nanosec}})
    return _WITHOUT_POINT.sub(r"\1.0", text)


def _add(archive: zipfile.ZipFile, name: str, values: AnyArray) -> None:
    """Add an array with a fixed date, so that equal plans give equal bytes."""
    with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
        np.lib.format.write_array(member, values, allow_pickle=False)


def _spline_columns(
    motion: Motion, exported: ExportedSet
) -> dict[str, Array | Integers]:
    """Return the datasets of the file."""
    from scipy.interpolate import BSpline

    count = len(motion.path)
    points = motion.path.shape[1]
    degree = motion.degree
    # A clamped knot vector repeats both ends degree + 1 times, so that the curve starts
    # and ends at control points.
    inner = np.linspace(0, 1, points - degree + 1)
    knots = np.concatenate([np.zeros(degree), inner, np.ones(degree)])
    # scipy takes the control points along the first axis, all plans at once.
    control = motion.path.transpose(1, 0, 2)
    waypoints = BSpline(knots, control, degree)(
        np.linspace(0, 1, PATH_WAYPOINTS)
    ).transpose(1, 0, 2)
    return {
        "bspline_params_tt": np.tile(knots, (count, 1)),
        "bspline_params_cc": np.ascontiguousarray(motion.path.transpose(0, 2, 1)),
        "bspline_params_k": np.full(count, degree, np.int64),
        "sol_path": np.ascontiguousarray(waypoints),
        "task_id": exported.sample_id,
        "q_start": motion.path[:, 0],
        "q_goal": motion.path[:, -1],
        "duration": motion.duration(),
    }


def fixed_lists(values: AnyArray) -> Any:
    """Return an array of shape (K, w) as K lists of w values."""
    import pyarrow

    # Rows of one width need no list of offsets.
    flat = pyarrow.array(np.ascontiguousarray(values).ravel())
    return pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def write_parquet(path: Path, table: Any) -> None:
    """Write a table of pyarrow, atomically."""
    import pyarrow.parquet

    buffer = io.BytesIO()
    pyarrow.parquet.write_table(table, buffer)
    write_file(path, buffer.getvalue())
