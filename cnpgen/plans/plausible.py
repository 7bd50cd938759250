"""Joint positions that cannot be meant: in degrees, or normalised."""

import inspect
import warnings

import numpy as np

from cnpgen.robots.robot import Robot
from cnpgen.store.joint_units import unit_of
from cnpgen.trajectory.boundary import Boundary

FAR = 2.0  # from the middle of a joint's range, in halves of it: a whole half range beyond its limit


def warn_of_far_joints(robot: Robot, boundary: Boundary) -> None:
    """Warn where a start or a goal is so far outside of the joints' limits that its unit is probably another one.

    It is no error: boundary conditions are not judged where they come in, files may hold anything, and the verdict says
    what is wrong with a plan. Nothing is said of numbers that are not finite.

    Args:
        robot: The robot.
        boundary: Boundary conditions, shape (N, n) each.
    """
    low, high = robot.position_lower, robot.position_upper
    for name in ("start_q", "goal_q"):
        q = np.asarray(getattr(boundary, name))
        if np.count_nonzero((low <= q) & (q <= high)) == q.size:
            continue
        far = np.abs(q - (low + high) / 2) > FAR * (high - low) / 2
        if far.any():
            plan, joint = np.argwhere(far)[0]
            unit = unit_of(robot.units("rad"), int(joint))
            other = "millimetres" if unit == "m" else "degrees"
            value, limits = f"{q[plan, joint]:.6g} {unit}", f"[{low[joint]:.3g}, {high[joint]:.3g}]"
            warnings.warn(
                f"{name} of plan {plan}: {robot.joint_names[joint]} = {value} is far outside of its limits, {limits}:"
                f" joint positions must be in {unit}, are these {other}, or normalised?",
                UserWarning,
                stacklevel=_users_level(),
            )


def _users_level() -> int:
    """Return the ``stacklevel`` of a warning of this module's that names the user's line, not one of this package."""
    level, frame = 0, inspect.currentframe()
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] in {"cnpgen", "contextlib"}:
        level, frame = level + 1, frame.f_back
    return max(level, 1)
