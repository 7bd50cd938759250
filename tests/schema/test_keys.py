"""Dataclasses from TOML tables."""

import json
import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from cnpgen.schema.keys import Range, RecipeLocation, field, keys, to_dict
from cnpgen.schema.parsing import parse


@dataclass(frozen=True, kw_only=True)
class Wheel:
    radius: float = field("radius of the wheel", unit="m", low=0.01, high=1.0)
    spokes: int = field("spokes", default=32, low=3, high=64)


@dataclass(frozen=True, kw_only=True)
class Cart:
    name: str = field("name of the cart", pattern="^[a-z]+$")
    front: Wheel = field("the front wheel", default=Wheel(radius=0.5))
    wheel: tuple[Wheel, ...] = field("the other wheels", default=())
    spare: Wheel | None = field("the spare wheel", default=None)
    braked: bool = field("whether it has brakes", default=False)
    colour: str = field("colour", default="red", choices=("red", "green"))
    tilt: Range = field("tilt", unit="rad", default=Range(0.0, 0.0), low=-1.0, high=1.0)
    stops: tuple[Range, ...] = field("where it stops", unit="m", default=())
    box: tuple[Range, Range] = field(
        "where it may be: x, y", unit="m", default=(Range(0.0, 1.0), Range(0.0, 1.0))
    )
    angles: tuple[float, ...] = field("steering angles", unit="rad", default=())
    size: tuple[float, float, float] = field(
        "size", unit="m", default=(1.0, 1.0, 1.0), low=1e-3
    )
    riders: tuple[str, ...] = field("who rides", default=())
    load: float | None = field("load", unit="kg", default=None)
    seats: dict[str, int] = field(
        "seats per row", default=None, low=1, pattern="^[a-z]+$"
    )
    path: Path = Path()
    digest: str = ""

    def validate(self) -> Iterator[tuple[str, str]]:
        if self.load is not None and self.load > 100 and not self.braked:
            yield "load", "a heavy cart needs brakes"


def read(text: str) -> tuple[Cart | None, list[str]]:
    errors: list[str] = []
    return parse(
        Cart, tomllib.loads(text), where=RecipeLocation("cart.toml"), errors=errors
    ), errors


def errors_of(text: str) -> list[str]:
    cart, errors = read('name = "cart"\n' + text)
    assert cart is None
    return errors


FULL = """
name = "cart"
braked = true
colour = "green"
tilt = "[-5, 30] deg"
stops = ["[0, 100] mm", [1, 2], "3 m"]
angles = "[10, 20] deg"
box = ["[0, 1] m", [2, 3]]
size = ["10 cm", 0.2, 0.3]
riders = ["ann", "bob"]
load = "500 g"
front = { radius = "40 cm" }
spare = { radius = 0.5, spokes = 8 }
seats = { back = 2, front = 1 }
[[wheel]]
radius = "0.1 m"
[[wheel]]
radius = "0.2 m"
spokes = 16
"""


def test_every_supported_type_is_read_in_si():
    cart, errors = read(FULL)
    assert errors == []
    assert cart == Cart(
        name="cart",
        braked=True,
        colour="green",
        tilt=Range(pytest.approx(math.radians(-5)), pytest.approx(math.radians(30))),
        stops=(Range(0.0, 0.1), Range(1.0, 2.0), Range(3.0, 3.0)),
        box=(Range(0.0, 1.0), Range(2.0, 3.0)),
        angles=(pytest.approx(math.radians(10)), pytest.approx(math.radians(20))),
        size=(0.1, 0.2, 0.3),
        riders=("ann", "bob"),
        load=0.5,
        front=Wheel(radius=0.4),
        spare=Wheel(radius=0.5, spokes=8),
        seats={"back": 2, "front": 1},
        wheel=(Wheel(radius=0.1), Wheel(radius=0.2, spokes=16)),
    )


def test_absent_keys_have_their_defaults():
    cart, errors = read('name = "cart"')
    assert (cart, errors) == (Cart(name="cart"), [])


def test_every_mistake_is_reported_with_file_and_key():
    _, errors = read(
        """
        nam = "cart"
        braked = 1
        colour = "gren"
        tilt = "[2, -2] rad"
        size = "[1, 2] m"
        riders = ["ann", 7]
        load = "5 m"
        front = { spokes = 2 }
        [[wheel]]
        radius = "2 m"
        [[wheel]]
        radius = 0.1
        spoke = 3
        """
    )
    assert errors == [
        "cart.toml: nam: unknown key (did you mean 'name'?)",
        "cart.toml: name: missing key, expected a string: name of the cart",
        "cart.toml: front.radius: missing key, expected a length [m]: radius of the wheel",
        "cart.toml: front.spokes: 2 is too small, expected at least 3",
        "cart.toml: wheel 1.radius: 2.0 m is too large, expected at most 1 m",
        "cart.toml: wheel 2.spoke: unknown key (did you mean 'spokes'?)",
        "cart.toml: braked: expected true or false, got 1",
        "cart.toml: colour: expected one of 'red', 'green', got 'gren' (did you mean 'green'?)",
        "cart.toml: tilt: empty range '[2, -2] rad': its low end is above its high end",
        "cart.toml: size: expected 3 numbers, got 2: '[1, 2] m'",
        "cart.toml: riders 2: expected a string, got 7",
        "cart.toml: load: expected a mass [kg], got '5 m'",
    ]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("xyzzy = 1", "xyzzy: unknown key, known: name, front, wheel"),
        ('"a b" = 1', '"a b": unknown key'),
        ("path = 'x'", "path: unknown key"),
        ("digest = 'x'", "digest: unknown key"),
        ("load = true", "load: expected a mass [kg], got true"),
        ("load = nan", "load: expected a mass [kg] that is finite, got nan"),
        ("load = 'heavy'", "load: expected a mass [kg], got 'heavy'"),
        ("load = 1979-05-27", "load: expected a mass [kg], got "),
        ("load = 200", "load: a heavy cart needs brakes"),
        ("tilt = [-2, 0]", "tilt: -2.0 rad is too small, expected at least -1 rad"),
        ("tilt = [0, 2]", "tilt: 2.0 rad is too large, expected at most 1 rad"),
        ("tilt = [0, 0.5, 1]", "tilt: expected 2 numbers, got 3"),
        ("stops = [0, 1]", "stops: expected a list of ranges, got [0, 1]"),
        (
            "stops = '[0, 1] m'",
            "stops: expected a list, each a range, each end a length [m], got '[0, 1] m'",
        ),
        ("stops = [[0, 1], [3, 2]]", "stops 2: empty range [3, 2]"),
        ("stops = []", "stops: is empty, expected at least one: where it stops"),
        ("box = [[0, 1]]", "box: expected 2 entries, got 1: [[0, 1]]"),
        ("box = [[0, 1], [0, 1], [0, 1]]", "box: expected 2 entries, got 3"),
        ("angles = []", "angles: is empty"),
        ("angles = 1", "angles: expected a list, each an angle [rad], got 1"),
        ("size = [1, 1, 0]", "size: 0.0 m is too small"),
        ("riders = []", "riders: is empty"),
        ("riders = 'ann'", "riders: expected a list, each a string, got 'ann'"),
        ("wheel = []", "wheel: is empty"),
        ("wheel = 3", "wheel: expected a list, each a table, got 3"),
        ("wheel = [3]", "wheel 1: expected a table, got 3"),
        ("front = 3", "front: expected a table, got 3"),
        (
            "front = {radius = 1, spokes = 8.0}",
            "front.spokes: expected an integer, got 8.0",
        ),
        (
            "front = {radius = 1, spokes = true}",
            "front.spokes: expected an integer, got true",
        ),
        (
            "front = {radius = 1, spokes = 65}",
            "front.spokes: 65 is too large, expected at most 64",
        ),
        ("braked = 'yes'", "braked: expected true or false, got 'yes'"),
        ("colour = 3", "colour: expected a string, got 3"),
        ("seats = {}", "seats: is empty"),
        ("seats = 3", "seats: expected a table of integers, got 3"),
        ("seats = {back = 0}", "seats.back: 0 is too small, expected at least 1"),
        ("seats = {back = 1.5}", "seats.back: expected an integer, got 1.5"),
        ("seats = {Back = 1}", "seats.Back: the name 'Back' does not match ^[a-z]+$"),
    ],
)
def test_a_wrong_value_is_a_mistake(text, error):
    errors = errors_of(text)
    assert len(errors) == 1
    assert errors[0].startswith(f"cart.toml: {error}")


@pytest.mark.parametrize(
    "text",
    [
        "tilt = [-1, 1]",
        "front = {radius = 0.01, spokes = 3}",
        "front = {radius = 1.0, spokes = 64}",
        "size = '[1, 1, 1] mm'",
        "seats = {back = 1}",
        "load = 100",
        "load = 200\nbraked = true",
    ],
)
def test_a_value_on_its_bound_is_accepted(text):
    cart, errors = read('name = "cart"\n' + text)
    assert cart is not None
    assert errors == []


def test_a_string_must_match_its_pattern():
    assert read('name = "Cart"')[1] == [
        "cart.toml: name: 'Cart' does not match ^[a-z]+$: name of the cart"
    ]


def test_what_is_not_a_table_is_a_mistake():
    errors: list[str] = []
    assert parse(Cart, 3, where=RecipeLocation("cart.toml"), errors=errors) is None
    assert errors == ["cart.toml: expected a table, got 3"]


def test_a_value_error_of_the_constructor_is_a_mistake():
    @dataclass(frozen=True)
    class Picky:
        even: int = field("an even number")

        def __post_init__(self) -> None:
            if self.even % 2:
                raise ValueError(f"{self.even} is odd")

    errors: list[str] = []
    assert parse(Picky, {"even": 2}, where=RecipeLocation("f"), errors=errors) == Picky(
        2
    )
    assert parse(Picky, {"even": 3}, where=RecipeLocation("f"), errors=errors) is None
    assert errors == ["f: 3 is odd"]


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("load = 200\ncolour = 'gren'", ["colour", "load"]),
        ("load = 200\nwheel = [{radius = 2}]", ["wheel 1.radius", "load"]),
        ("load = 200\nbraked = 3", ["braked"]),
        ("load = 'x'\nbraked = 3", ["braked", "load"]),
        ("load = 200\nxyzzy = 1", ["xyzzy", "load"]),
    ],
)
def test_what_a_dataclass_checks_itself_is_checked_as_far_as_other_mistakes_let_it(
    text, keys
):
    assert [error.split(": ")[1] for error in errors_of(text)] == keys


def test_a_type_that_recipes_cannot_hold_is_a_mistake():
    @dataclass(frozen=True)
    class Odd:
        when: complex = field("a complex number")

    errors: list[str] = []
    assert parse(Odd, {"when": 2}, where=RecipeLocation("f"), errors=errors) is None
    assert "not one that a recipe can hold" in errors[0]


def test_a_reader_replaces_the_table_of_a_type():
    def by_size(value, where, errors):
        if value != "big":
            errors.append(where.message("no such size"))
            return None
        return Wheel(radius=1.0)

    errors: list[str] = []
    table = {"name": "cart", "front": "big", "wheel": ["big", "small"]}
    assert (
        parse(
            Cart,
            table,
            where=RecipeLocation("f"),
            errors=errors,
            readers={Wheel: by_size},
        )
        is None
    )
    assert errors == ["f: wheel 2: no such size"]
    table["wheel"] = ["big"]
    cart = parse(
        Cart, table, where=RecipeLocation("f"), errors=[], readers={Wheel: by_size}
    )
    assert cart is not None
    assert (cart.front, cart.wheel) == (Wheel(radius=1.0), (Wheel(radius=1.0),))


def test_earlier_mistakes_do_not_spoil_a_correct_table():
    assert parse(
        Wheel, {"radius": 0.5}, where=RecipeLocation("f"), errors=["something else"]
    ) == Wheel(radius=0.5)


def test_keys_lists_what_a_table_may_hold():
    listed = {key.name: key for key in keys(Cart)}
    assert "path" not in listed
    assert "digest" not in listed
    assert listed["name"].required
    assert not listed["load"].required
    assert listed["load"].hint is float
    assert listed["load"].unit == "kg"
    assert listed["load"].doc == "load"
    assert [
        listed[name].expected
        for name in ("name", "front", "wheel", "braked", "colour", "tilt")
    ] == [
        "a string",
        "a table",
        "a list, each a table",
        "true or false",
        "one of 'red', 'green'",
        "a range, each end an angle [rad]",
    ]
    assert listed["size"].expected == "a list of 3, each a length [m]"
    assert listed["seats"].expected == "a table of integers"


def test_to_dict_is_plain_json_and_reads_back_as_the_same_object():
    cart, _ = read(FULL)
    plain = to_dict(cart)
    assert json.loads(json.dumps(plain)) == plain
    assert plain["stops"] == [[0.0, 0.1], [1.0, 2.0], [3.0, 3.0]]
    assert "path" not in plain
    assert parse(Cart, plain, where=RecipeLocation("f"), errors=[]) == cart


def test_to_dict_labels_nested_objects():
    labelled = to_dict(
        Cart(name="cart"),
        label=lambda obj: {"use": "wheel"} if isinstance(obj, Wheel) else {},
    )
    assert labelled["front"] == {"use": "wheel", "radius": 0.5, "spokes": 32}
    assert "use" not in labelled


def test_a_place_names_file_and_key():
    assert (RecipeLocation("f") / "robot" / "base").message("x") == "f: robot.base: x"
    assert (RecipeLocation("f") / "stage" / 3 / "cone").message(
        "x"
    ) == "f: stage 4.cone: x"
    assert RecipeLocation("f").message("x") == "f: x"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (
            "angles = [10, 45]",
            "angles: 45.0 rad is too large, expected at most 25.13 rad; 45 rad is 2578 deg; did you",
        ),
        (
            "angles = [-90]",
            "angles: -90.0 rad is too small, expected at least -25.13 rad; -90 rad is -5157 deg; did",
        ),
        (
            "stops = [[0, 250]]",
            "stops 1: 250.0 m is too large, expected at most 100 m; did you mean 250 mm = 0.25 m?",
        ),
        (
            "load = 12000",
            "load: 12000.0 kg is too large, expected at most 2500 kg; did you mean 12000 g = 12 kg?",
        ),
        (
            "tilt = [0, 30]",
            "tilt: 30.0 rad is too large, expected at most 1 rad; 30 rad is 1719 deg; did you mean 30",
        ),
    ],
)
def test_values_that_are_probably_in_another_unit_have_a_suggestion(text, error):
    (found,) = errors_of(text)
    assert found.startswith(f"cart.toml: {error}")
    assert "did you mean" in found
