"""Elements of recipes are used, refused or listed, and one of two changes does not hide the other."""

import copy
import json
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin

import numpy as np
import pytest

from cnpgen.errors import CnpgenError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.idle_keys import idle_keys
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.objectives import ObjectiveTerm
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.solid import place_obstacles
from cnpgen.schema import registry
from cnpgen.schema.catalogue import recipes_root
from cnpgen.schema.keys import Key, PerJoint, Range, keys, to_dict
from cnpgen.world.world import World
from tests.examples.example_robots import needs_robots
from tests.problems.test_drive import URDFS

Place = tuple[str | int, ...]
PLAIN: dict[str, Any] = {
    "name": "arm",
    "robot": {
        "urdf": str(URDFS / "soft-limits.urdf"),
        "joints": ["j1", "j2", "j3", "j4"],
        "tip": "tool",
        "base": [0, 0.2, -0.6, 0],
    },
    "limits": {},
    "constraint": [
        {"use": "joint-position", "tolerance": 1e-3},
        {"use": "joint-velocity", "tolerance": 1e-3},
    ],
}
RICH: dict[str, Any] = PLAIN | {
    "robot": PLAIN["robot"] | {"geometry": "urdf"},
    "limits": {"torque_scale": 0.9, "velocity_scale": 0.9},
    "drive": {"viscous": 1.0, "coulomb": 0.5, "armature": 0.1},
    "object": {"size": [0.1, 0.1, 0.1], "touch_links": ["wrist"]},
    "payload": {"mass": 1.0, "size": [0.1, 0.1, 0.1]},
    "parameters": {"payload_mass": [0.5, 1.5]},
    "obstacle": [
        {"name": "post", "position": [0.5, 0.5, 0.2], "size": [0.1, 0.1, 0.4]}
    ],
    "objective": {"centrifugal": 0.01, "term": [{"use": "effort", "weight": 0.5}]},
    "constraint": [
        *PLAIN["constraint"],
        *(
            {"use": name, "tolerance": 1e-3}
            for name in (
                "joint-acceleration",
                "joint-torque",
                "robot-clearance",
                "self-clearance",
            )
        ),
        {"use": "object-contact", "depth": 0.01, "tolerance": 1e-3},
        {"use": "object-clearance", "tolerance": 1e-3},
        {"use": "vertical", "tolerance": 0.01},
    ],
}
ROOTS = {"plain": PLAIN, "rich": RICH}
# Ends of places whose values change names and texts only, or files that are found anyway.
LISTED = {
    "name": "of a problem or an obstacle",
    "title": "text",
    "version": "of the rules of the file",
    "robot.packages": "folders in which files are found",
    "robot.hull_gap": "a measured fraction that is shown",
    "robot.allow_unused": "names that are not read",
    "soft": "of soft limits that the URDF may lack",
    "budget": "of a learned metric",
    "weight": "of the loss in training",
}
# Bounds that some values of the others, or all samples, meet anyway.
THRESHOLDS = {
    "limits.acceleration_cap": "at most the rate times the velocity limit",
    "stage.min_distance": "of start and goal",
    "stage.min_speed": "of a hit",
    "stage.max_step": "of a step of inverse kinematics",
    "stage.judge": "both methods accept the same states of simple shapes",
    "stage.end": "the other end was checked before",
}
KINDS = {
    Constraint: registry.CONSTRAINTS,
    ObjectiveTerm: registry.OBJECTIVES,
    Stage: registry.STAGES,
}


def toml(value: Any) -> str:
    """Return a value as TOML; tables are written inline."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{json.dumps(k)} = {toml(v)}' for k, v in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value)


def write(path: Path, document: Mapping[str, Any]) -> Path:
    path.write_text(
        "\n".join(f"{key} = {toml(value)}" for key, value in document.items())
    )
    return path


def digest(problem: Problem) -> bytes:
    """Return everything that motions and verdicts of a problem depend on, at states near the base."""
    robot = load_robot(problem)
    world = World(robot, problem.obstacle, problem.object_size)
    random = np.random.default_rng(0)
    bottoms = {"start": np.array(0.1), "goal": np.array(0.25)}
    low = [span.low for span in problem.parameters.ranges]
    high = [span.high for span in problem.parameters.ranges]
    found: list[Any] = [robot.home, low, high, robot.joint_names]
    found.append(problem.nominal_parameters)
    phases = np.linspace(0, 1, 3)
    for values in (low, high):
        own = np.full(problem.scene_width - len(values), 0.3)
        placed = place_obstacles(problem.obstacle, bottoms)
        own[: len(placed)] = placed
        poses = np.append(own, values)
        for dq, ddq, jerk in random.uniform(-1, 1, (3, 3, robot.n)):
            q = robot.home + random.uniform(-0.3, 0.3, robot.n)
            world.set_state(q, dq, ddq, poses, jerk)
            found += [world.tip_position, world.tip_rotation]
            for constraint in problem.constraint:
                measured = constraint.measured(world)
                ends = (constraint.measured_at(world, end) for end in ("start", "goal"))
                for each in (*measured, *(entry for end in ends for entry in end)):
                    found += [each.g, each.lower, each.upper, each.unit, each.projected]
                for each in measured:
                    found.append(constraint.allowed(each))
                    found.append(
                        constraint.bound_relaxation(each, phases, world.tip_position)
                    )
    found += [to_dict(problem.objective), to_dict(problem.trajectory)]
    return repr(
        [
            np.array(each).tolist() if not isinstance(each, dict) else each
            for each in found
        ]
    ).encode()


def fields_of(cls: type, place: Place, document: Any) -> Iterator[tuple[Place, Key]]:
    """Yield the keys below a table, with those of the entries that a document has."""
    for key in keys(cls):
        hint = key.hint
        inner = get_args(hint)[0] if get_origin(hint) is tuple else hint
        there = document.get(key.name) if isinstance(document, dict) else None
        yield (*place, key.name), key
        if inner in KINDS:
            for index, entry in enumerate(there or ()):
                kind = registry.load(KINDS[inner], entry["use"])
                yield from fields_of(kind, (*place, key.name, index), entry)
        elif is_dataclass(inner) and inner not in {Range, PerJoint}:
            at = (*place, key.name) if inner is hint else (*place, key.name, 0)
            if inner is hint or there:
                entry = there[0] if inner is not hint else there
                yield from fields_of(inner, at, entry)


def values_of(key: Key) -> list[Any]:
    """Return values of a key: ordinary ones, those at its bounds, and of another type."""
    hint = key.hint
    if key.choices:
        return [*key.choices, "other"]
    scalars: dict[Any, list[Any]] = {
        bool: [True, False],
        int: [0, 1, 2, 9],
        float: [0.0, 0.05, 0.5, 1.0, -1.0],
        str: ["", "j2", "upper", "vendor: page 3"],
        Range: [[0.1, 0.2], 0.15, [0.5, 0.9], [0.2, 0.1]],
        PerJoint: [0.5, 3.0, [1.0, 2.0, 3.0, 4.0], 0.0],
    }
    if hint in scalars:
        return [*scalars[hint], [] if hint is str else "x"]
    args = get_args(hint)
    if get_origin(hint) is tuple:
        count = 4 if args[-1] is Ellipsis else len(args)
        entries = {
            float: [[0.1] * count, [0.0] * count, [0.3, *[0.1] * (count - 1)]],
            str: [["wrist"], ["upper", "lower"], ["j9"], []],
            Range: [[[-1, 1]] * count, [[-0.9, 0.9]] * count],
        }
        return entries.get(args[0], [[], [{}], [["upper", "wrist"]]])
    return [{}, 1]


def changed(document: Mapping[str, Any], place: Place, value: Any) -> dict[str, Any]:
    """Return a document with another value at a place, whose missing tables are made."""
    result = copy.deepcopy(dict(document))
    at: Any = result
    for key in place[:-1]:
        if isinstance(at, dict) and not isinstance(at.get(key), dict | list):
            at[key] = {}
        at = at[key]
    at[place[-1]] = value
    return result


def value_at(document: Any, place: Place, default: Any) -> Any:
    for key in place:
        try:
            document = document[key]
        except (KeyError, IndexError, TypeError):
            return default
    return document


def plain(place: Place) -> str:
    return ".".join(key for key in place if isinstance(key, str))


def is_listed(place: Place) -> bool:
    name = f".{plain(place)}"
    return ".limits.sources." in name or any(name.endswith(f".{end}") for end in LISTED)


@dataclass(frozen=True)
class Result:
    """Everything that depends on a recipe, and the keys that are named as unused; or an error."""

    content: bytes = b""
    named: frozenset[str] = frozenset()
    error: str = ""


def named_keys(problem: Problem) -> Iterator[str]:
    yield from idle_keys(problem)
    for index, each in enumerate(problem.constraint):
        if each.effective_tolerance < each.tolerance:
            yield f"constraint.{index}.tolerance"


def read_problem(path: Path) -> Result:
    problem = load_problem(path)
    return Result(digest(problem), frozenset(named_keys(problem)))


def read_pipeline(path: Path) -> Result:
    """Read a pipeline by its samples and their fields."""
    plans = draw_boundary_problems(path, 100, seed=0)
    arrays = vars(plans.boundary).values()
    return Result(
        repr([None if each is None else each.tolist() for each in arrays]).encode()
    )


def parsed(value: Any) -> Any:
    """Return the number of a text such as "50 ms", or the value."""
    text = value.partition(" ") if isinstance(value, str) else ("", "", "")
    units = {"ms": 1e-3, "cm": 1e-2, "s": 1.0, "m": 1.0, "rad": 1.0}
    with suppress(ValueError):
        return round(float(text[0]) * units.get(text[2], 1.0), 9)
    return value


class Reader:
    """Reads documents, each one once."""

    def __init__(self, folder: Path, document: Mapping[str, Any], kind: type) -> None:
        self.path = folder / "recipe.toml"
        self.document = document
        self.function = {Problem: read_problem, Pipeline: read_pipeline}[kind]
        self.read = cache(self._read)

    def _read(self, text: str) -> Result:
        try:
            return self.function(write(self.path, json.loads(text)))
        except CnpgenError as error:
            return Result(error=str(error))

    def result(self, changes: Mapping[Place, Any]) -> Result:
        document = self.document
        for place, value in changes.items():
            document = changed(document, place, value)
        return self.read(json.dumps(document))

    def outcome(self, place: Place, default: Any, changes: Mapping[Place, Any]) -> str:
        """Return what becomes of one of the changes: refused, used, listed, named, equal or lost."""
        others = {key: value for key, value in changes.items() if key != place}
        before, after = self.result(others), self.result(changes)
        if after.error:
            return "refused"
        if before.content != after.content:
            return "used"
        if is_listed(place):
            return "listed"
        if plain(place) in THRESHOLDS:
            return "not binding"
        if {plain(place), ".".join(map(str, place))} & after.named:
            return "named"
        document = (
            changed(self.document, *next(iter(others.items())))
            if others
            else self.document
        )
        usual = value_at(document, place, default)
        usual = list(usual) if isinstance(usual, tuple) else parsed(usual)
        return "equal" if changes[place] in (usual, [], {}) else "lost"


def changes_of(cls: type, document: Mapping[str, Any]) -> list[tuple[Place, Key, Any]]:
    return [
        (place, key, value)
        for place, key in fields_of(cls, (), document)
        for value in values_of(key)
    ]


CASES = [
    (Problem, "plain", 300),
    pytest.param(Problem, "rich", 1000, marks=pytest.mark.slow),
    (Pipeline, "heavy-object", 100),
    pytest.param(Pipeline, "airhockey-hit", 300, marks=pytest.mark.slow),
    pytest.param(Pipeline, "airhockey-tables", 300, marks=pytest.mark.slow),
    pytest.param(Pipeline, "ur5-wipe", 300, marks=[pytest.mark.slow, needs_robots]),
]


def document_of(kind: type, root: str) -> dict[str, Any]:
    if kind is Problem:
        return ROOTS[root]
    file = recipes_root() / "pipelines" / f"{root}.toml"
    return tomllib.loads(file.read_text(encoding="utf-8"))


@pytest.mark.parametrize(("kind", "root", "count"), CASES)
def test_every_key_is_used_refused_or_listed(
    tmp_path: Path, kind: type, root: str, count: int
) -> None:
    del count
    document = document_of(kind, root)
    reader = Reader(tmp_path, document, kind)
    assert not reader.result({}).error
    outcomes = Counter[str]()
    lost = []
    for place, key, value in changes_of(kind, document):
        outcome = reader.outcome(place, key.default, {place: value})
        outcomes[outcome] += 1
        lost += [f"{place} = {value!r}"] if outcome == "lost" else []
    assert not lost
    assert min(outcomes["refused"], outcomes["used"]) > 15


def pairs_of(
    changes: Sequence[tuple[Place, Key, Any]], count: int, seed: int
) -> Iterator[list[tuple[Place, Key, Any]]]:
    """Yield pairs of changes at two places."""
    random = np.random.default_rng(seed)
    while count:
        first, second = random.choice(len(changes), 2, replace=False).tolist()
        one, other = changes[first][0], changes[second][0]
        # A table takes the place of a key in it.
        if one != other[: len(one)] and other != one[: len(other)]:
            yield [changes[first], changes[second]]
            count -= 1


@pytest.mark.parametrize(("kind", "root", "count"), CASES)
def test_one_of_two_changes_does_not_hide_the_other(
    tmp_path: Path, kind: type, root: str, count: int
) -> None:
    document = document_of(kind, root)
    reader = Reader(tmp_path, document, kind)
    every = changes_of(kind, document)
    # Most values that are refused alone are refused together: one value of ten.
    valid = [each for each in every if not reader.result({each[0]: each[2]}).error]
    outcomes = Counter[str]()
    lost = []
    pool = [*valid * (9 * len(every) // len(valid)), *every]
    for pair in pairs_of(pool, count, seed=4):
        changes = {place: value for place, _, value in pair}
        for place, key, _ in pair:
            outcome = reader.outcome(place, key.default, changes)
            outcomes[outcome] += 1
            lost += [f"{place} of {changes}"] if outcome == "lost" else []
    assert not lost
    assert min(outcomes["refused"], outcomes["used"]) > 15
