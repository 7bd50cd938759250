"""Detection of boundary conditions in a wrong unit: degrees, millimetres, or normalized values."""

import inspect
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.plausible_values import UnitError, check_plausible
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary

UNITS = {"q": "rad", "dq": "rad/s", "ddq": "rad/s^2"}


def check_boundary_units(
    robot: Robot, boundary: Boundary, *, where: str = "", argument: str | None = None, allow_large_angles: bool = False
) -> None:
    """Raise an error for boundary conditions so far outside of their limits that their unit is probably wrong.

    Other violations of limits are no errors: the verdict reports them. Values that are not finite are ignored.

    Args:
        robot: Robot of the problem.
        boundary: Boundary conditions, shape (N, n) each.
        where: Source of the boundary conditions, for messages.
        argument: Name of the caller's argument that holds them; by default the name of the condition.
        allow_large_angles: Whether to issue a warning instead.

    Raises:
        UnitError: A value is probably in another unit.
    """
    conditions = {name: np.asarray(values) for name, values in boundary.conditions().items()}
    columns = {name: values for name, values in conditions.items() if not is_usual(robot, name, values)}
    if not columns:
        return
    units = {name: robot.units(UNITS[name.rpartition("_")[2]]) for name in columns}
    try:
        check_plausible(robot, columns, units, noun="plan")
    except UnitError as error:
        text = f"{where}: {error}" if where else str(error)
        if allow_large_angles:
            warnings.warn(text, UserWarning, stacklevel=_users_level())
            return
        raise UnitError(
            f"{text} {{allow_large_angles}} accepts such values.",
            concerns=argument or error.argument,
            remedies={"allow_large_angles": True},
        ) from error


def is_usual(robot: Robot, name: str, values: NDArray[Any]) -> bool:
    """Return whether positions and their derivatives are within the limits: a fast check."""
    if name.endswith("_q"):
        within = (robot.position_lower <= values) & (values <= robot.position_upper)
    else:
        within = np.abs(values) <= (robot.velocity_limit if name.endswith("_dq") else robot.acceleration_limit)
    return bool(np.count_nonzero(within) == within.size)  # a third of the time of all()


def _users_level() -> int:
    """Return the ``stacklevel`` with which a warning refers to the user's line, not to this package."""
    level, frame = 0, inspect.currentframe()
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] in {"cnpgen", "contextlib"}:
        level, frame = level + 1, frame.f_back
    return max(level, 1)
