"""Result of an execution, computed from the record of every tick."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.simulator import hockey
from cnpgen.benchmark.simulator.executed import Executed
from cnpgen.benchmark.simulator.reference import TICK_S, Reference
from cnpgen.benchmark.simulator.simulator_scene import SimulatorScene
from cnpgen.benchmark.simulator.tip import Tip
from cnpgen.judges.plans.paper import tilt

Array = NDArray[np.float64]

MAX_GOAL_DISTANCE_M = 0.01  # of a finished motion, as in the paper
EARLY_CONTACT_M = hockey.PATH_LEFT_AT_CONTACT_M + 0.01  # a contact with more of the planned path left is early
MIN_PUCK_SPEED_M_S = 0.02  # a slower puck counts as stopped
MAX_LEGAL_PENETRATION_M = 1e-3
MAX_PUCK_TIME_S = 4.0  # until the puck arrives


@dataclass(frozen=True)
class TickRecord:
    """Record of K ticks.

    Attributes:
        q: Joint positions [rad], shape (K, n).
        tip: Positions of the tip [m], shape (K, 3).
        rotation: Its rotation, shape (K, 3, 3).
        reference: Reference positions of the joints [rad], shape (K, n).
        torque_use: Torques as fractions of the rated torques, shape (K, n).
        puck: Positions of the puck over the table [m], shape (K, 2); nan without one.
        puck_velocity: Its velocities [m/s], shape (K, 2); nan without one.
        puck_contact: Whether mallet and puck touch, shape (K,).
        table_force: Normal and friction force between mallet and table [N], shape (K, 2); nan if not simulated.
        violated_steps: See ``Executed``.
        penalty: See ``Executed``.
        max_penetration: Maximum penetration of an obstacle [m].
    """

    q: Array
    tip: Array
    rotation: Array
    reference: Array
    torque_use: Array
    puck: Array
    puck_velocity: Array
    puck_contact: NDArray[np.bool_]
    table_force: Array
    max_penetration: float = 0.0
    violated_steps: Mapping[str, int] | None = None
    penalty: float = np.nan


def puck_is_done(reference: Reference, tick: int, x: float, speed: float) -> bool:
    """Return whether the result of the puck is final: it has stopped, has left the table, or takes too long.

    x is its position along the table [m].
    """
    stopped = tick > len(reference.q) and speed < MIN_PUCK_SPEED_M_S
    outside = x > hockey.GOAL_LINE_M + hockey.PUCK_RADIUS_M
    return stopped or outside or tick > reference.ticks + round(MAX_PUCK_TIME_S / TICK_S)


def outcome_of(scene: SimulatorScene, reference: Reference, goal_xyz: Array, record: TickRecord) -> Executed:
    """Compute the result of an execution whose plan ends with the tip at ``goal_xyz`` [m], shape (3,)."""
    ticks, height = min(reference.ticks, len(record.q)), scene.height
    during, tip = slice(0, ticks), scene.on_table(record.tip)
    goal_distance = float(np.linalg.norm(record.tip[ticks - 1] - goal_xyz))
    executed = Executed(
        finished=goal_distance < MAX_GOAL_DISTANCE_M,
        goal_distance=goal_distance,
        z_error=np.nan if height is None else TICK_S * float(np.abs(tip[during, 2] - height).sum()),
        vertical_error=np.nan
        if height is not None
        else TICK_S * float(tilt((scene.upright.T @ record.rotation[during]).transpose(1, 2, 0)).sum()),
        tracking_error=TICK_S * float(np.abs(record.q[during] - record.reference[during]).sum()),
        torque_use=float(np.abs(record.torque_use).max()),
        violated_steps=record.violated_steps,
        penalty=record.penalty,
    )
    planned = Tip(scene.robot)
    planned_tip = scene.on_table(np.array([planned.at(q)[0] for q in reference.q[: reference.ticks]]))
    if height is not None:
        executed = _with_table(executed, record, planned_tip[:, 2] - height, tip[during, 2] - height)
    if scene.puck is None:
        return replace(executed, collided=record.max_penetration > MAX_LEGAL_PENETRATION_M)
    return _with_puck(executed, record, planned_tip)


def _with_table(executed: Executed, record: TickRecord, commanded_height: Array, height: Array) -> Executed:
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
    left = float(np.linalg.norm(np.diff(planned_tip[first:], axis=0), axis=1).sum())
    speeds_after = speed[first : first + round(10 * hockey.CONTACT_TIME_S / TICK_S)]
    x, y = record.puck.T
    return replace(
        executed,
        hit=True,
        scored=bool(np.any((x > hockey.GOAL_LINE_M) & (np.abs(y) < hockey.GOAL_WIDTH_M / 2))),
        touched_early=left > EARLY_CONTACT_M,
        contact_distance=left,
        hit_time=first * TICK_S,
        puck_speed=float(speeds_after.max()),
    )
