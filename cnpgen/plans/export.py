"""Export of plans: selection, sampling in time, and writing in a registered format."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import DatasetError, MachineError, RecipeError, UsageError, counted
from cnpgen.plans.exporter import ExportedSet, Exporter, SampledPlan, sample_plan
from cnpgen.plans.format import PlanStatus
from cnpgen.plans.join import JoinedPlans
from cnpgen.plans.plans import Plans, screen
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.drive import Drive
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.store.files.atomic import machine_errors, write_file
from cnpgen.store.files.written_files import claim_files, record_files
from cnpgen.world.path import PathWorld

MAX_SAMPLES = 1_000_000  # per plan
PLAN_FILES = "plan_[0-9]*"  # files of a folder that belong to one export
HELD_JOINTS = "held_joints.yaml"
MAX_RATE_HZ = 1e6  # steps of 1 us; ROS stamps resolve 1 ns


@dataclass(frozen=True)
class Exported:
    """Result of ``export_plans``.

    Attributes:
        files: Written files, in the order of the plans.
        count: Number of exported plans.
        refused: Index of each plan that could not be exported -> message.
        invalid: Indices of exported plans with a status other than valid or unknown.
        held_joints: File with the positions of unplanned movable joints, for formats
            with one file per plan, if the robot has such joints.
    """

    files: tuple[Path, ...]
    count: int
    refused: dict[int, str]
    invalid: tuple[int, ...] = ()
    held_joints: Path | None = None


def load_exporter(name: str) -> Exporter:
    """Load an export format by its registered name.

    Raise UsageError for an unknown or invalid one.
    """
    try:
        kind: type[Exporter] = registry.load(registry.EXPORTERS, name)
    except RecipeError as error:
        raise UsageError(f"{error}", concerns="to") from error
    # Names of formats have no arguments on the command line.
    if fields(kind) or not getattr(kind, "suffix", ""):
        raise UsageError(
            f"exporter {name!r}: {kind.__name__} must have a suffix and no fields",
            concerns="to",
        )
    return kind()


@checked_arguments
def export_plans(
    plans: Plans | JoinedPlans,
    out: str | Path,
    *,
    to: str,
    rate: float = 1000.0,
    only: Sequence[int] | None = None,
    force: bool = False,
) -> Exported:
    """Sample plans in time and write them.

    An existing file is replaced. In a folder, the files of an earlier export are
    replaced or removed; files of plans that were not exported by cnpgen are refused.

    Formats are "npz", "parquet" and "mpd" (one file), "csv", "joint-trajectory" and
    "ros2-control" (a folder with one file per plan, ``plan_00000.csv``), "lerobot" (a
    dataset in a folder), and those of installed packages; 'cnpgen docs plan-format' has
    their content. Folders do not contain unplanned joints. If the robot has movable
    ones, ``held_joints.yaml`` contains their positions. Plans that cannot be sampled
    are omitted and reported.

    Args:
        plans: Plans, or joined plans of ``join_plans``.
        out: File for formats with a single file (in an existing folder: ``plans.npz``),
            otherwise a folder, which is created.
        to: Name of the format.
        rate: Samples per second [Hz]; the last instant of a plan is always one of its
            samples.
        only: Indices of the plans to export; all by default.
        force: Whether plans of other origin in a folder are kept, and replaced if they
            have the same name.

    Raises:
        UsageError: An argument is invalid, or the folder has plans of other origin.
        DatasetError: No plan can be exported.
        MachineError: The disk is full or read-only, or a file operation failed.
    """
    exporter = load_exporter(to)
    if not 0 < rate <= MAX_RATE_HZ:
        text = f"the rate must be above 0 and at most {MAX_RATE_HZ:g} Hz, got {rate}"
        raise UsageError(text, concerns="rate")
    chosen = _chosen(plans, only)
    out = Path(out)
    refused = _refused(plans, rate, chosen)
    kept = [index for index in chosen if index not in refused]
    if not kept:
        reasons = "; ".join(list(refused.values())[:3])
        raise DatasetError(
            f"none of the {len(chosen)} plans can be exported{': ' if reasons else ''}{reasons}"
        )
    if not exporter.single_file and out.exists() and not out.is_dir():
        text = f"{out} is a file, but {to!r} makes one file per plan: give a folder"
        raise UsageError(text, concerns="out")
    sampled = _sampled(plans, rate, kept, exporter.ticks_per_s)
    has_drives = "drive" in plans.problem.content
    drive = open_problem(plans.problem)[1].drive if has_drives else None
    if drive is not None:
        sampled = _with_torques(sampled, plans, drive)
    exported = replace(
        _exported_set(plans, kept, exporter), rate=rate, has_drives=drive is not None
    )
    files, held = _write(exporter, out, sampled, exported, force=force)
    _check_written(files, exporter, to)
    invalid = tuple(
        index for index in kept if plans.status[index] == PlanStatus.INVALID
    )
    return Exported(tuple(files), len(kept), refused, invalid, held)


def _check_written(files: Sequence[Path], exporter: Exporter, to: str) -> None:
    if missing := [file for file in files if not file.exists()]:
        package = registry.package_of(registry.EXPORTERS, type(exporter))
        raise MachineError(
            f"the exporter {to!r} of the package {package!r} has not written {missing[0]}"
        )


def _exported_set(
    plans: Plans | JoinedPlans, kept: list[int], exporter: Exporter
) -> ExportedSet:
    problem = plans.problem
    return ExportedSet(
        np.array(kept),
        plans.sample_id[kept],
        problem.joint_names,
        problem.prismatic_joints,
        problem.held_joints,
        problem=problem.name,
        environment=_environment(plans, kept) if exporter.uses_environment else {},
        motion=plans.motion[kept] if isinstance(plans, Plans) else None,
        parameters=problem.parameters.names,
    )


def _write(
    exporter: Exporter,
    out: Path,
    sampled: Iterator[SampledPlan],
    exported: ExportedSet,
    *,
    force: bool,
) -> tuple[list[Path], Path | None]:
    """Write one file, or one per plan to a folder; return them, and the file of held joints, if any."""
    folder = out.parent if exporter.single_file else out
    with machine_errors("write", folder):
        folder.mkdir(parents=True, exist_ok=True)
    if not exporter.single_file:
        numbers = exported.index.tolist()
        files = [out / f"plan_{index:05d}{exporter.suffix}" for index in numbers]
        return files, _write_each(exporter, files, sampled, exported, force=force)
    is_folder = out.is_dir() and not exporter.is_folder
    file = out / f"plans{exporter.suffix}" if is_folder else out
    exporter.write(file, sampled, exported)
    return [file], None


def _write_each(
    exporter: Exporter,
    files: list[Path],
    sampled: Iterator[SampledPlan],
    exported: ExportedSet,
    *,
    force: bool,
) -> Path | None:
    """Write one file per plan to a folder, and return the file of held joints, if any."""
    out = files[0].parent
    names = [path.name for path in files]
    names += [HELD_JOINTS] if exported.held_joints else []
    # Claimed before the first is written, recorded after the last: files of an
    # interrupted export are then not taken for those of the user.
    claim_files(out, names, pattern=PLAN_FILES, force=force)
    for path, plan in zip(files, sampled, strict=True):
        exporter.write(path, [plan], exported)
    held = _write_held_joints(out, exported.held_joints)
    record_files(out, names)
    return held


def _environment(plans: Plans | JoinedPlans, kept: list[int]) -> dict[str, Array]:
    """Return goals, columns of the tasks and scenes of chosen plans, shape (N, w) each; of the last if joined."""
    last = _last(plans)
    columns = {
        "goal_q": last.boundary.goal_q,
        "goal_dq": last.boundary.goal_dq,
        **last.columns,
    }
    if last.boundary.parameters is not None:
        # Parameters of the problem are columns of their own names.
        columns |= zip(
            plans.problem.parameters.names, last.boundary.parameters.T, strict=True
        )
    scene = last.scene.poses
    if scene.shape[1]:
        columns["scene"] = scene
    numbers = {
        name: np.asarray(values, np.float64)
        for name, values in columns.items()
        # Tables of an environment hold numbers only.
        if values.dtype.kind in "fiu"
    }
    return {
        name: values[kept].reshape(len(kept), -1) for name, values in numbers.items()
    }


def _chosen(plans: Plans | JoinedPlans, only: Sequence[int] | None) -> list[int]:
    """Return the indices of the requested plans, ascending."""
    chosen = sorted(
        set(
            range(len(plans))
            if only is None
            else (integer("only", index) for index in only)
        )
    )
    for index in chosen:
        if not 0 <= index < len(plans):
            raise UsageError(
                f"there is no plan {index}: {counted(len(plans), 'plan')}, numbered from 0",
                concerns="only",
            )
    return chosen


def _refused(
    plans: Plans | JoinedPlans, rate: float, chosen: list[int]
) -> dict[int, str]:
    """Return the plans that cannot be sampled: index -> message."""
    # Joined plans have only plans that can be evaluated.
    unknown = np.full(len(plans), PlanStatus.UNKNOWN, np.uint8)
    statuses = unknown if isinstance(plans, JoinedPlans) else screen(plans)
    reasons = {
        index: _why_not(plans, index, PlanStatus(statuses[index]), rate)
        for index in chosen
    }
    return {
        index: f"plan {index} (sample {plans.sample_id[index]}): {why}"
        for index, why in reasons.items()
        if why
    }


def _why_not(
    plans: Plans | JoinedPlans, index: int, status: PlanStatus, rate: float
) -> str:
    duration = plans.duration[index]
    if status != PlanStatus.UNKNOWN:
        return status.text
    # Stamps of 1 ns could not order two samples.
    if duration < 1e-9:
        return f"it lasts {duration:.3g} s, less than a nanosecond"
    if duration * rate > MAX_SAMPLES:
        return (
            f"it lasts {duration:.3g} s: more than {MAX_SAMPLES} samples at {rate:g} Hz"
        )
    if not np.isfinite(
        plans.motion[[index]].at_times(np.linspace(0, duration, 101)[None]).jerk
    ).all():
        return "its derivatives are too large to compute with"
    return ""


def _sampled(
    plans: Plans | JoinedPlans, rate: float, kept: list[int], ticks_per_s: int | None
) -> Iterator[SampledPlan]:
    motion = plans.motion
    parameters = _last(plans).boundary.parameters
    for index in kept:
        values = () if parameters is None else tuple(parameters[index].tolist())
        # One plan at a time: samples of all plans may not fit into memory.
        yield sample_plan(motion[[index]], rate, index, values, ticks_per_s)


def _with_torques(
    sampled: Iterator[SampledPlan], plans: Plans | JoinedPlans, drive: Drive
) -> Iterator[SampledPlan]:
    """Yield the plans of a robot with drives with the torques at its joints and motors, by the exact law of friction."""
    problem, robot = open_problem(plans.problem)
    world = PathWorld(robot, problem.obstacle, problem.object_size)
    for plan in sampled:
        poses = _last(plans).scene.poses[plan.index]
        world.set_path(plan.q.T, plan.dq.T, plan.ddq.T, poses)
        # c sign(dq), 0 at rest: the verdict allows for any friction there, an exported
        # table needs one value.
        friction = drive.coulomb[:, None] * np.sign(world.dq)
        motor = np.asarray(world.linear_torque + friction).T
        yield replace(plan, joint_torque=np.array(world.torque.T), motor_torque=motor)


def _last(plans: Plans | JoinedPlans) -> Plans:
    """Return the plans themselves, or the last ones of joined plans, which have the same problem."""
    return plans if isinstance(plans, Plans) else plans.parts[-1]


def _write_held_joints(folder: Path, held: dict[str, float]) -> Path | None:
    """Write the positions of unplanned movable joints."""
    if not held:
        return None
    path = folder / HELD_JOINTS
    write_file(
        path,
        "".join(f"{json.dumps(name)}: {position}\n" for name, position in held.items()),
    )
    return path
