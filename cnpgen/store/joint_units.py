"""Units of joints, one for all or one for each: what is in rad where a joint turns is in m where it slides."""

from functools import cache

_SLIDING = {"rad": "m", "rad/s": "m/s", "rad/s^2": "m/s^2", "rad/s^3": "m/s^3", "N m": "N"}
_BETWEEN = ", "  # units of several values in one text


@cache
def units_of_joints(turning: str, sliding: tuple[bool, ...]) -> str:
    """Name the units of a quantity of joints: one for all, or one per joint, separated by commas, where they differ.

    Args:
        turning: Its unit at joints that turn: "rad", "rad/s", "rad/s^2", "rad/s^3" or "N m".
        sliding: Of every joint whether it slides.
    """
    units = [_SLIDING[turning] if slides else turning for slides in sliding]
    return units[0] if len(set(units)) == 1 else _BETWEEN.join(units)


def unit_of(units: str, index: int) -> str:
    """Return the unit of one of several values, or of one of several rounds of the joints.

    Args:
        units: What ``units_of_joints`` names, or one unit.
        index: Which value.
    """
    each = units.split(_BETWEEN)
    return each[index % len(each)]
