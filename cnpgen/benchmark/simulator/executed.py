"""Result of the execution of a plan."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

PLANE_TOLERANCE_M = 0.02  # of the mallet's height, as in the Air Hockey Challenge (2023)


@dataclass(frozen=True)
class Executed:
    """Result of the execution of one plan; inapplicable values are None or nan.

    Attributes:
        finished: Whether the tip was within 1 cm of the goal when the plan ended.
        touched_early: Whether the mallet touched the puck more than 10 mm of its planned path before both were to meet.
        hit: Whether the mallet touched the puck.
        scored: Whether the puck went into the opponent's goal.
        collided: Whether object or links penetrated an obstacle by more than 1 mm outside legal contact.
        hit_time: Time of the first contact of mallet and puck [s].
        puck_speed: Speed of the puck after the contact [m/s].
        z_error: Integral of |z - height of the table| over the executed plan [m s].
        vertical_error: Integral of |roll| + |pitch| of the tip frame over the motion [rad s].
        tracking_error: Integral of the sum over joints of |q - q planned| over the motion [rad s].
        torque_use: Maximum torque as a fraction of the rated torque; 1 is a saturated motor.
        goal_distance: Distance of the tip from the goal when the plan ended [m].
        contact_distance: Length of the mallet's planned path that was left at the first contact with the puck [m].
        plane_error: Maximum |z - height of the table| of the executed plan [m].
        commanded_plane_error: The same of the commanded positions, which may be below a table that supports the mallet.
        table_force: Maximum normal force between mallet and table until the puck's result is final [N].
        table_friction: Maximum friction force between them [N].
        table_contact_time: Time for which they touched [s].
        violated_steps: Constraint of the environment -> number of its steps that violate it; None without such.
        penalty: Penalty points of the environment's rules, without those of computation times.
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
    goal_distance: float = math.nan
    contact_distance: float = math.nan
    plane_error: float = math.nan
    commanded_plane_error: float = math.nan
    table_force: float = math.nan
    table_friction: float = math.nan
    table_contact_time: float = math.nan
    violated_steps: Mapping[str, int] | None = None
    penalty: float = math.nan
    failure: str = ""

    @property
    def success(self) -> bool:
        """Whether the task succeeded with the default tolerance; see ``succeeded``."""
        return succeeded(self._values())

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON in the units of the paper's tables, without inapplicable values."""
        return {**self._values(), "success": self.success}

    def _values(self) -> dict[str, Any]:
        values = {
            **{name: getattr(self, name) for name in ("finished", "touched_early", "hit", "scored", "collided")},
            "hit_time_s": self.hit_time,
            "puck_speed_m_s": self.puck_speed,
            "z_error_mm_s": 1e3 * self.z_error,
            "vertical_error_rad_s": self.vertical_error,
            "tracking_error_rad_s": self.tracking_error,
            "torque_use": self.torque_use,
            "goal_distance_mm": 1e3 * self.goal_distance,
            "contact_distance_mm": 1e3 * self.contact_distance,
            "plane_error_mm": 1e3 * self.plane_error,
            "commanded_plane_error_mm": 1e3 * self.commanded_plane_error,
            "table_force_n": self.table_force,
            "table_friction_n": self.table_friction,
            "table_contact_s": self.table_contact_time,
            **{f"{name}_steps": count for name, count in (self.violated_steps or {}).items()},
            "penalty_points": self.penalty,
            "failure": self.failure or None,
        }
        known = ((name, value) for name, value in values.items() if value is not None)
        return {name: value for name, value in known if not (isinstance(value, float) and math.isnan(value))}


def succeeded(executed: Mapping[str, Any], plane_tolerance: float = PLANE_TOLERANCE_M) -> bool:
    """Return whether an execution succeeded, from the result of ``Executed.to_dict``.

    A hit succeeds if it scores without early contact, and the mallet stays near the plane of the table throughout the
    plan, within a tolerance [m]. The limit holds for the commanded height, too, because the table supports a mallet
    that is commanded below it. A motion without a puck succeeds if it reaches its goal without collision.
    """
    if "failure" in executed:
        return False
    if "scored" not in executed:
        return bool(executed["finished"]) and not executed.get("collided")
    errors = [executed.get(name, math.inf) for name in ("plane_error_mm", "commanded_plane_error_mm")]
    return bool(executed["scored"]) and not executed.get("touched_early") and max(errors) <= 1e3 * plane_tolerance
