"""Reference of the controller: the states of a plan at its ticks, and a stop if the plan ends in motion."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.errors import UsageError
from cnpgen.trajectory.spline_motion import Motion

StatesAt = Callable[[Array], tuple[Array, Array, Array]]
"""Positions [rad], velocities [rad/s] and accelerations [rad/s^2] at times [s] of shape (K,), shape (K, n) each."""

TICK_S = 1e-3  # period of the controller
MAX_EXECUTED_DURATION_S = 60.0


@dataclass(frozen=True)
class Reference:
    """States to follow at the K ticks of the controller; after the last tick, the robot stands still.

    Positions, velocities and accelerations have shape (K, n), in radians. The duration
    of the plan is in seconds; the stop follows.
    """

    q: Array
    dq: Array
    ddq: Array
    duration: float

    @property
    def ticks(self) -> int:
        """Number of ticks within the plan, including its end."""
        return int(np.ceil(self.duration / TICK_S)) + 1

    def at(self, ticks: int | Integers) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations at a tick, shape (n,) each, or at K ticks, shape (K, n)."""
        last = len(self.q) - 1
        rows = np.minimum(ticks, last)
        moving = np.less_equal(ticks, last)[..., None]
        return self.q[rows], self.dq[rows] * moving, self.ddq[rows] * moving


def states_of(motion: Motion) -> StatesAt:
    """Return the function that evaluates one motion in time."""

    def states(t: Array) -> tuple[Array, Array, Array]:
        values = motion.at_times(t[None])
        return values.q[0], values.dq[0], values.ddq[0]

    return states


def make_reference(
    states: StatesAt, duration: float, *, acceleration_limit: Array
) -> Reference:
    """Sample a trajectory of a duration [s] and add a stop, in which all joints decelerate uniformly in the same time.

    Raises:
        UsageError: The plan never arrives, or plan or stop exceed
            ``MAX_EXECUTED_DURATION_S``.
    """
    if not 0 < duration <= MAX_EXECUTED_DURATION_S:
        raise UsageError(
            f"a plan of {duration:g} s cannot be executed,"
            f" expected more than 0 and at most {MAX_EXECUTED_DURATION_S:g} s"
        )
    during = states(np.arange(0.0, duration, TICK_S))
    q, dq, _ = (values[0] for values in states(np.array([duration])))
    # One time for all joints: the one that needs longest at its limit determines it.
    stop = max(float(np.max(np.abs(dq) / acceleration_limit)), TICK_S)
    if not stop <= MAX_EXECUTED_DURATION_S:
        raise UsageError(
            f"a plan after which the arm needs {stop:g} s to stop cannot be executed"
        )
    # The first tick after the end.
    first = len(during[0]) * TICK_S - duration
    after = np.minimum(np.append(np.arange(first, stop, TICK_S), stop), stop)[:, None]
    left = 1 - after / stop
    # With a velocity that falls linearly, the way is the mean velocity times the time.
    parts = (
        q + dq * after * (1 + left) / 2,
        dq * left,
        np.where(left > 0, -dq / stop, 0.0),
    )
    q, dq, ddq = (np.concatenate([a, b]) for a, b in zip(during, parts, strict=True))
    if not np.isfinite([q, dq, ddq]).all():
        raise UsageError("a plan that is not finite cannot be executed")
    return Reference(q, dq, ddq, duration)
