"""Detection of implausible joint positions, in degrees or normalized."""

import inspect
import warnings

import numpy as np

from cnpgen.robots.plausible_values import find_implausible_value
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary


def warn_of_far_joints(robot: Robot, boundary: Boundary) -> None:
    """Warn about a start or goal so far outside the joint limits that its unit is probably wrong.

    It is not an error: boundary conditions are not judged on input, and the verdict reports violations of a plan.
    Values that are not finite are ignored.

    Args:
        robot: Robot of the problem.
        boundary: Boundary conditions, shape (N, n) each.
    """
    low, high = robot.position_lower, robot.position_upper
    for name in ("start_q", "goal_q"):
        q = np.asarray(getattr(boundary, name))
        if np.count_nonzero((low <= q) & (q <= high)) == q.size:
            continue
        wrong = find_implausible_value(robot, name, q, robot.units("rad"))
        if wrong is not None:
            joint, unit = wrong.column, wrong.unit
            other = "millimetres" if unit == "m" else "degrees"
            value, limits = f"{wrong.value:.6g} {unit}", f"[{low[joint]:.3g}, {high[joint]:.3g}]"
            label = robot.joint_names[joint]
            warnings.warn(
                f"{name} of plan {wrong.row}: {label} = {value} is far outside of its limits, {limits}:"
                f" joint positions must be in {unit}, are these {other}, or normalised?",
                UserWarning,
                stacklevel=_users_level(),
            )


def _users_level() -> int:
    """Return the ``stacklevel`` with which a warning refers to the user's line, not to this package."""
    level, frame = 0, inspect.currentframe()
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] in {"cnpgen", "contextlib"}:
        level, frame = level + 1, frame.f_back
    return max(level, 1)
