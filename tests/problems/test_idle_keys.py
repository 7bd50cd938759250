"""Keys that limit no motion: those that are named change no condition, and every other one changes a condition."""

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import RecipeError
from cnpgen.problems.idle_keys import idle_keys, idle_text
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.drive import DriveSpec
from cnpgen.robots.parameter_ranges import PAYLOAD_PARAMETERS, ParameterRanges
from cnpgen.robots.robot_spec import HeldObject, LimitSources, LimitSpec, Payload
from cnpgen.schema import registry
from cnpgen.schema.catalogue import list_recipes
from cnpgen.schema.keys import keys
from cnpgen.world.world import World
from tests.problems.test_drive import ARM, URDFS
from tests.schema.test_catalogue import Level

HEAD = ARM.partition("[limits]")[0]
KINDS = "position", "velocity", "acceleration", "jerk", "torque"
# Table -> key -> two values; the second one is stated.
VALUES: dict[str, dict[str, tuple[str, str]]] = {
    "limits": {
        "position": (str([[-2, 2]] * 4), str([[-1.5, 1.5]] * 4)),
        "position_scale": ("1", "0.5"),
        "velocity": ("2", "1"),
        "velocity_scale": ("1", "0.5"),
        "acceleration": ("9", "8"),
        "acceleration_rate": ("9", "8"),
        "acceleration_cap": ("9", "8"),
        "jerk": ("90", "80"),
        "torque": ("200", "150"),
        "torque_scale": ("1", "0.5"),
        "soft": ('"use"', '"ignore"'),
    },
    "drive": {
        "urdf_dynamics": ('"ignore"', '"use"'),
        "armature": ("0", "0.5"),
        "rotor_inertia": ("0.01\ngear_ratio = 3", "0.02\ngear_ratio = 3"),
        "gear_ratio": ("3\nrotor_inertia = 0.01", "4\nrotor_inertia = 0.01"),
        "viscous": ("0", "2"),
        "coulomb": ("0", "2"),
        "friction_help": ("0", "0.5\nviscous = 1"),
        "reversal_speed": ("0.05", "1"),
        "limits": ('"both"\narmature = 0.1', '"motor"\narmature = 0.1'),
        "torque": ("200", "150"),
        "power": ("200", "150"),
        "line": (
            "[{ torque = 100, speed = 9 }]",
            "[{ torque = 100, speed = 8 }]",
        ),
    },
    "payload": {
        "mass": ("1", "2"),
        "centre": ("[0, 0, 0]\nmass = 1", "[0.1, 0, 0]\nmass = 1"),
        "inertia": ("[1, 1, 1, 0, 0, 0]\nmass = 1", "[2, 2, 2, 0, 0, 0]\nmass = 1"),
        "size": ("[1, 1, 1]\nmass = 1", "[1, 1, 2]\nmass = 1"),
    },
    "parameters": dict.fromkeys(
        ("velocity_factor", "acceleration_factor", *PAYLOAD_PARAMETERS),
        ("[0.9, 1]", "[0.5, 1]"),
    ),
}
# Keys beside the table of a value, without which it would be refused.
BESIDE = {f"parameters.{name}": "mass = 1" for name in PAYLOAD_PARAMETERS}
BESIDE["parameters.payload_mass"] = "mass = 1\nsize = [1, 1, 1]"
SIDES = (
    "",
    'limits = "joint"',
    'limits = "motor"',
    "viscous = 1",
    'limits = "motor"\ntorque = 99',
)


def problem_of(
    folder: Path, tables: dict[str, str], kind: str, urdf: str = "soft-limits"
) -> Problem:
    """A problem of the arm with one joint limit."""
    tolerance = f'[[constraint]]\nuse = "joint-{kind}"\ntolerance = 1e-3'
    texts = (f"[{name}]\n{text}" for name, text in ({"limits": ""} | tables).items())
    file = folder / "problem.toml"
    head = HEAD.format(urdf=URDFS / f"{urdf}.urdf")
    file.write_text("\n".join([head, *texts, tolerance]))
    return load_problem(file)


def refuses_key(
    folder: Path, tables: dict[str, str], kind: str, key: str, urdf: str = "soft-limits"
) -> bool:
    """Return whether a problem is refused, by the name of a key."""
    with suppress(RecipeError):
        problem_of(folder, tables, kind, urdf)
        return False
    with pytest.raises(RecipeError, match=key):
        problem_of(folder, tables, kind, urdf)
    return True


def values_of(problem: Problem) -> np.ndarray:
    """Values and bounds of all conditions at states of motions; the parameters are at their low ends."""
    robot = load_robot(problem)
    world = World(robot)
    random = np.random.default_rng(0)
    lows = np.array([span.low for span in problem.parameters.ranges])
    found = list[np.ndarray]()
    for q, dq, ddq, jerk in random.uniform(-1, 1, (4, 4, robot.n)):
        world.set_state(q, dq, ddq, lows, jerk)
        for constraint in problem.constraint:
            for each in constraint.measured(world):
                found += [np.array(each.g), each.lower, each.upper]
    return np.concatenate(found)


def cases() -> Iterator[tuple[str, str, str]]:
    for kind in KINDS:
        yield from (
            (kind, "", f"{table}.{key}") for table in VALUES for key in VALUES[table]
        )
    for side in SIDES[1:]:
        names = [f"drive.{key}" for key in VALUES["drive"]]
        yield from (("torque", side, name) for name in (*names, "limits.torque"))


@pytest.mark.parametrize(("kind", "side", "name"), list(cases()))
def test_a_key_is_named_if_and_only_if_it_changes_no_condition(
    tmp_path: Path, kind: str, side: str, name: str
) -> None:
    table, key = name.split(".")
    own = {each.partition(" ")[0] for each in VALUES[table][key][1].split("\n")[1:]}
    beside = [
        line for line in side.split("\n") if line.partition(" ")[0] not in {key, *own}
    ]
    both = []
    for value in VALUES[table][key]:
        drive = {"drive": "\n".join(beside)} if side else {}
        text = "\n".join([*drive.get(table, "").split("\n"), f"{key} = {value}"])
        payload = {"payload": BESIDE[name]} if name in BESIDE else {}
        both.append({**drive, **payload, table: text})
    urdf = "damping" if name == "drive.urdf_dynamics" else "soft-limits"
    if any(refuses_key(tmp_path, tables, kind, key, urdf) for tables in both):
        return
    problems = [problem_of(tmp_path, tables, kind, urdf) for tables in both]
    before, after = map(values_of, problems)
    same = before.shape == after.shape and np.array_equal(before, after)
    assert (name in idle_keys(problems[1])) == same


@pytest.mark.parametrize(
    ("kind", "named"),
    [
        ("self-clearance", {"object", "object.touch_links"}),
        (
            "robot-clearance",
            {"object", "object.touch_links", "robot.srdf", "robot.ignored_pairs"},
        ),
        (
            "object-clearance",
            {
                "robot.geometry",
                "robot.srdf",
                "robot.ignored_pairs",
                "payload.size",
                "payload.touch_links",
            },
        ),
        (
            "object-contact",
            {
                "robot.geometry",
                "robot.srdf",
                "robot.ignored_pairs",
                "robot.convex_parts",
                "robot.decomposed",
                "robot.visual_links",
                "robot.skipped_meshes",
                "object.touch_links",
                "payload.size",
                "payload.touch_links",
            },
        ),
    ],
)
def test_shapes_are_named_if_no_distance_depends_on_them(
    kind: str, named: set[str]
) -> None:
    cup = load_problem("panda-cup")
    links = ("panda_link7",)
    problem = replace(
        cup,
        limits=LimitSpec(),
        drive=DriveSpec(),
        payload=Payload(mass=1.0, size=(0.1, 0.1, 0.1), touch_links=links),
        object=HeldObject(size=(0.1, 0.1, 0.1), touch_links=links),
        robot=replace(
            cup.robot,
            convex_parts=4,
            decomposed=links,
            visual_links=links,
            skipped_meshes=links,
            srdf="arm.srdf",
            ignored_pairs=(("panda_link5", "panda_link7"),),
        ),
        constraint=tuple(
            each
            for each in cup.constraint
            if registry.name_of(registry.CONSTRAINTS, type(each)) == kind
        ),
    )
    assert set(idle_keys(problem)) == named | {"payload.mass"}


def test_every_key_of_limits_drives_and_payloads_has_a_constraint_that_reads_it() -> (
    None
):
    kinds = registry.BUILT_IN[registry.CONSTRAINTS]
    classes = [registry.load(registry.CONSTRAINTS, kind) for kind in kinds]
    read = {key for kind in classes for key in kind.reads}
    tables = {
        "limits": LimitSpec,
        "limits.sources": LimitSources,
        "drive": DriveSpec,
        "payload": Payload,
        "object": HeldObject,
    }
    known = {
        f"{name}.{key.name}" for name, table in tables.items() for key in keys(table)
    }
    # The size of the object is read with the object, the sources one by one.
    assert known - read == {"object.size", "limits.sources"}


def test_every_parameter_is_refused_or_named_without_its_constraint(
    tmp_path: Path,
) -> None:
    for key in keys(ParameterRanges):
        tables = {"parameters": f"{key.name} = [0.1, 0.2]", "payload": "mass = 0.15"}
        if not refuses_key(tmp_path, tables, "position", "parameters"):
            problem = problem_of(tmp_path, tables, "position")
            assert f"parameters.{key.name}" in idle_keys(problem)


def test_a_factor_of_an_inertia_needs_one(tmp_path: Path) -> None:
    for payload, named in (("mass = 1", True), ("mass = 1\nsize = [1, 1, 1]", False)):
        tables = {"payload": payload, "parameters": "payload_inertia = [0.5, 1]"}
        idle = idle_keys(problem := problem_of(tmp_path, tables, "torque"))
        assert ("parameters.payload_inertia" in idle) == named
        whole = replace(problem, parameters=ParameterRanges())
        assert np.array_equal(values_of(problem), values_of(whole)) == named


def test_friction_of_the_urdf_may_be_missing_or_replaced(tmp_path: Path) -> None:
    use = 'urdf_dynamics = "use"'
    with pytest.raises(RecipeError, match="the URDF has no friction to use"):
        problem_of(tmp_path, {"drive": use}, "torque")
    for more, named in (
        ("", False),
        ("viscous = 1", False),
        ("viscous = 1\ncoulomb = 1", True),
    ):
        problem = problem_of(tmp_path, {"drive": f"{use}\n{more}"}, "torque", "damping")
        assert ("drive.urdf_dynamics" in idle_keys(problem)) == named


def test_a_plug_in_without_declared_keys_may_read_all(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, {"limits": "jerk = 9"}, "velocity")
    assert list(idle_keys(problem)) == ["limits.jerk"]
    more = replace(problem, constraint=(*problem.constraint, Level(tolerance=1.0)))
    assert idle_keys(more) == {}


def test_shipped_problems_name_no_key(caplog: pytest.LogCaptureFixture) -> None:
    for name in list_recipes("problem"):
        assert idle_keys(load_problem(name)) == {}
    assert not caplog.records


def test_a_note_names_the_keys_and_their_constraint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tables = {"limits": "jerk = 9\ntorque = 99", "payload": "mass = 1"}
    problem_of(tmp_path, tables, "velocity")
    text = (
        "limits no motion: limits.jerk (no constraint 'joint-jerk');"
        " limits.torque, payload.mass (no constraint 'joint-torque')"
    )
    file = tmp_path / "problem.toml"
    assert idle_text(idle_keys(load_problem(file))) == text
    assert main(["show", str(file)]) == 0
    shown = capsys.readouterr()
    assert shown.err.count(f"cnpgen: {file}: {text}\n") == 1
    assert text in " ".join(shown.out.split())
    assert main(["show", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["idle_keys"] == {
        "limits.jerk": "constraint 'joint-jerk'",
        "limits.torque": "constraint 'joint-torque'",
        "payload.mass": "constraint 'joint-torque'",
    }


def test_verdicts_name_the_keys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem_of(tmp_path, {"limits": "jerk = 9"}, "velocity")
    table = tmp_path / "still.csv"
    rows = np.column_stack([np.arange(5) / 100, np.tile([0, 0.2, -0.6, 0], (5, 1))])
    np.savetxt(table, rows, delimiter=",", header="t,j1,j2,j3,j4", comments="")
    words = ["evaluate", str(table), "--problem", str(tmp_path / "problem.toml")]
    main([*words])
    assert "limits no motion: limits.jerk" in capsys.readouterr().out
    main([*words, "--json"])
    assert list(json.loads(capsys.readouterr().out)["idle_keys"]) == ["limits.jerk"]
