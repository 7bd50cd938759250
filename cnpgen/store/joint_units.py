"""Units of joint quantities: rad for revolute joints, m for prismatic joints."""

from functools import cache

SLIDING_UNITS = {
    "rad": "m",
    "rad/s": "m/s",
    "rad/s^2": "m/s^2",
    "rad/s^3": "m/s^3",
    "N m": "N",
    "kg m^2": "kg",
    "N m s/rad": "N s/m",
}
_SEPARATOR = ", "


@cache
def units_of_joints(revolute_unit: str, is_prismatic: tuple[bool, ...]) -> str:
    """Return the unit of a joint quantity: one for all joints, or one per joint, separated by commas, if they differ.

    The unit of revolute joints is "rad", "rad/s", "rad/s^2", "rad/s^3", "N m",
    "kg m^2" or "N m s/rad".
    """
    units = [
        SLIDING_UNITS[revolute_unit] if prismatic else revolute_unit
        for prismatic in is_prismatic
    ]
    # Robots with one kind of joints have one short unit.
    return units[0] if len(set(units)) == 1 else _SEPARATOR.join(units)


def unit_of(units: str, index: int) -> str:
    """Return the unit of one column.

    The units of joints repeat for several values per joint.
    """
    names = units.split(_SEPARATOR)
    return names[index % len(names)]
