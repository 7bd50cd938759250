"""Braking motions: from a state on a motion to rest at a configuration that the motion passes later."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.planner.planner import Planner
from cnpgen.planner.set_points import SampledMotion
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans

BRAKING_LOOKAHEADS_S = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5])


def plan_stop(
    planner: Planner, motion: SampledMotion, time: float, *, parameters: ArrayLike | None = None
) -> Plans | None:
    """Plan the fastest valid stop from a state on a motion.

    The goals are configurations that the motion passes later, which are on the constraint manifold. The plans are
    judged in the order of their durations.

    Args:
        planner: A planner whose model plans from moving states to rest, such as airhockey-online.
        motion: The motion in execution.
        time: Time at which the stop begins [s].
        parameters: Parameters of the problem, if it has any, shape (width,).

    Returns:
        The stop, or None if no candidate is valid.

    Raises:
        UsageError: The model does not plan from moving states.
    """
    q, dq, ddq = (values[0] for values in motion.at(np.array([time])))
    goals = motion.at(time + BRAKING_LOOKAHEADS_S).q
    candidates = planner.plan(q, goals, start_dq=dq, start_ddq=ddq, parameters=parameters)
    for index in np.argsort(candidates.duration).tolist():
        plan = candidates[index]
        if np.isfinite(plan.duration[0]) and evaluate_plans(plan).valid[0]:
            return plan
    return None
