"""Units of columns that do not state one: one reading of all columns together, or an error.

Times in milliseconds make a motion a thousand times slower, which any limit accepts. A
reading of the times is possible if the samples are not closer than
``MIN_SAMPLING_PERIOD_S`` and the joints not much faster than their limits. Velocities
decide: they are the differences of the positions in one of the units only.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.errors import either
from cnpgen.robots.plausible_values import UnitError
from cnpgen.schema.units import UNITS

UNIT = re.compile(r"\s*\[(?!\d+\])([^\]]*)\]\s*$")  # "position[0]" has no unit
DEGREE = float(np.pi / 180)
MIN_SAMPLING_PERIOD_S = 5e-4
MAX_SPEED_RATIO = 5.0  # to the velocity limits, of most spans of an invalid motion
SPEED_QUANTILE = 0.9  # of the moving spans: a glitch or a jump of 2 pi is no speed
TIME_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
SAME_READING = 0.1  # difference of logarithms below which a ratio is that of a unit
MIN_MOTION = 1e-3  # rad or m; smaller motions do not show a unit
MIN_VELOCITY_SAMPLES = 8  # differences of fewer positions are no velocities


def plain(name: str) -> str:
    """Return the name of a column without its unit."""
    return UNIT.sub("", name).strip()


def stated_factor(name: str) -> tuple[str, float] | None:
    """Return the SI unit and the factor of the unit in a column's name, such as ``[deg/s]``.

    None without a unit; an unknown unit has the SI unit "".
    """
    match = UNIT.search(name)
    if not match:
        return None
    si, factor = UNITS.get(match[1].strip(), ("", 1))
    return si, float(factor)


@dataclass(frozen=True)
class Readings:
    """Names of the columns of a trajectory without units, for messages: times, and whether positions and velocities."""

    place: str
    time: str | None  # None if the unit of the times is known
    joints: bool
    velocities: bool


def check_units(
    readings: Readings, trajectory: Trajectory, velocity_limit: Array
) -> None:
    """Raise UnitError if columns contradict each other in SI units, or if the times have two possible units."""
    ratio = _ratio_of_velocities(trajectory)
    if ratio is not None:
        _check_ratio(readings, ratio)
        if _is(ratio, 1.0):
            # The velocities show that all are in SI units.
            return
    if readings.time is None:
        return
    step = float(np.median(np.diff(trajectory.t)))
    speed = _speed_ratio(trajectory, velocity_limit)
    possible = [
        unit
        for unit, factor in TIME_UNITS.items()
        if step * factor >= MIN_SAMPLING_PERIOD_S
        # Shorter times make the joints faster than they seem in seconds, by the same
        # factor.
        and 0 < speed / factor <= MAX_SPEED_RATIO
    ]
    if possible:
        name = plain(readings.time)
        named = either([f"'{name} [{unit}]'" for unit in ("s", *possible)])
        text = f"{readings.place}: {name} has steps of {step:.3g} and no unit, and may be in {either(['s', *possible])}"
        raise UnitError(
            f"{text}: all joints are slower than {speed:.2g} of their velocity limits if it is in s;"
            f" name the column {named}, or pass this name to {{time}}",
            concerns="path",
            remedies={"time": None},
        )


def _speed_ratio(trajectory: Trajectory, velocity_limit: Array) -> float:
    """Return the speed of most moving spans, relative to the velocity limits of the joints."""
    # Times in the stated numbers; other units scale all speeds alike.
    speeds = np.abs(np.diff(trajectory.q, axis=0)) / np.diff(trajectory.t)[:, None]
    ratios = (speeds / velocity_limit).max(axis=1)
    moving = ratios[ratios > 0]
    return float(np.quantile(moving, SPEED_QUANTILE)) if len(moving) else 0.0


def _ratio_of_velocities(trajectory: Trajectory) -> float | None:
    """Return the way of the positions over that of the velocities; 1 in SI units, None if it cannot be computed."""
    if trajectory.dq is None or len(trajectory.t) < MIN_VELOCITY_SAMPLES:
        return None
    # Ways are sums over joints and spans, so noise of a single difference matters
    # little.
    way = np.abs(np.diff(trajectory.q, axis=0)).sum()
    mean = np.abs(trajectory.dq[1:] + trajectory.dq[:-1]) / 2
    integral = (mean * np.diff(trajectory.t)[:, None]).sum()
    return float(way / integral) if way > MIN_MOTION and integral > 0 else None


def _is(ratio: float, factor: float) -> bool:
    return ratio > 0 and abs(math.log(ratio / factor)) < SAME_READING


def _check_ratio(readings: Readings, ratio: float) -> None:
    """Raise UnitError if the ratio of positions and velocities is that of another unit."""
    text = f"{readings.place}: the velocities are {1 / ratio:.4g} times the differences of the positions"
    unit = next((u for u, factor in TIME_UNITS.items() if _is(ratio, factor)), None)
    if unit is not None and readings.time is not None:
        name = plain(readings.time)
        raise UnitError(
            f"{text}, as with times in {unit}: name the column '{name} [{unit}]', or pass this name to {{time}}",
            concerns="path",
            remedies={"time": None},
        )
    if readings.velocities and _is(ratio, DEGREE):
        raise UnitError(
            f"{text}, as with velocities in deg/s: state the unit in the names of their columns",
            concerns="path",
        )
    if readings.joints and _is(ratio, 1 / DEGREE):
        raise UnitError(
            f"{text}, as with positions in deg: state the unit in the names of their columns",
            concerns="path",
        )
