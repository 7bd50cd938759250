"""Export formats of plans, sampled at evenly spaced times: tables, messages and archives."""

import csv
import io
import json
import math
import re
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.plans.format import UNITS
from cnpgen.store.files.atomic import committing
from cnpgen.store.joint_units import unit_of, units_of_joints
from cnpgen.trajectory.joined import JoinedMotion
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]

MIN_LAST_STEP_FRACTION = 0.01  # minimum length of the last step in steps; a shorter one is merged with the step before

# YAML 1.1, which ROS's tools read, parses 1e-05 as text: a number needs a point before its exponent.
_WITHOUT_POINT = re.compile(r"(?<![\d.])(\d+)(?=e[+-])")


@dataclass(frozen=True)
class Sampled:
    """Plan sampled at K times.

    Attributes:
        t: Times [s], shape (K,), strictly increasing from 0 to the duration.
        q: Joint positions [rad], shape (K, n).
        dq: Joint velocities [rad/s], shape (K, n).
        ddq: Joint accelerations [rad/s^2], shape (K, n).
        jerk: Joint jerks [rad/s^3], shape (K, n).
    """

    t: Array
    q: Array
    dq: Array
    ddq: Array
    jerk: Array


def sample_plan(motion: Motion | JoinedMotion, rate: float) -> Sampled:
    """Sample one motion at ``rate`` [Hz], and at its last instant."""
    duration = float(motion.duration()[0])
    count = max(math.ceil(duration * rate - MIN_LAST_STEP_FRACTION), 1)
    t = np.append(np.arange(count) / rate, duration)
    states = motion.at_times(t[None])
    return Sampled(t, states.q[0], states.dq[0], states.ddq[0], states.jerk[0])


def csv_table(sampled: Sampled, joints: tuple[str, ...], sliding: tuple[bool, ...]) -> str:
    """Write a plan as a CSV table; every number reads back as the same float64.

    Args:
        sampled: Sampled plan.
        joints: Names of the joints.
        sliding: Whether each joint is prismatic.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    units = {name: units_of_joints(unit, sliding) for name, unit in UNITS.items()}
    heads = [f"{name} {joint} [{unit_of(units[name], i)}]" for name in UNITS for i, joint in enumerate(joints)]
    writer.writerow(["t [s]", *heads])
    columns = [getattr(sampled, name) for name in UNITS]
    writer.writerows(np.column_stack([sampled.t, *columns]).tolist())
    return text.getvalue()


def joint_trajectory(sampled: Sampled, joints: tuple[str, ...]) -> str:
    """Write a plan as a message, ROS's ``trajectory_msgs/JointTrajectory`` as JSON, one point per line.

    Positions, velocities and accelerations are included, efforts are not. The header time is 0: start immediately.
    """
    rows = zip(sampled.t, sampled.q.tolist(), sampled.dq.tolist(), sampled.ddq.tolist(), strict=True)
    points = ",\n    ".join(json.dumps(_point(*row)) for row in rows)
    header = json.dumps({"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""})
    names = json.dumps(joints)
    points = _WITHOUT_POINT.sub(r"\1.0", points)
    return f'{{\n  "header": {header},\n  "joint_names": {names},\n  "points": [\n    {points}\n  ]\n}}\n'


def _point(t: float, q: list[float], dq: list[float], ddq: list[float]) -> dict[str, Any]:
    sec, nanosec = divmod(round(t * 1e9), 10**9)
    stamp = {"sec": sec, "nanosec": nanosec}
    return {"positions": q, "velocities": dq, "accelerations": ddq, "effort": [], "time_from_start": stamp}


def write_npz(path: Path, about: dict[str, NDArray[Any]], plans: Iterable[tuple[int, Sampled]]) -> None:
    """Write plans to a NumPy archive atomically, plan by plan, since ``numpy.savez`` requires all in memory.

    Args:
        path: Path of the archive.
        about: Arrays for all plans: name -> values.
        plans: (index, samples) of every plan.

    Raises:
        MachineError: The disk is full or read-only, or a file operation failed.
    """
    with committing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, values in about.items():
            _add(archive, name, values)
        for number, sampled in plans:
            for name, values in vars(sampled).items():
                _add(archive, f"plan_{number:05d}_{name}", values)


def _add(archive: zipfile.ZipFile, name: str, values: NDArray[Any]) -> None:
    """Add an array with a fixed date, so that equal plans give equal bytes."""
    with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
        np.lib.format.write_array(member, values, allow_pickle=False)
