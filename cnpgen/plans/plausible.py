"""Detection of boundary conditions in a wrong unit: degrees, millimetres, or normalized values."""

import inspect
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.plans.format import UNITS
from cnpgen.robots.plausible_values import UnitError, check_plausible
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary


def check_boundary_units(
    robot: Robot,
    boundary: Boundary,
    *,
    where: str = "",
    argument: str | None = None,
    allow_large_angles: bool = False,
) -> None:
    """Raise an error for boundary conditions so far outside of their limits that their unit is probably wrong.

    Other violations of limits are no errors: the verdict reports them. Values that are
    not finite are ignored. Messages begin with their source and concern the caller's
    argument, by default the condition. ``allow_large_angles`` issues a warning instead.

    Raises:
        UnitError: A value is probably in another unit.
    """
    try:
        check_units_of_states(robot, boundary.conditions(), noun="plan")
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


def check_units_of_states(
    robot: Robot, columns: Mapping[str, AnyArray], *, noun: str
) -> None:
    """Raise UnitError for columns such as ``start_dq``, shape (N, n) each, that are probably in another unit."""
    if not _are_usual(robot, list(columns.values())):
        units = {name: robot.units(UNITS[name.rpartition("_")[2]]) for name in columns}
        check_plausible(robot, columns, units, noun=noun)


def _are_usual(robot: Robot, states: Sequence[AnyArray]) -> bool:
    """Return whether states are within the limits of the joints: a fast check.

    The states are positions, velocities and accelerations of one state, or of two
    without or with the last accelerations; shape (N, n) each.
    """
    if {values.shape for values in states} != {(len(states[0]), robot.n)}:
        return False
    # Columns are in the order of state_bounds; later ones may be missing.
    values = np.concatenate(states, axis=1)
    low, high = robot.state_bounds
    width = values.shape[1]
    within = (low[:width] <= values) & (values <= high[:width])
    # A third of the time of all().
    return bool(np.count_nonzero(within) == within.size)


def _users_level() -> int:
    """Return the ``stacklevel`` with which a warning refers to the user's line, not to this package."""
    level = 0
    frame = inspect.currentframe()
    # Frames of this package and of context managers are skipped.
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[
        0
    ] in {"cnpgen", "contextlib"}:
        level = level + 1
        frame = frame.f_back
    return max(level, 1)
