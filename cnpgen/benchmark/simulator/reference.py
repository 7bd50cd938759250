"""What the controller is to follow: the states of a plan at its ticks, and a stop where the plan ends in motion."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]
StatesAt = Callable[[Array], tuple[Array, Array, Array]]
"""Positions [rad], velocities [rad/s] and accelerations [rad/s^2] at times [s] of shape (K,), shape (K, n) each."""

TICK = 1e-3  # s: period of the controller
LONGEST = 60.0  # s: plans that take longer are not executed


@dataclass(frozen=True)
class Reference:
    """States to follow at the ticks of the controller; at ticks after the last one, the robot holds still.

    Attributes:
        q: Joint positions [rad], shape (K, n).
        dq: Joint velocities [rad/s], shape (K, n).
        ddq: Joint accelerations [rad/s^2], shape (K, n).
        duration: When the plan ends [s]; what follows is the stop.
    """

    q: Array
    dq: Array
    ddq: Array
    duration: float

    @property
    def ticks(self) -> int:
        """Number of the ticks within the plan, its end counted."""
        return int(np.ceil(self.duration / TICK)) + 1


def states_of(motion: Motion) -> StatesAt:
    """Return what evaluates one motion in time."""

    def states(t: Array) -> tuple[Array, Array, Array]:
        found = motion.at_times(t[None])
        return found.q[0], found.dq[0], found.ddq[0]

    return states


def make_reference(states: StatesAt, duration: float, *, acceleration_limit: Array) -> Reference:
    """Sample a trajectory that lasts ``duration`` and add a stop: each joint is scaled in time evenly, all equally long.

    Args:
        states: The trajectory.
        duration: How long it lasts [s].
        acceleration_limit: How fast joints are stopped after a plan that ends in motion [rad/s^2], shape (n,).

    Raises:
        UsageError: The plan never arrives, or it or the stop takes longer than ``LONGEST``.
    """
    if not 0 < duration <= LONGEST:
        raise UsageError(f"a plan of {duration:g} s cannot be executed: expected more than 0 and at most {LONGEST:g} s")
    during = states(np.arange(0.0, duration, TICK))
    q, dq, _ = (values[0] for values in states(np.array([duration])))
    stop = max(float(np.max(np.abs(dq) / acceleration_limit)), TICK)
    if not stop <= LONGEST:
        raise UsageError(f"a plan after which the arm needs {stop:g} s to stop cannot be executed")
    first = len(during[0]) * TICK - duration  # the first tick after the end
    after = np.minimum(np.append(np.arange(first, stop, TICK), stop), stop)[:, None]
    left = 1 - after / stop
    parts = (q + dq * after * (1 + left) / 2, dq * left, np.where(left > 0, -dq / stop, 0.0))
    q, dq, ddq = (np.concatenate([a, b]) for a, b in zip(during, parts, strict=True))
    if not np.isfinite([q, dq, ddq]).all():
        raise UsageError("a plan that is not finite cannot be executed")
    return Reference(q, dq, ddq, duration)
