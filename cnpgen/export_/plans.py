"""Plans as sampled trajectories for robots and simulators: NumPy archives, CSV files or ROS messages."""

import csv
import io
import json
import math
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError
from cnpgen.plans.plans import Plans, screen
from cnpgen.plans.status import PlanStatus
from cnpgen.store.files import committing, write_file
from cnpgen.trajectory.motion import Motion

Array = NDArray[np.float64]
Form = Literal["npz", "csv", "joint-trajectory"]

FORMS: tuple[Form, ...] = ("npz", "csv", "joint-trajectory")
MOST_SAMPLES = 1_000_000  # of one plan
HIGHEST_RATE = 1e6  # Hz: steps of 1 us, of which ROS stamps can say a thousandth
LEAST_STEP = 0.01  # the last step may be this part of a step; what would be shorter is joined to the step before
UNITS = {"q": "rad", "dq": "rad/s", "ddq": "rad/s^2", "jerk": "rad/s^3"}


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


@dataclass(frozen=True)
class Exported:
    """What ``export_plans`` did.

    Attributes:
        files: The files that it wrote, in the order of the plans.
        count: How many plans are in them.
        refused: Index of each plan that could not be exported -> why, naming it.
    """

    files: tuple[Path, ...]
    count: int
    refused: dict[int, str]


def export_plans(plans: Plans, out: str | Path, *, to: Form, rate: float = 1000.0) -> Exported:
    """Sample plans in time and write them.

    * "npz": one file; ``plan_00000_t`` (K,), ``plan_00000_q``, ``_dq``, ``_ddq`` and ``_jerk`` (K, n) of every plan,
      numbered by its place among ``plans``; ``plan`` and ``sample_id`` (the numbers of those that are there),
      ``joint_names``.
    * "csv": one file per plan, ``plan_00000.csv``, with a header of names and units.
    * "joint-trajectory": one JSON file per plan, ``plan_00000.json``, with the fields of ROS's
      ``trajectory_msgs/JointTrajectory``.

    Plans that cannot be sampled are left out, and said to be.

    Args:
        plans: The plans.
        out: The file to write for "npz" (in a folder that exists: ``plans.npz``), else a folder, which is made.
        to: The form.
        rate: Samples per second [Hz]; the last instant of a plan is always one of its samples.

    Raises:
        UsageError: An argument makes no sense.
        DatasetError: None of the plans can be exported.
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    if to not in FORMS:
        raise UsageError(f"plans can be exported to {', '.join(FORMS)}, got {to!r}")
    if not 0 < rate <= HIGHEST_RATE:
        raise UsageError(f"the rate must be above 0 and at most {HIGHEST_RATE:g} Hz, got {rate}")
    out, refused = Path(out), _refused(plans, rate)
    if len(refused) == len(plans):
        reasons = "; ".join(list(refused.values())[:3])
        raise DatasetError(f"none of the {len(plans)} plans can be exported{': ' if reasons else ''}{reasons}")
    files = _write_npz(out, plans, rate, refused) if to == "npz" else _write_each(out, plans, rate, refused, to)
    return Exported(files, len(plans) - len(refused), dict(sorted(refused.items())))


def sample_plan(motion: Motion, rate: float) -> Sampled:
    """Sample one motion at ``rate`` [Hz], and at its last instant."""
    duration = float(motion.duration()[0])
    count = max(math.ceil(duration * rate - LEAST_STEP), 1)
    t = np.append(np.arange(count) / rate, duration)
    states = motion.at(motion.phase_at(t[None]))
    return Sampled(t, states.q[0], states.dq[0], states.ddq[0], states.jerk[0])


def _refused(plans: Plans, rate: float) -> dict[int, str]:
    """Find the plans that cannot be sampled: index -> why."""
    found, motion = {}, plans.motion
    for index, (status, duration) in enumerate(zip(screen(plans), plans.duration, strict=True)):
        why = ""
        if status != PlanStatus.UNKNOWN:
            why = PlanStatus(status).text
        elif duration < 1e-9:
            why = f"it lasts {duration:.3g} s, less than a nanosecond"
        elif duration * rate > MOST_SAMPLES:
            why = f"it lasts {duration:.3g} s: more than {MOST_SAMPLES} samples at {rate:g} Hz"
        elif not np.isfinite(motion[[index]].at(np.linspace(0, 1, 101)).jerk).all():
            why = "its derivatives are too large to compute with"
        if why:
            found[index] = f"plan {index} (sample {plans.sample_id[index]}): {why}"
    return found


def _sampled(plans: Plans, rate: float, refused: dict[int, str]) -> Iterator[tuple[int, Sampled]]:
    for index in range(len(plans)):
        if index not in refused:
            yield index, sample_plan(plans.motion[[index]], rate)


def _write_npz(out: Path, plans: Plans, rate: float, refused: dict[int, str]) -> tuple[Path, ...]:
    """Write one archive, plan by plan: ``numpy.savez`` would need all of them in memory."""
    path = out / "plans.npz" if out.is_dir() else out
    kept = np.array([index for index in range(len(plans)) if index not in refused])
    with committing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        _add(archive, "plan", kept)
        _add(archive, "sample_id", plans.sample_id[kept])
        _add(archive, "joint_names", np.array(plans.problem.joint_names))
        for index, sampled in _sampled(plans, rate, refused):
            for name, values in vars(sampled).items():
                _add(archive, f"plan_{index:05d}_{name}", values)
    return (path,)


def _add(archive: zipfile.ZipFile, name: str, values: NDArray[Any]) -> None:
    """Add an array under a fixed date, so that equal plans give equal bytes."""
    with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
        np.lib.format.write_array(member, values, allow_pickle=False)


def _write_each(out: Path, plans: Plans, rate: float, refused: dict[int, str], to: Form) -> tuple[Path, ...]:
    """Write one file per plan."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file, but {to!r} makes one file per plan: give a folder")
    encode, ending = (_csv, "csv") if to == "csv" else (_joint_trajectory, "json")
    files = []
    for index, sampled in _sampled(plans, rate, refused):
        files.append(out / f"plan_{index:05d}.{ending}")
        write_file(files[-1], encode(sampled, plans.problem.joint_names))
    return tuple(files)


def _csv(sampled: Sampled, joints: tuple[str, ...]) -> str:
    """Write a table; every number reads back as the same float64."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["t [s]", *(f"{name} {joint} [{unit}]" for name, unit in UNITS.items() for joint in joints)])
    columns = [getattr(sampled, name) for name in UNITS]
    writer.writerows(np.column_stack([sampled.t, *columns]).tolist())
    return text.getvalue()


def _joint_trajectory(sampled: Sampled, joints: tuple[str, ...]) -> str:
    """Write a message as JSON, one point per line."""
    rows = zip(sampled.t, sampled.q.tolist(), sampled.dq.tolist(), sampled.ddq.tolist(), strict=True)
    points = [json.dumps(_point(*row)) for row in rows]
    header = json.dumps({"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""})
    inner = ",\n    ".join(points)
    return f'{{\n  "header": {header},\n  "joint_names": {json.dumps(joints)},\n  "points": [\n    {inner}\n  ]\n}}\n'


def _point(t: float, q: list[float], dq: list[float], ddq: list[float]) -> dict[str, Any]:
    sec, nanosec = divmod(round(t * 1e9), 10**9)
    stamp = {"sec": sec, "nanosec": nanosec}
    return {"positions": q, "velocities": dq, "accelerations": ddq, "effort": [], "time_from_start": stamp}
