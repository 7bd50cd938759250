"""The values of options: whole numbers as people write them, parts of a job array."""

import math
import re
from argparse import ArgumentTypeError
from collections.abc import Callable, Sequence
from contextlib import suppress
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

from cnpgen.errors import either, nearest

_WHOLE = re.compile(r"[+-]?[0-9]+(?:(?:_[0-9]+)*|(?:\.[0-9]+)?[eE]\+?[0-9]{1,2})")
MAX_ROWS_ARGUMENT = 10**12  # make.MAX_ROWS
# Digits; no number here has more, and very long ones take long to read.
_MAX_DIGITS = 30
MAX_ERROR = 1.0  # rad or m; larger ones are probably in degrees
MAX_SELECTED = 10**7  # of the numbers in a range


def whole(text: str) -> int:
    """Read a whole number: ``120000``, ``120_000``, or ``1e6`` if it is exact.

    Raise ValueError for other texts.
    """
    if len(text) <= _MAX_DIGITS and _WHOLE.fullmatch(text):
        number = Decimal(text)
        # A decimal number is exact: 1.5e3 is whole and 1.55e1 is not.
        if number == number.to_integral_value():
            return int(number)
    raise ValueError(f"no whole number: {text[:_MAX_DIGITS]!r}")


def _whole_in_range(
    low: int, example: str, text: str, *, high: float = math.inf, expected: str = ""
) -> int:
    """Read a whole number from ``low`` to ``high``.

    ``expected`` is the message for larger ones.
    """
    try:
        number = whole(text)
    except ValueError:
        # A number below the range leads to the same error as a text that is none.
        number = low - 1
    if number < low:
        raise ArgumentTypeError(
            f"expected a whole number of at least {low}, such as {example}; got {text!r}"
        )
    if number > high:
        raise ArgumentTypeError(f"expected {expected}, got {text!r}")
    return number


positive = partial(_whole_in_range, 1, "4")
natural = partial(_whole_in_range, 0, "7")
rows = partial(
    _whole_in_range,
    1,
    "120000, 120_000 or 1e6",
    high=MAX_ROWS_ARGUMENT,
    expected="at most 1e+12 rows",
)
port = partial(natural, high=65535, expected="a port, 0 to 65535")  # 0 is any free port
seed = partial(natural, high=2**63 - 1, expected="a seed below 2^63")


def part(text: str) -> tuple[int, int]:
    """Read ``K/M``, the K-th of M parts, counted from 0."""
    try:
        k, m = (whole(number) for number in text.split("/"))
    except ValueError:
        # No part is valid with these numbers, so that the text below describes the
        # error.
        k = 0
        m = 0
    if not 0 <= k < m:
        raise ArgumentTypeError(
            f"expected K/M with 0 <= K < M, such as 0/8 for the first of eight; got {text!r}"
        )
    return k, m


def engine(text: str) -> str:
    """Read the name of an engine of workers: "loky", or one that an installed package registers."""
    from cnpgen.machine.engine import engine_names, is_engine

    if is_engine(text):
        return text
    known = engine_names()
    hint = nearest(text, known)
    raise ArgumentTypeError(f"expected one of {', '.join(known)}, got {text!r}{hint}")


def toml_value(text: str) -> Any:
    """Read a value as in a recipe, or as plain text."""
    import tomllib

    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def file_in(*endings: str) -> Callable[[str], str]:
    """Return a reader of the name of a file with one of some endings, in a folder that is there and can be written."""

    def read(text: str) -> str:
        from cnpgen.store.files.atomic import check_writable

        if not text.lower().endswith(endings):
            raise ArgumentTypeError(
                f"expected a file that ends in {either(endings)}, got {text!r}"
            )
        if not Path(text).absolute().parent.is_dir():
            raise ArgumentTypeError(
                f"expected a file in a folder that is there, got {text!r}"
            )
        check_writable(Path(text))
        return text

    return read


plot_file = file_in(".png", ".pdf", ".svg")


def seconds_with_unit(text: str) -> float:
    """Read a time above 0 with its unit, where a number alone is probably meant in another one: ``10ms``."""
    time = seconds(text)
    # The number ends without a letter: it has no unit.
    if text.strip()[-1:].isdigit() or text.strip().endswith("."):
        raise ArgumentTypeError(
            f"expected a time with its unit, such as 10ms; got {text!r}, is it {text}ms or {text}s?"
        )
    return time


def _quantity(unit: str, expected: str, text: str) -> float:
    """Read a number above 0, in SI or with its unit."""
    from cnpgen.schema.units import parse_number

    try:
        number = parse_number(text, unit)
    except ValueError as error:
        # Some errors say themselves what is expected.
        more = "" if str(error).startswith("expected") else f": {error}"
        raise ArgumentTypeError(f"expected {expected}; got {text!r}{more}") from error
    if number <= 0:
        raise ArgumentTypeError(f"expected {expected}; got {text!r}")
    return number


def time_limit(text: str) -> float:
    """Read a time in s or with its unit, or 0."""
    expected = "0, or a time above 0, such as 0.1 or 100ms"
    return 0.0 if text.strip() == "0" else _quantity("s", expected, text)


seconds = partial(_quantity, "s", "a time above 0, such as 0.001 or 1ms")
meters = partial(_quantity, "m", "a length above 0, such as 0.02 or 20mm")
kilograms = partial(_quantity, "kg", "a mass above 0, such as 1.5 or 1.5kg")
hertz = partial(_quantity, "1/s", "a rate above 0, such as 1000 or 1000Hz")


def numbers(text: str) -> tuple[int, ...]:
    """Read whole numbers and ranges of them, ends included: ``0,3,10-12``."""
    found: list[int] = []
    for item in text.split(","):
        ends = re.fullmatch(r"\s*(-?[0-9]+)\s*(?:-\s*([0-9]+))?\s*", item[:_MAX_DIGITS])
        # Text that does not match gets an empty range, which is refused.
        low, high = (int(ends[1]), int(ends[2] or ends[1])) if ends else (1, 0)
        if not low <= high < low + MAX_SELECTED:
            raise ArgumentTypeError(
                f"expected whole numbers such as 0,3,10-12; got {text[:60]!r}"
            )
        found += range(low, high + 1)
    return tuple(found)


def names(text: str) -> tuple[str, ...]:
    """Read names that are separated by commas: ``joint_1,joint_2``."""
    found = tuple(name.strip() for name in text.split(","))
    if not all(found):
        raise ArgumentTypeError(
            f"expected names separated by commas, got {text[:60]!r}"
        )
    return found


def _one_or_several(found: Sequence[float]) -> float | tuple[float, ...]:
    return found[0] if len(found) == 1 else tuple(found)


def _real_numbers(
    text: str, expected: str, accepts: Callable[[tuple[float, ...]], bool]
) -> tuple[float, ...]:
    """Read numbers separated by commas that meet a condition."""
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if not found or not accepts(found):
        raise ArgumentTypeError(f"expected {expected}; got {text[:60]!r}")
    return found


def positions(text: str) -> tuple[float, ...]:
    """Read finite numbers, separated by commas."""
    expected = "numbers in rad or m such as 0,-0.4,1.2"
    return _real_numbers(text, expected, lambda found: all(map(math.isfinite, found)))


def errors(text: str) -> float | tuple[float, ...]:
    """Read one number or three, at least 0: ``1e-3`` or ``1e-3,1e-2,0.5``."""

    def accepts(found: tuple[float, ...]) -> bool:
        return len(found) in {1, 3} and all(0 <= value < math.inf for value in found)

    expected = "one number or three, at least 0, such as 1e-3 or 1e-3,1e-2,0.5"
    return _one_or_several(_real_numbers(text, expected, accepts))


def tracking_errors(text: str) -> float | tuple[float, ...]:
    """Read angles or lengths of at least 0, separated by commas: ``2deg`` or ``1deg,1deg,5mm``."""
    from cnpgen.schema.units import parse_number

    found = []
    for part in text.split(","):
        # The joint of a number is not known here, so its unit may be that of either
        # kind.
        for unit in ("rad", "m"):
            with suppress(ValueError):
                found.append(parse_number(part.strip(), unit))
                break
    # A part that has neither unit is missing in the list.
    if len(found) != text.count(",") + 1 or not all(
        0 <= value < math.inf for value in found
    ):
        raise ArgumentTypeError(
            f"expected angles of at least 0, such as 2deg or 1deg,1deg,0.01; got {text[:60]!r}"
        )
    if max(found) > MAX_ERROR:
        raise ArgumentTypeError(
            f"expected at most {MAX_ERROR:g} rad or m, such as 2deg; got {text[:60]!r}"
        )
    return _one_or_several(found)


def parameters(text: str) -> dict[str, float]:
    """Read parameters of a problem, separated by commas: ``payload_mass=6kg`` or ``table_height=2cm,table_roll=0``."""
    from cnpgen.robots.parameter_ranges import PARAMETER_UNITS
    from cnpgen.schema.units import parse_number

    found = {}
    for part in text.split(","):
        name, _, value = (word.strip() for word in part.partition("="))
        if name not in PARAMETER_UNITS:
            raise ArgumentTypeError(
                f"expected NAME=VALUE with one of {', '.join(PARAMETER_UNITS)}; got {part[:60]!r}"
            )
        try:
            found[name] = parse_number(value, PARAMETER_UNITS[name])
        except ValueError as error:
            raise ArgumentTypeError(f"{name}: {error}") from error
    return found


def payload(text: str) -> tuple[float, ...]:
    """Read a mass [kg], or a mass and the centre of mass in the tip frame [m]: ``2`` or ``2,0,0,0.1``."""

    def accepts(found: tuple[float, ...]) -> bool:
        return len(found) in {1, 4} and all(map(math.isfinite, found)) and found[0] > 0

    expected = (
        "a mass above 0, with or without the centre of mass, such as 2 or 2,0,0,0.1"
    )
    return _real_numbers(text, expected, accepts)


def angle(text: str) -> float:
    """Read an angle or a length above 0: ``2deg``, ``0.035`` or ``5mm``."""
    found = tracking_errors(text)
    if isinstance(found, tuple) or not found > 0:
        raise ArgumentTypeError(
            f"expected one angle above 0, such as 2deg; got {text[:60]!r}"
        )
    return found


def amounts(text: str) -> float | tuple[float, ...]:
    """Read positive numbers separated by commas: ``500`` or ``7500,3750,5000``."""
    expected = "numbers above 0, such as 500 or 7500,3750"
    return _one_or_several(
        _real_numbers(
            text, expected, lambda found: all(0 < value < math.inf for value in found)
        )
    )
