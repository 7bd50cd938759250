"""Replanning to a goal that has not moved: what is left of the old plan is an answer, and often the faster one."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.plans.plans import Plans
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.rest import rest_of, with_finer_knots

Array = NDArray[np.float64]

SAME = 1e-9  # rad, rad/s and rad/s^2: a goal that differs by less has not moved
OVER = 1e-6  # s: of a motion that ends sooner nothing is kept
WORTH = 0.98  # of what was left: a new plan must be faster than that; the old one is known, and valid perhaps


def keep_what_is_faster(old: Plans, time: Array, new: Plans, *, acceleration_limit: Array) -> Plans:
    """Put the rest of old plans in the place of new ones to the same goal that are not faster.

    Args:
        old: N plans.
        time: When the new plans take over, since the start of the old ones [s], shape (N,).
        new: N plans from the states at these times.
        acceleration_limit: Limits of the joints [rad/s^2], shape (n,).

    Returns:
        The new plans, some replaced; all with more control points where a rest needs them.
    """
    left = old.duration - time
    kept = np.flatnonzero(_same_goal(old.boundary, new.boundary) & (left > OVER) & (WORTH * left <= new.duration))
    if not len(kept):
        return new
    motion, boundary = old.motion[kept], new.boundary[kept]
    rest = rest_of(motion, time[kept], boundary, spec=new.motion.spec, acceleration_limit=acceleration_limit)
    found = with_finer_knots(new.motion, rest.spec)
    path, rate = found.path.copy(), found.rate.copy()
    path[kept], rate[kept] = rest.path, rest.rate
    return replace(new, path_control_points=path, rate_control_points=rate)


def _same_goal(old: Boundary, new: Boundary) -> NDArray[np.bool_]:
    pairs = [(old.goal_q, new.goal_q), (old.goal_dq, new.goal_dq)]
    if new.goal_ddq is not None:
        if old.goal_ddq is None:  # and the old motion's is whatever it came to be
            return np.zeros(len(old), bool)
        pairs.append((old.goal_ddq, new.goal_ddq))
    return np.asarray(np.all([np.abs(one - other).max(axis=1) <= SAME for one, other in pairs], axis=0))
