"""Contract of export formats: plans sampled in time, written to files."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.plans.format import UNITS
from cnpgen.robots.parameter_ranges import PARAMETER_UNITS
from cnpgen.trajectory.joined import JoinedMotion
from cnpgen.trajectory.spline_motion import Motion

TORQUE_COLUMNS = "joint_torque", "motor_torque"
# Minimum length of the last step in steps; a shorter one is merged with the step
# before.
MIN_LAST_STEP_FRACTION = 0.01


@dataclass(frozen=True)
class SampledPlan:
    """Plan sampled at K times.

    Attributes:
        index: Index of the plan in its set.
        t: Times [s], shape (K,), strictly increasing from 0 to the duration.
        q: Joint positions [rad], shape (K, n).
        dq: Joint velocities [rad/s], shape (K, n).
        ddq: Joint accelerations [rad/s^2], shape (K, n).
        jerk: Joint jerks [rad/s^3], shape (K, n).
        parameters: Values of the problem's parameters in SI units.
        phase: Phases at the samples, shape (K,); None for joined plans.
        joint_torque: Torques at the joints [N m], shape (K, n), of robots with drives.
        motor_torque: Torques at their motors, seen at the joints, with all friction.
    """

    index: int
    t: Array
    q: Array
    dq: Array
    ddq: Array
    jerk: Array
    parameters: tuple[float, ...] = ()
    phase: Array | None = None
    joint_torque: Array | None = None
    motor_torque: Array | None = None


@dataclass(frozen=True)
class ExportedSet:
    """Data of all N exported plans.

    Attributes:
        index: Index of each plan in its set, shape (N,).
        sample_id: Sample ID of each plan, shape (N,).
        joint_names: Names of the n planned joints.
        prismatic: Whether each planned joint is prismatic; its values are in m instead
            of rad.
        held_joints: Positions of the movable joints that are not planned: name -> rad
            or m.
        rate: Samples per second [Hz].
        problem: Name of the problem.
        environment: Goals, columns of the tasks and scenes: name -> values in SI units,
            shape (N, w); empty for formats that do not use them.
        motion: The N motions as splines; None for joined plans.
        parameters: Names of the problem's parameters.
        has_drives: Whether the plans have torques at joints and motors.
    """

    index: Integers
    sample_id: Integers
    joint_names: tuple[str, ...]
    prismatic: tuple[bool, ...]
    held_joints: dict[str, float]
    rate: float = 0.0
    problem: str = ""
    environment: Mapping[str, Array] = field(default_factory=dict)
    motion: Motion | None = None
    parameters: tuple[str, ...] = ()
    has_drives: bool = False

    @property
    def columns(self) -> dict[str, str]:
        """Names of the sampled values of joints, with the units of revolute ones."""
        torques = dict.fromkeys(TORQUE_COLUMNS, "N m") if self.has_drives else {}
        return UNITS | torques


@dataclass(frozen=True)
class Exporter(ABC):
    """Format of sampled trajectories; a frozen dataclass without fields.

    Packages register formats under the entry point ``cnpgen.exporters``; ``cnpgen
    export --to NAME`` then writes them.

    Attributes:
        suffix: Suffix of the files, with the dot.
        single_file: Whether one file has all plans; otherwise each plan has its own
            file, and ``held_joints.yaml`` beside the files has the positions of the
            joints that are not planned.
        is_folder: Whether the output with all plans is a folder.
        uses_environment: Whether the format has goals, columns of the tasks and scenes.
        samples: Whether the format has samples in time.
        ticks_per_s: Units of the format's times per second; None if they are floats.
            Plans are sampled at the times that the file states.
    """

    suffix: ClassVar[str]
    single_file: ClassVar[bool] = False
    is_folder: ClassVar[bool] = False
    uses_environment: ClassVar[bool] = False
    samples: ClassVar[bool] = True
    ticks_per_s: ClassVar[int | None] = None

    @abstractmethod
    def write(
        self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet
    ) -> None:
        """Write a file; an existing file is replaced, atomically.

        Args:
            path: Path of the file.
            plans: All plans for a single file, which are sampled one by one; otherwise
                one plan.
            exported: Data of all exported plans.

        Raises:
            MachineError: The disk is full or read-only, or a file operation failed.
        """


def sample_plan(
    motion: Motion | JoinedMotion,
    rate: float,
    index: int = 0,
    parameters: tuple[float, ...] = (),
    ticks_per_s: int | None = None,
) -> SampledPlan:
    """Sample one motion at ``rate`` [Hz], and at its last instant, or the last tick before it."""
    duration = float(motion.duration()[0])
    # Times k / rate for k < count, then the duration itself.
    count = max(math.ceil(duration * rate - MIN_LAST_STEP_FRACTION), 1)
    t = np.append(np.arange(count) / rate, duration)
    if ticks_per_s is not None:
        # Times are rounded to ticks; the last must not exceed the duration, where the
        # motion ends.
        ticks = np.minimum(np.rint(t * ticks_per_s), np.floor(duration * ticks_per_s))
        t = ticks / ticks_per_s
    states = motion.at_times(t[None])
    phase = motion.phase_at(t[None])[0] if isinstance(motion, Motion) else None
    values = states.q[0], states.dq[0], states.ddq[0], states.jerk[0]
    return SampledPlan(index, t, *values, parameters=parameters, phase=phase)


def parameter_columns(names: Iterable[str]) -> list[str]:
    """Return names of parameters with their units, such as ``"payload_mass [kg]"``."""
    units = {name: PARAMETER_UNITS[name] for name in names}
    return [name if unit == "1" else f"{name} [{unit}]" for name, unit in units.items()]
