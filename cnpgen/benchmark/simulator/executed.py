"""What came of executing a plan."""

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Executed:
    """What a simulated robot did with one plan; what does not apply is None or nan.

    Attributes:
        finished: Whether the tip was within 1 cm of the goal when the plan ended.
        touched_early: Whether the mallet met the puck with more than 3 cm of the plan's way still to go.
        hit: Whether the mallet met the puck at all.
        scored: Whether the puck went into the opponent's goal.
        collided: Whether the object or a link entered an obstacle by more than 1 mm, outside what is legal.
        hit_time: When mallet and puck met first [s].
        puck_speed: The puck's speed after that [m/s].
        z_error: Integral of |z - height of the table| over the plan's time, as executed [m s].
        vertical_error: Integral of |roll| + |pitch| of the tip frame, likewise [rad s].
        tracking_error: Integral of the sum over joints of |q - q planned|, likewise [rad s].
        torque_use: Largest torque as a share of the rated one; 1 is a motor that saturated.
        failure: Why nothing was executed, or empty.
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
        """Whether the task was done: a goal without touching the puck early, or the goal reached without collision."""
        if self.failure:
            return False
        if self.scored is not None:
            return self.scored and not self.touched_early
        return self.finished and not self.collided

    def to_dict(self) -> dict[str, Any]:
        """Return it for JSON in the units of the paper's tables, without what does not apply."""
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
