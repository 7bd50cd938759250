"""Result of the execution of a plan, computed from the record of every tick."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cnpgen.addons.benchmark.simulator import hockey
from cnpgen.addons.benchmark.simulator.reference import TICK_S, Reference
from cnpgen.addons.benchmark.simulator.simulator_scene import SimulatorScene
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.arrays import Array, Mask
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.judges.plans.metrics import tilt

# Of the mallet's height, as in the Air Hockey Challenge (2023).

PLANE_TOLERANCE_M = 0.02
MAX_GOAL_DISTANCE_M = 0.01  # of a finished motion, as in the paper
# A contact with more of the planned path left is early.
EARLY_CONTACT_M = hockey.PATH_LEFT_AT_CONTACT_M + 0.01
MIN_PUCK_SPEED_M_S = 0.02  # a slower puck counts as stopped
MAX_LEGAL_PENETRATION_M = 1e-3
MAX_PUCK_TIME_S = 4.0  # until the puck arrives


@dataclass(frozen=True)
class Executed:
    """Result of the execution of one plan; inapplicable values are None or nan.

    Attributes:
        finished: Whether the tip was within 1 cm of the goal when the plan ended.
        touched_early: Whether the mallet touched the puck more than 10 mm of its
            planned path before both were to meet.
        hit: Whether the mallet touched the puck.
        scored: Whether the puck went into the opponent's goal.
        collided: Whether object or links penetrated an obstacle by more than 1 mm
            outside legal contact.
        hit_time: Time of the first contact of mallet and puck [s].
        puck_speed: Speed of the puck after the contact [m/s].
        z_error: Integral of |z - height of the table| over the executed plan [m s].
        vertical_error: Integral of |roll| + |pitch| of the tip frame over the motion
            [rad s].
        tracking_error: Integral of the sum over joints of |q - q planned| over the
            motion [rad s].
        torque_use: Maximum torque as a fraction of the rated torque; 1 is a saturated
            motor.
        goal_distance: Distance of the tip from the goal when the plan ended [m].
        contact_distance: Length of the mallet's planned path that was left at the first
            contact with the puck [m].
        plane_error: Maximum |z - height of the table| of the executed plan [m].
        commanded_plane_error: The same of the commanded positions, which may be below a
            table that supports the mallet.
        table_force: Maximum normal force between mallet and table until the puck's
            result is final [N].
        table_friction: Maximum friction force between them [N].
        table_contact_time: Time for which they touched [s].
        violated_steps: Constraint of the environment -> number of its steps that
            violate it; None without such.
        penalty: Penalty points of the environment's rules, without those of computation
            times.
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

    def to_dict(self) -> JsonObject:
        """Return the result for JSON in the units of the paper's tables, without inapplicable values."""
        return {**self._values(), "success": self.success}

    def _values(self) -> JsonObject:
        values = {
            **{
                name: getattr(self, name)
                for name in ("finished", "touched_early", "hit", "scored", "collided")
            },
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
            **{
                f"{name}_steps": count
                for name, count in (self.violated_steps or {}).items()
            },
            "penalty_points": self.penalty,
            "failure": self.failure or None,
        }
        known = ((name, value) for name, value in values.items() if value is not None)
        return {
            name: value
            for name, value in known
            if not (isinstance(value, float) and math.isnan(value))
        }


def succeeded(
    executed: JsonMapping, plane_tolerance: float = PLANE_TOLERANCE_M
) -> bool:
    """Return whether an execution succeeded, from the result of ``Executed.to_dict``.

    A hit succeeds if it scores without early contact, and the mallet stays near the
    plane of the table throughout the plan, within a tolerance [m]. The limit holds for
    the commanded height, too, because the table supports a mallet that is commanded
    below it. A motion without a puck succeeds if it reaches its goal without collision.
    """
    if "failure" in executed:
        return False
    if "scored" not in executed:
        return bool(executed["finished"]) and not executed.get("collided")
    errors = [
        executed.get(name, math.inf)
        for name in ("plane_error_mm", "commanded_plane_error_mm")
    ]
    return (
        bool(executed["scored"])
        and not executed.get("touched_early")
        and max(errors) <= 1e3 * plane_tolerance
    )


@dataclass(frozen=True)
class TickRecord:
    """Record of K ticks.

    Joint positions, their reference [rad] and torques as fractions of the rated ones
    have shape (K, n). The tip [m] has shape (K, 3), its rotation (K, 3, 3). The puck
    over the table [m] and its velocity [m/s] have shape (K, 2) and are nan without one;
    ``puck_contact`` is true while the mallet touches it, shape (K,). ``table_force``
    has the normal and the friction force of the mallet on the table [N], shape (K, 2),
    nan if not simulated. ``max_penetration`` is that of an obstacle [m]; see
    ``Executed`` for the others.
    """

    q: Array
    tip: Array
    rotation: Array
    reference: Array
    torque_use: Array
    puck: Array
    puck_velocity: Array
    puck_contact: Mask
    table_force: Array
    max_penetration: float = 0.0
    violated_steps: Mapping[str, int] | None = None
    penalty: float = np.nan


def puck_is_done(reference: Reference, tick: int, x: float, speed: float) -> bool:
    """Return whether the result of the puck is final: it has stopped, has left the table, or takes too long.

    x is its position along the table [m].
    """
    # A puck at rest before the end of plan and stop may still be hit.
    stopped = tick > len(reference.q) and speed < MIN_PUCK_SPEED_M_S
    outside = x > hockey.GOAL_LINE_M + hockey.PUCK_RADIUS_M
    return (
        stopped or outside or tick > reference.ticks + round(MAX_PUCK_TIME_S / TICK_S)
    )


def outcome_of(
    scene: SimulatorScene, reference: Reference, goal_xyz: Array, record: TickRecord
) -> Executed:
    """Compute the result of an execution whose plan ends with the tip at ``goal_xyz`` [m], shape (3,)."""
    ticks = min(reference.ticks, len(record.q))
    height = scene.height
    during = slice(0, ticks)
    tip = scene.on_table(record.tip)
    goal_distance = float(np.linalg.norm(record.tip[ticks - 1] - goal_xyz))
    executed = Executed(
        finished=goal_distance < MAX_GOAL_DISTANCE_M,
        goal_distance=goal_distance,
        z_error=np.nan
        if height is None
        else TICK_S * float(np.abs(tip[during, 2] - height).sum()),
        vertical_error=np.nan
        if height is not None
        else TICK_S
        * float(
            tilt((scene.upright.T @ record.rotation[during]).transpose(1, 2, 0)).sum()
        ),
        tracking_error=TICK_S
        * float(np.abs(record.q[during] - record.reference[during]).sum()),
        torque_use=float(np.abs(record.torque_use).max()),
        violated_steps=record.violated_steps,
        penalty=record.penalty,
    )
    planned = Tip(scene.robot)
    planned_tip = scene.on_table(
        np.array([planned.at(q)[0] for q in reference.q[: reference.ticks]])
    )
    if height is not None:
        executed = _with_table(
            executed, record, planned_tip[:, 2] - height, tip[during, 2] - height
        )
    if scene.puck is None:
        return replace(
            executed, collided=record.max_penetration > MAX_LEGAL_PENETRATION_M
        )
    return _with_puck(executed, record, planned_tip)


def _with_table(
    executed: Executed, record: TickRecord, commanded_height: Array, height: Array
) -> Executed:
    """Add the heights of the mallet over the plane [m], commanded and executed, and the forces of the table."""
    executed = replace(
        executed,
        plane_error=float(np.abs(height).max()),
        commanded_plane_error=float(np.abs(commanded_height).max()),
    )
    if np.isnan(record.table_force).any():
        return executed
    normal, friction = record.table_force.T
    return replace(
        executed,
        table_force=float(normal.max()),
        table_friction=float(friction.max()),
        table_contact_time=TICK_S * int(np.sum(normal > 0)),
    )


def _with_puck(executed: Executed, record: TickRecord, planned_tip: Array) -> Executed:
    """Add the result of the puck."""
    speed = np.linalg.norm(record.puck_velocity, axis=1)
    touched = np.flatnonzero(record.puck_contact)
    if not len(touched):
        return replace(executed, hit=False, scored=False, touched_early=False)
    first = int(touched[0])
    # Length of the planned path from the first contact to its end.
    left = float(np.linalg.norm(np.diff(planned_tip[first:], axis=0), axis=1).sum())
    # Drag slows the puck later: its speed is the largest one soon after the contact.
    speeds_after = speed[first : first + round(10 * hockey.CONTACT_TIME_S / TICK_S)]
    x, y = record.puck.T
    return replace(
        executed,
        hit=True,
        scored=bool(
            np.any((x > hockey.GOAL_LINE_M) & (np.abs(y) < hockey.GOAL_WIDTH_M / 2))
        ),
        touched_early=left > EARLY_CONTACT_M,
        contact_distance=left,
        hit_time=first * TICK_S,
        puck_speed=float(speeds_after.max()),
    )
