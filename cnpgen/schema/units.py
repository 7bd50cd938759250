"""Quantities such as ``"50 ms"`` or ``"[0.6, 1.3] m"``, parsed to floats in SI units."""

import math
import re
from decimal import Decimal
from typing import Any

from cnpgen.errors import nearest

_DEG = "0.0174532925199432957692369"

# SI unit -> dimension, largest plausible absolute value, and units with their
# conversion factors.
_QUANTITIES: dict[str, tuple[str, float, dict[str, str]]] = {
    "1": ("a number", math.inf, {"1": "1", "%": "0.01"}),
    "m": (
        "a length",
        100.0,
        {"m": "1", "km": "1000", "cm": "0.01", "mm": "0.001", "um": "0.000001"},
    ),
    "s": (
        "a time",
        3600.0,
        {
            "s": "1",
            "ms": "0.001",
            "us": "0.000001",
            "ns": "0.000000001",
            "min": "60",
            "h": "3600",
        },
    ),
    "rad": ("an angle", 8 * math.pi, {"rad": "1", "mrad": "0.001", "deg": _DEG}),
    "rad/s": (
        "an angular velocity",
        200.0,
        {"rad/s": "1", "deg/s": _DEG, "rpm": "0.1047197551196597746154214"},
    ),
    "rad/s^2": ("an angular acceleration", 1e4, {"rad/s^2": "1", "deg/s^2": _DEG}),
    "rad/s^3": ("an angular jerk", 1e7, {"rad/s^3": "1", "deg/s^3": _DEG}),
    "m/s": ("a velocity", 100.0, {"m/s": "1", "cm/s": "0.01", "mm/s": "0.001"}),
    "m/s^2": (
        "an acceleration",
        1e4,
        {"m/s^2": "1", "cm/s^2": "0.01", "mm/s^2": "0.001"},
    ),
    "kg": ("a mass", 2500.0, {"kg": "1", "g": "0.001", "t": "1000"}),
    "N": ("a force", 1e6, {"N": "1", "kN": "1000"}),
    "N m": ("a torque", 1e5, {"N m": "1", "Nm": "1", "kN m": "1000"}),
    "1/s": ("a rate", math.inf, {"1/s": "1", "Hz": "1"}),
    "kg m^2": ("an inertia", 1e4, {"kg m^2": "1"}),
    "W": ("a power", 1e6, {"W": "1", "kW": "1000"}),
    "N m s/rad": ("a viscous friction", 1e5, {"N m s/rad": "1", "Nms/rad": "1"}),
}

UNITS: dict[str, tuple[str, Decimal]] = {
    unit: (si, Decimal(factor))
    for si, (_, _, scale) in _QUANTITIES.items()
    for unit, factor in scale.items()
}
"""Unit -> SI unit and conversion factor.

Decimal, so that "9 mm" and 0.009 are the same float.
"""

PLAUSIBLE_MAX = {
    si: largest for si, (_, largest, _) in _QUANTITIES.items() if largest < math.inf
}
"""SI unit -> largest plausible absolute value of a quantity.

Larger ones are probably in another unit.
"""

OTHER_UNITS = {"rad": "deg", "m": "mm", "s": "ms", "kg": "g"}
"""SI unit -> unit in which values are often given by error."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_QUANTITY = re.compile(rf"\s*({_NUMBER.pattern})(.*)", re.DOTALL)
_LIST = re.compile(r"\s*\[(.*)\](.*)", re.DOTALL)
_SPELLINGS = (
    ("**", "^"),
    ("*", " "),
    ("·", " "),
    ("²", "^2"),
    ("°", "deg"),
    ("µ", "u"),
)


def dimension(unit: str) -> str:
    """Return the name of the dimension of an SI unit: ``"a time [s]"``."""
    name = _QUANTITIES[unit][0] if unit in _QUANTITIES else "a quantity"
    return name if unit == "1" else f"{name} [{unit}]"


def suggested_unit(
    value: float, unit: str, low: float = -math.inf, high: float = math.inf
) -> str:
    """Return a hint for a value [unit] outside of its plausible range: ``"; did you mean 15 deg = 0.262 rad?"``.

    The hint is empty for units without a common error, and if the converted value is
    outside of ``low`` to ``high``.
    """
    base, slash, per = unit.partition("/")
    # "rad/s" is converted as "rad": both have the same factor.
    factor = float(UNITS[OTHER_UNITS[base]][1]) if base in OTHER_UNITS else 0.0
    if not factor or not low <= value * factor <= high:
        return ""
    other = f"{OTHER_UNITS[base]}{slash}{per}"
    text = (
        f"; {value:.6g} {unit} is {value / factor:.0f} {other}" if base == "rad" else ""
    )
    return f"{text}; did you mean {value:.6g} {other} = {value * factor:.3g} {unit}?"


def show(value: object) -> str:
    """Format a TOML value as in its file, shortened for messages."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def parse_number(value: Any, unit: str) -> float:
    """Read a number in ``unit``, or a text such as ``"50 ms"`` or ``"0.05"``; return the value [unit], an SI unit.

    Raises:
        ValueError: The value is not a finite number, or its unit is unknown or of
            another dimension.
    """
    match = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if match:
        # Numbers outside the range of floats become 0 or inf, which need no decimal
        # digits.
        ordinary = 0.0 < abs(float(match[1])) < math.inf
        return _finite(
            Decimal(match[1]) if ordinary else float(match[1]), match[2], value, unit
        )
    if isinstance(value, bool | str) or not isinstance(value, int | float):
        raise ValueError(f"expected {dimension(unit)}, got {show(value)}")  # noqa: TRY004 - a user's error
    return _finite(value, "", value, unit)


def parse_numbers(
    value: Any, unit: str, *, count: int | None = None
) -> tuple[float, ...]:
    """Read a list of values for ``parse_number``, or a text such as ``"[0.6, 1.3] m"``; return the values [unit].

    Raises:
        ValueError: The value is not a list, has an invalid entry, or not ``count``
            entries (None for one or more).
    """
    match = _LIST.fullmatch(value) if isinstance(value, str) else None
    if match:
        _check_commas(match, value)
    items = (
        [f"{item.strip()} {match[2].strip()}".strip() for item in match[1].split(",")]
        if match
        else value
    )
    if not isinstance(items, list):
        raise ValueError(f"expected a list, each {dimension(unit)}, got {show(value)}")  # noqa: TRY004 - a user's error
    if not items or (match and not match[1].strip()):
        raise ValueError("is empty, expected at least one number")
    if count not in (None, len(items)):
        raise ValueError(f"expected {count} numbers, got {len(items)}: {show(value)}")
    return tuple(parse_number(item, unit) for item in items)


def parse_range(value: Any, unit: str) -> tuple[float, float]:
    """Read a list of two, ``"[0.6, 1.3] m"``, or a value for ``parse_number``, a single point; return both ends [unit].

    Raises:
        ValueError: An end is invalid, or the low end is above the high end.
    """
    if isinstance(value, list) or (
        isinstance(value, str) and value.lstrip().startswith("[")
    ):
        low, high = parse_numbers(value, unit, count=2)
    else:
        low = high = parse_number(value, unit)
    if low > high:
        raise ValueError(
            f"empty range {show(value)}: its low end is above its high end"
        )
    return low, high


def _check_commas(match: re.Match[str], value: object) -> None:
    """Raise ValueError for missing commas, as in ``"[0.6 1.3] m"``."""
    items = [re.split(r"[;\s]+", item.strip()) for item in match[1].split(",")]
    if any(len(words) > 1 and all(map(_NUMBER.fullmatch, words)) for words in items):
        meant = ", ".join(word for words in items for word in words)
        raise ValueError(
            f"numbers are separated by commas, got {show(value)} (did you mean '[{meant}]{match[2]}'?)"
        )


def _finite(number: Decimal | float, suffix: str, value: object, unit: str) -> float:
    """Convert ``number suffix`` to ``unit``; ``value`` is the user's input."""
    factor = _factor(_spell(suffix), value, unit)
    try:
        result = float(number * factor if isinstance(number, Decimal) else number)
    except ArithmeticError:
        result = math.inf
    if not math.isfinite(result):
        raise ValueError(
            f"expected {dimension(unit)} that is finite, got {show(value)}"
        )
    # No negative zero: "-0" and "0" are the same recipe.
    return result + 0.0


def _factor(written: str, value: object, unit: str) -> Decimal:
    """Return the conversion factor from ``written`` to ``unit``."""
    if written in ("", unit):
        return Decimal(1)
    if written not in UNITS:
        same = [known for known, (si, _) in UNITS.items() if si == unit]
        hint = nearest(written, same) or nearest(written, UNITS)
        raise ValueError(
            f"unknown unit {written!r} in {show(value)}, expected {dimension(unit)}{hint}"
        )
    si, factor = UNITS[written]
    if si != unit:
        raise ValueError(f"expected {dimension(unit)}, got {show(value)}")
    return factor


def _spell(unit: str) -> str:
    """Normalize the spelling of a unit: ``"N·m"`` to ``"N m"``, ``"/s"`` to ``"1/s"``."""
    for old, new in _SPELLINGS:
        unit = unit.replace(old, new)
    unit = re.sub(r"\s*/\s*", "/", " ".join(unit.split()))
    return f"1{unit}" if unit.startswith("/") else unit
