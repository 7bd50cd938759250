"""The forms that plans are exported in: sampled at evenly spaced moments, as tables, messages or an archive."""

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
from cnpgen.trajectory.motion import Motion

Array = NDArray[np.float64]

LEAST_STEP = 0.01  # the last step may be this part of a step; what would be shorter is joined to the step before

# YAML 1.1, which ROS's tools read, takes 1e-05 for a text: a number needs a point before its exponent.
_WITHOUT_POINT = re.compile(r"(?<![\d.])(\d+)(?=e[+-])")


@dataclass(frozen=True)
class Sampled:
    """A plan sampled at K moments.

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
    count = max(math.ceil(duration * rate - LEAST_STEP), 1)
    t = np.append(np.arange(count) / rate, duration)
    states = motion.at_times(t[None])
    return Sampled(t, states.q[0], states.dq[0], states.ddq[0], states.jerk[0])


def csv_table(sampled: Sampled, joints: tuple[str, ...], sliding: tuple[bool, ...]) -> str:
    """Write a plan as a table of CSV; every number reads back as the same float64.

    Args:
        sampled: The plan.
        joints: Names of the joints.
        sliding: Of each whether it slides.
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

    Positions, velocities and accelerations are given, efforts are not; the time of the header is 0: begin at once.
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
    """Write plans as an archive of NumPy, plan by plan, atomically: ``numpy.savez`` would need all of them in memory.

    Args:
        path: Where to.
        about: Arrays about all plans: name -> values.
        plans: (number, samples) of every plan.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    with committing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, values in about.items():
            _add(archive, name, values)
        for number, sampled in plans:
            for name, values in vars(sampled).items():
                _add(archive, f"plan_{number:05d}_{name}", values)


def _add(archive: zipfile.ZipFile, name: str, values: NDArray[Any]) -> None:
    """Add an array under a fixed date, so that equal plans give equal bytes."""
    with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
        np.lib.format.write_array(member, values, allow_pickle=False)
