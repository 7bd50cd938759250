"""Export of plans: sampling in time, and writing in one of several formats."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from cnpgen.errors import DatasetError, UsageError
from cnpgen.plans.formats import Sampled, csv_table, joint_trajectory, sample_plan, write_npz
from cnpgen.plans.join import JoinedPlans
from cnpgen.plans.plans import Plans, check_plans_type, screen
from cnpgen.plans.status import PlanStatus
from cnpgen.store.files.atomic import write_file

Form = Literal["npz", "csv", "joint-trajectory"]

FORMS: tuple[Form, ...] = get_args(Form)
MAX_SAMPLES = 1_000_000  # per plan
MAX_RATE_HZ = 1e6  # steps of 1 us; ROS stamps resolve 1 ns


@dataclass(frozen=True)
class Exported:
    """Result of ``export_plans``.

    Attributes:
        files: Written files, in the order of the plans.
        count: Number of exported plans.
        refused: Index of each plan that could not be exported -> message.
        invalid: Indices of exported plans with a status other than valid or unknown.
        held_joints: File with the positions of unplanned movable joints, for csv and joint-trajectory, if the robot has
            such joints.
    """

    files: tuple[Path, ...]
    count: int
    refused: dict[int, str]
    invalid: tuple[int, ...] = ()
    held_joints: Path | None = None


def export_plans(
    plans: Plans | JoinedPlans, out: str | Path, *, to: Form, rate: float = 1000.0, only: Sequence[int] | None = None
) -> Exported:
    """Sample plans in time and write them; existing files are replaced.

    * "npz": one file; ``plan_00000_t`` (K,), ``plan_00000_q``, ``_dq``, ``_ddq`` and ``_jerk`` (K, n) of every plan,
      numbered by its index in ``plans``; ``plan`` and ``sample_id`` of the exported plans,
      ``joint_names``; ``held_joint_names`` and ``held_joint_positions`` of unplanned movable joints.
    * "csv": one file per plan, ``plan_00000.csv``, with a header of names and units.
    * "joint-trajectory": one JSON file per plan, ``plan_00000.json``, with the fields of ROS's
      ``trajectory_msgs/JointTrajectory``.

    Tables and messages do not contain unplanned joints. If the robot has movable ones, ``held_joints.yaml`` contains
    their positions.

    Plans that cannot be sampled are omitted and reported.

    Args:
        plans: Plans, or joined plans of ``join_plans``.
        out: File for "npz" (in an existing folder: ``plans.npz``), otherwise a folder, which is created.
        to: Format, see above.
        rate: Samples per second [Hz]; the last instant of a plan is always one of its samples.
        only: Indices of the plans to export; all by default.

    Raises:
        UsageError: An argument is invalid.
        DatasetError: No plan can be exported.
        MachineError: The disk is full or read-only, or a file operation failed.
    """
    if not isinstance(plans, JoinedPlans):
        check_plans_type(plans)
    if to not in FORMS:
        raise UsageError(f"plans can be exported to {', '.join(FORMS)}, got {to!r}")
    if not 0 < rate <= MAX_RATE_HZ:
        raise UsageError(f"the rate must be above 0 and at most {MAX_RATE_HZ:g} Hz, got {rate}")
    chosen = _chosen(plans, only)
    out, refused = Path(out), _refused(plans, rate, chosen)
    kept = [index for index in chosen if index not in refused]
    if not kept:
        reasons = "; ".join(list(refused.values())[:3])
        raise DatasetError(f"none of the {len(chosen)} plans can be exported{': ' if reasons else ''}{reasons}")
    files = _write_npz(out, plans, rate, kept) if to == "npz" else _write_each(out, plans, rate, kept, to)
    held = None if to == "npz" else _write_held_joints(out, plans)
    invalid = tuple(index for index in kept if plans.status[index] == PlanStatus.INVALID)
    return Exported(files, len(kept), refused, invalid, held)


def _chosen(plans: Plans | JoinedPlans, only: Sequence[int] | None) -> list[int]:
    """Return the indices of the requested plans, ascending."""
    chosen = sorted(set(range(len(plans)) if only is None else only))
    for index in chosen:
        if not 0 <= index < len(plans):
            raise UsageError(f"there is no plan {index}: {len(plans)} plans are numbered from 0")
    return chosen


def _refused(plans: Plans | JoinedPlans, rate: float, chosen: list[int]) -> dict[int, str]:
    """Return the plans that cannot be sampled: index -> message."""
    unknown = np.full(len(plans), PlanStatus.UNKNOWN, np.uint8)  # joined plans have only plans that can be evaluated
    statuses, found = unknown if isinstance(plans, JoinedPlans) else screen(plans), {}
    for index in chosen:
        why = _why_not(plans, index, PlanStatus(statuses[index]), rate)
        if why:
            found[index] = f"plan {index} (sample {plans.sample_id[index]}): {why}"
    return found


def _why_not(plans: Plans | JoinedPlans, index: int, status: PlanStatus, rate: float) -> str:
    duration = plans.duration[index]
    if status != PlanStatus.UNKNOWN:
        return status.text
    if duration < 1e-9:
        return f"it lasts {duration:.3g} s, less than a nanosecond"
    if duration * rate > MAX_SAMPLES:
        return f"it lasts {duration:.3g} s: more than {MAX_SAMPLES} samples at {rate:g} Hz"
    if not np.isfinite(plans.motion[[index]].at_times(np.linspace(0, duration, 101)[None]).jerk).all():
        return "its derivatives are too large to compute with"
    return ""


def _sampled(plans: Plans | JoinedPlans, rate: float, kept: list[int]) -> Iterator[tuple[int, Sampled]]:
    motion = plans.motion
    for index in kept:
        yield index, sample_plan(motion[[index]], rate)


def _write_npz(out: Path, plans: Plans | JoinedPlans, rate: float, kept: list[int]) -> tuple[Path, ...]:
    path = out / "plans.npz" if out.is_dir() else out
    held = plans.problem.held_joints
    about = {
        "plan": np.array(kept),
        "sample_id": plans.sample_id[kept],
        "joint_names": np.array(plans.problem.joint_names),
        "held_joint_names": np.array([*held], np.str_),
        "held_joint_positions": np.array([*held.values()], np.float64),
    }
    write_npz(path, about, _sampled(plans, rate, kept))
    return (path,)


def _write_each(out: Path, plans: Plans | JoinedPlans, rate: float, kept: list[int], to: Form) -> tuple[Path, ...]:
    """Write one file per plan."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file, but {to!r} makes one file per plan: give a folder")
    joints, files = plans.problem.joint_names, []
    for index, sampled in _sampled(plans, rate, kept):
        table = to == "csv"
        files.append(out / f"plan_{index:05d}.{'csv' if table else 'json'}")
        text = csv_table(sampled, joints, plans.problem.sliding_joints) if table else joint_trajectory(sampled, joints)
        write_file(files[-1], text)
    return tuple(files)


def _write_held_joints(folder: Path, plans: Plans | JoinedPlans) -> Path | None:
    """Write the positions of unplanned movable joints."""
    held = plans.problem.held_joints
    if not held:
        return None
    path = folder / "held_joints.yaml"
    write_file(path, "".join(f"{json.dumps(name)}: {position}\n" for name, position in held.items()))
    return path
