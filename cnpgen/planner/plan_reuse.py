"""Reuse the previous plan when replanning to an unchanged goal: its remaining trajectory is often faster."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.plans.plans import Plans
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.remaining_trajectory import remaining_trajectory, with_finer_knots

Array = NDArray[np.float64]

GOAL_TOLERANCE = 1e-9  # rad, rad/s and rad/s^2: goals that differ by less are equal
MIN_REMAINING_TIME_S = 1e-6  # motions that end sooner are not reused
MAX_DURATION_RATIO = (
    0.98  # of a new plan's duration to the remaining time; else the old plan, perhaps checked, is reused
)


def reuse_previous_plan(old: Plans, time: Array, new: Plans, *, acceleration_limit: Array) -> Plans:
    """Replace new plans by the remaining trajectory of old ones to the same goal, unless the new ones are faster.

    Args:
        old: N plans.
        time: Time at which the new plans take over, since the start of the old ones [s], shape (N,).
        new: N plans from the states at these times.
        acceleration_limit: Limits of the joints [rad/s^2], shape (n,).

    Returns:
        The new plans, some replaced; all with more control points if a remaining trajectory needs them.
    """
    remaining_time = old.duration - time
    reused = np.flatnonzero(
        _same_goal(old.boundary, new.boundary)
        & (remaining_time > MIN_REMAINING_TIME_S)
        & (MAX_DURATION_RATIO * remaining_time <= new.duration)
    )
    if not len(reused):
        return new
    motion, boundary = old.motion[reused], new.boundary[reused]
    remaining = remaining_trajectory(
        motion, time[reused], boundary, spec=new.motion.spec, acceleration_limit=acceleration_limit
    )
    refined = with_finer_knots(new.motion, remaining.spec)
    path, rate = refined.path.copy(), refined.rate.copy()
    path[reused], rate[reused] = remaining.path, remaining.rate
    return replace(new, path_control_points=path, rate_control_points=rate)


def _same_goal(old: Boundary, new: Boundary) -> NDArray[np.bool_]:
    pairs = [(old.goal_q, new.goal_q), (old.goal_dq, new.goal_dq)]
    if new.goal_ddq is not None:
        if old.goal_ddq is None:  # the old motion's goal acceleration was free
            return np.zeros(len(old), bool)
        pairs.append((old.goal_ddq, new.goal_ddq))
    if new.parameters is not None and old.parameters is not None:
        pairs.append((old.parameters, new.parameters))
    return np.asarray(np.all([np.abs(before - after).max(axis=1) <= GOAL_TOLERANCE for before, after in pairs], axis=0))
