"""Result of the execution of a plan."""

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Executed:
    """Result of the execution of one plan; inapplicable values are None or nan.

    Attributes:
        finished: Whether the tip was within 1 cm of the goal when the plan ended.
        touched_early: Whether the mallet touched the puck with more than 3 cm of the path left.
        hit: Whether the mallet touched the puck.
        scored: Whether the puck went into the opponent's goal.
        collided: Whether object or links penetrated an obstacle by more than 1 mm outside legal contact.
        hit_time: Time of the first contact of mallet and puck [s].
        puck_speed: Speed of the puck after the contact [m/s].
        z_error: Integral of |z - height of the table| over the executed plan [m s].
        vertical_error: Integral of |roll| + |pitch| of the tip frame over the motion [rad s].
        tracking_error: Integral of the sum over joints of |q - q planned| over the motion [rad s].
        torque_use: Maximum torque as a fraction of the rated torque; 1 is a saturated motor.
        failure: Reason why nothing was executed, or empty.
    """

    finished: bool = False
    touched_early: bool | None = None
    hit: bool | None = None
    scored: bool | None = None
    collided: bool | None = None
    hit_time: float = math.nan
    puck_speed: float = math.nan
    z_error: float = math.nan
    vertical_error: float = math.nan
    tracking_error: float = math.nan
    torque_use: float = math.nan
    failure: str = ""

    @property
    def success(self) -> bool:
        """Whether the task succeeded: scored without early contact, or goal reached without collision."""
        if self.failure:
            return False
        if self.scored is not None:
            return self.scored and not self.touched_early
        return self.finished and not self.collided

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON in the units of the paper's tables, without inapplicable values."""
        values = {
            **{name: getattr(self, name) for name in ("finished", "touched_early", "hit", "scored", "collided")},
            "success": self.success,
            "hit_time_s": self.hit_time,
            "puck_speed_m_s": self.puck_speed,
            "z_error_mm_s": 1e3 * self.z_error,
            "vertical_error_rad_s": self.vertical_error,
            "tracking_error_rad_s": self.tracking_error,
            "torque_use": self.torque_use,
            "failure": self.failure or None,
        }
        return {name: value for name, value in values.items() if value is not None and not _is_nan(value)}


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)
