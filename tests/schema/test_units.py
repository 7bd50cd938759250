"""Quantities with units."""

import math

import pytest

from cnpgen.schema.units import (
    UNITS,
    dimension,
    parse_number,
    parse_numbers,
    parse_range,
)
from tests.refusals import is_refused


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        ("50 ms", "s", 0.05),
        ("120 deg", "rad", math.radians(120)),
        ("-170deg", "rad", math.radians(-170)),
        ("0.8", "1", 0.8),
        (0.8, "1", 0.8),
        (3, "m", 3.0),
        (".5 m", "m", 0.5),
        ("20 rad/s^2", "rad/s^2", 20.0),
        ("12 kg", "kg", 12.0),
        ("40 N m", "N m", 40.0),
        ("40 N·m", "N m", 40.0),
        ("40 N*m", "N m", 40.0),
        ("40 Nm", "N m", 40.0),
        ("10 1/s", "1/s", 10.0),
        ("10 /s", "1/s", 10.0),
        ("20 Hz", "1/s", 20.0),
        ("1 mm", "m", 0.001),
        ("5 %", "1", 0.05),
        ("5%", "1", 0.05),
        ("60 rpm", "rad/s", 2 * math.pi),
        ("90 deg / s", "rad/s", math.pi / 2),
        ("1e-3 rad", "rad", 0.001),
        ("2 m^3", "m^3", 2.0),
    ],
)
def test_a_quantity_is_converted_to_si(value, unit, expected):
    assert parse_number(value, unit) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("millimetres", range(1, 200))
def test_a_decimal_prefix_gives_the_same_float_as_the_shifted_number(millimetres):
    assert parse_number(f"{millimetres} mm", "m") == float(f"{millimetres}e-3")


@pytest.mark.parametrize("unit", UNITS)
def test_every_unit_is_read_back_into_its_si_unit(unit):
    si, factor = UNITS[unit]
    assert parse_number(f"2 {unit}", si) == pytest.approx(2 * float(factor), rel=1e-15)
    assert si in dimension(si) or si == "1"


def test_negative_zero_is_zero():
    assert math.copysign(1.0, parse_number("-0 m", "m")) == 1.0
    assert math.copysign(1.0, parse_number(-0.0, "m")) == 1.0


@pytest.mark.parametrize(
    ("value", "unit", "message"),
    [
        ("5 mm", "s", r"expected a time \[s\], got '5 mm'"),
        ("5 %", "rad", r"expected an angle \[rad\], got '5 %'"),
        (
            "5 mmm",
            "m",
            r"unknown unit 'mmm' in '5 mmm', expected a length \[m\] \(did you mean 'mm'\?\)",
        ),
        ("5 degs", "rad", r"did you mean 'deg'\?"),
        ("5 N m m", "N m", "unknown unit"),
        ("fast", "1", "expected a number, got 'fast'"),
        ("", "1", "expected a number, got ''"),
        ("mm", "m", r"expected a length \[m\], got 'mm'"),
        ("0x10", "1", "unknown unit 'x10'"),
        ("1 2", "1", "unknown unit '2'"),
        (True, "1", "expected a number, got true"),
        (None, "1", "expected a number"),
        ([1.0], "1", "expected a number"),
        ({}, "1", "expected a number"),
        (math.nan, "1", "finite"),
        (-math.inf, "1", "finite"),
        ("nan", "1", "expected a number, got 'nan'"),
        ("inf m", "m", "expected a length"),
        ("1e999", "1", "finite"),
        ("1e99999999999999999999 m", "m", "finite"),
        ("1e308 km", "m", "finite"),
        (10**400, "1", "finite"),
        ("x" * 1000, "1", r"\.\.\."),
    ],
)
def test_what_is_no_finite_quantity_of_the_dimension_is_an_error(value, unit, message):
    with pytest.raises(ValueError, match=message):
        parse_number(value, unit)


def test_a_tiny_number_is_zero_and_not_an_error():
    assert parse_number("1e-99999999999999999999 mm", "m") == 0.0


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("[0.6, 1.3] m", (0.6, 1.3)),
        ("[600,1300]mm", (0.6, 1.3)),
        ("[60 cm, 1300 mm]", (0.6, 1.3)),
        ([0.6, "1300 mm"], (0.6, 1.3)),
        ("[1] m", (1.0,)),
    ],
)
def test_a_list_is_read_from_a_text_or_an_array(value, expected):
    assert parse_numbers(value, "m") == expected


@pytest.mark.parametrize(
    ("value", "count", "message"),
    [
        ("[1, 2] m", 3, "expected 3 numbers, got 2"),
        ([1, 2, 3], 2, "expected 2 numbers, got 3"),
        ("[] m", None, "empty"),
        ([], None, "empty"),
        ("[1, 2] s", None, r"expected a length \[m\], got '1 s'"),
        ("[1, , 2] m", None, "expected a length"),
        ("[1 cm, 2 cm] m", None, "unknown unit 'cm m'"),
        ([1, True], None, "got true"),
        ("1 m", None, "expected a list"),
        (1.0, None, "expected a list"),
    ],
)
def test_a_wrong_list_is_an_error(value, count, message):
    with pytest.raises(ValueError, match=message):
        parse_numbers(value, "m", count=count)


def test_a_range_is_two_ends_or_one_point():
    assert parse_range("[-170, 170] deg", "rad") == pytest.approx(
        (-math.radians(170), math.radians(170))
    )
    assert parse_range([1, 2], "m") == (1.0, 2.0)
    assert parse_range("16 cm", "m") == (0.16, 0.16)
    assert parse_range(0.16, "m") == (0.16, 0.16)
    assert parse_range([1, 1], "m") == (1.0, 1.0)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("[2, 1] m", "empty range"),
        ([1, 2, 3], "expected 2 numbers"),
        ("[1] m", "expected 2 numbers"),
        (True, "got true"),
    ],
)
def test_a_wrong_range_is_an_error(value, message):
    with pytest.raises(ValueError, match=message):
        parse_range(value, "m")


def test_an_unknown_si_unit_is_named_in_the_message():
    with is_refused(ValueError):
        parse_number("1 m", "m^3")
