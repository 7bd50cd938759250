"""What came of executing a plan, from what was seen at every tick of the controller."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.simulator import hockey
from cnpgen.benchmark.simulator.executed import Executed
from cnpgen.benchmark.simulator.reference import TICK, Reference
from cnpgen.benchmark.simulator.simulator_scene import Scene
from cnpgen.judges.plans.paper import tilt

Array = NDArray[np.float64]

NEAR = 0.01  # m: how far from the goal a motion has finished, as the paper counts
LEFT = 0.03  # m: a touch with more of the way left than this is an early one
MOVING = 0.02  # m/s: a puck that is slower lies
DEEP = 1e-3  # m: deeper in an obstacle is a collision
WAIT = 4.0  # s: how long a puck may take to arrive


@dataclass(frozen=True)
class Seen:
    """What was seen at K ticks.

    Attributes:
        q: Joint positions [rad], shape (K, n).
        tip: Positions of the tip [m], shape (K, 3).
        rotation: Its rotation, shape (K, 3, 3).
        wanted: The joint positions that were wanted [rad], shape (K, n).
        torque_use: Torques as shares of the rated ones, shape (K, n).
        puck: Positions of the puck over the table [m], shape (K, 2); nan without one.
        puck_velocity: Its velocities [m/s], shape (K, 2); nan without one.
        deepest: How deep something was in an obstacle [m].
    """

    q: Array
    tip: Array
    rotation: Array
    wanted: Array
    torque_use: Array
    puck: Array
    puck_velocity: Array
    deepest: float = 0.0


def puck_is_done(reference: Reference, tick: int, x: float, speed: float) -> bool:
    """Whether a puck cannot change the result any more: it lies, has left the table or takes too long.

    Args:
        reference: What the controller follows.
        tick: The present one.
        x: Where the puck is along the table [m].
        speed: How fast it is [m/s].
    """
    stopped = tick > len(reference.q) and speed < MOVING
    return stopped or x > hockey.FAR + hockey.PUCK_RADIUS or tick > reference.ticks + round(WAIT / TICK)


def outcome_of(scene: Scene, reference: Reference, goal_xyz: Array, seen: Seen) -> Executed:
    """Say what came of it.

    Args:
        scene: The world.
        reference: What the controller was to follow.
        goal_xyz: Where the tip must be at the end of the plan [m], shape (3,).
        seen: What was seen.
    """
    ticks, height = min(reference.ticks, len(seen.q)), scene.height
    during = slice(0, ticks)
    found = Executed(
        finished=bool(np.linalg.norm(seen.tip[ticks - 1] - goal_xyz) < NEAR),
        z_error=np.nan if height is None else TICK * float(np.abs(seen.tip[during, 2] - height).sum()),
        vertical_error=np.nan
        if height is not None
        else TICK * float(tilt(seen.rotation[during].transpose(1, 2, 0)).sum()),
        tracking_error=TICK * float(np.abs(seen.q[during] - seen.wanted[during]).sum()),
        torque_use=float(np.abs(seen.torque_use).max()),
    )
    if scene.puck is None:
        return replace(found, collided=seen.deepest > DEEP)
    return _of_the_puck(found, seen, seen.tip[during])


def _of_the_puck(found: Executed, seen: Seen, tip: Array) -> Executed:
    """Add what became of the puck."""
    speed = np.linalg.norm(seen.puck_velocity, axis=1)
    moved = np.flatnonzero(speed > MOVING)
    if not len(moved):
        return replace(found, hit=False, scored=False, touched_early=False)
    first = int(moved[0])
    steps = np.linalg.norm(np.diff(tip[first:], axis=0), axis=1)
    away = speed[first : first + round(10 * hockey.CONTACT_TIME / TICK)]
    x, y = seen.puck.T
    return replace(
        found,
        hit=True,
        scored=bool(np.any((x > hockey.FAR) & (np.abs(y) < hockey.GOAL_WIDTH / 2))),
        touched_early=float(steps.sum()) > LEFT,
        hit_time=first * TICK,
        puck_speed=float(away.max()),
    )
