"""Ranges of plausible values: numbers far outside of them are probably in another unit, such as degrees."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError
from cnpgen.robots.robot import Robot
from cnpgen.schema.units import suggested_unit
from cnpgen.store.joint_units import unit_of

MAX_RANGE_RATIO = 2.0  # distance from the center of a joint's range, in half ranges
# Of velocities, accelerations and positions of the tip; deg/s is 57 times rad/s, mm
# 1,000 times m.
MAX_LIMIT_RATIO = 10.0
MAX_ANGLE_RAD = 2 * np.pi  # of directions


class UnitError(UsageError):
    """A value that is so far outside of its range that it is probably in another unit."""


@dataclass(frozen=True)
class ImplausibleValue:
    """The first value of an array outside of its plausible range, which has the unit in which the value is read."""

    row: int
    column: int
    value: float
    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        text = f"must be from {self.low:.3g} to {self.high:.3g} {self.unit}, got {self.value:.6g} {self.unit}"
        return text + suggested_unit(self.value, self.unit)


def find_implausible_value(
    robot: Robot, name: str, values: AnyArray, unit: str
) -> ImplausibleValue | None:
    """Find the first value outside of the plausible range of its quantity; nan and infinite values are ignored.

    The name is that of the column, such as "start_q" or "hit_angle", its values have
    shape (N, width), and the unit is that of ``Field.unit``.
    """
    low, high = (
        np.broadcast_to(bound, values.shape[1:])
        for bound in _plausible_range(robot, name, unit)
    )
    outside = np.isfinite(values) & ((values < low) | (values > high))
    if not outside.any():
        return None
    row, column = np.argwhere(outside)[0].tolist()
    bounds = float(low[column]), float(high[column])
    return ImplausibleValue(
        row, column, float(values[row, column]), *bounds, unit_of(unit, column)
    )


def check_plausible(
    robot: Robot,
    columns: Mapping[str, AnyArray],
    units: Mapping[str, str],
    *,
    noun: str,
) -> None:
    """Raise an error for the first value of columns, shape (N, width), that is probably in another unit than theirs.

    The noun of a row is "task" or "plan".
    """
    for name, values in columns.items():
        wrong = find_implausible_value(robot, name, values, units[name])
        if wrong is not None:
            joint = (
                f" of {robot.joint_names[wrong.column]}" if name.endswith("q") else ""
            )
            # The place of the value goes before the hint at a unit, which follows a
            # semicolon.
            text, mark, hint = str(wrong).partition(";")
            raise UnitError(
                f"{text} in {noun} {wrong.row}{joint}{mark}{hint}", argument=name
            )


def _plausible_range(robot: Robot, name: str, unit: str) -> tuple[Any, Any]:
    """Return the ends of the plausible range of a quantity, scalars or one per joint."""
    # The quantity is the last part of a name: "start_q" -> "q".
    quantity = name.rpartition("_")[2]
    if quantity == "q":
        low = robot.position_lower
        high = robot.position_upper
        # A joint without limits has the center nan and an infinite half range.
        with np.errstate(invalid="ignore"):
            center = (low + high) / 2
            half = MAX_RANGE_RATIO * (high - low) / 2
        bounded = np.isfinite(half)
        return np.where(bounded, center - half, -np.inf), np.where(
            bounded, center + half, np.inf
        )
    limits = {"dq": robot.velocity_limit, "ddq": robot.acceleration_limit}
    if quantity in limits:
        return -MAX_LIMIT_RATIO * limits[quantity], MAX_LIMIT_RATIO * limits[quantity]
    # Velocities of the tip are bounded by the reach times the norm of joint velocities.
    speed = float(np.linalg.norm(robot.velocity_limit)) if unit == "m/s" else 1.0
    lengths = MAX_LIMIT_RATIO * robot.reach * speed
    bound = {"rad": MAX_ANGLE_RAD, "m": lengths, "m/s": lengths}.get(unit, np.inf)
    return -bound, bound
