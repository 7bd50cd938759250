"""The three recipe files of an arm, with comments: findings about the arm, and an explanation of every key."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

from cnpgen.addons.init.arm import Arm
from cnpgen.addons.init.initial_recipes import InitialProblem
from cnpgen.addons.init.link_overlaps import MAX_PAIR_GAP, LinkOverlaps
from cnpgen.addons.init.stated_sources import INITIAL_JERK_RATE, PLACEHOLDERS
from cnpgen.addons.manual.describe import link_rows, pair_rows, with_units
from cnpgen.addons.manual.describe_keys import GROUPS, is_array, kind_summary, part_of
from cnpgen.cli.terminal import table
from cnpgen.documents import JsonMapping, JsonObject, Names, TextRows
from cnpgen.errors import counted
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.problems.load_robot import load_robot
from cnpgen.robots.robot import Robot
from cnpgen.schema import registry
from cnpgen.schema.keys import Key, PerJoint, Range, keys
from cnpgen.store.joint_units import units_of_joints

RECIPE_LINE_WIDTH = 118
NOTHING = "..."  # for people to fill in

FILES = ("problem.toml", "pipeline.toml", "dataset.toml")

_UNITS = 'A number without a unit is in SI; "20 ms", "[-170, 170] deg" or "5 %" is converted.'
_KEYS = "Every key is explained above it; one that is left out stands there as a comment. All keys, and all kinds of"
_WHERE = "constraints and stages: 'cnpgen show --keys'."


def problem_text(initial: InitialProblem, folder: Path) -> str:
    """Write the problem of an arm in a folder, with findings about the arm."""
    problem = initial.problem
    arm = initial.arm
    places: JsonObject = {"robot.urdf": _from(folder, problem.robot.urdf)}
    places["robot.packages"] = tuple(
        _from(folder, each) for each in problem.robot.packages
    )
    if arm.friction:
        # Stated although "ignore" is the default.
        places["drive.urdf_dynamics"] = problem.drive.urdf_dynamics
    if problem.robot.srdf:
        places["robot.srdf"] = _from(folder, problem.robot.srdf)
    head = [
        *_head(f"What a valid motion of {arm.urdf.name} is."),
        "#",
        *_about(initial, load_robot(problem)),
    ]
    return "\n".join([*head, "", recipe_text(problem, places, _notes(arm))])


def sampling_texts(recipe: DatasetRecipe, share: float) -> dict[str, str]:
    """Write the pipeline and the dataset of an arm, with the share of accepted candidates: file name -> text."""
    comments = {
        "stage.0.start": f"Found by sampling: of the draws {100 * share:.0f} % become samples.",
        "stage.1.guess": "About the base configuration of the problem.",
    }
    pipeline = _head(
        "How starts and goals are drawn: positions, and joint angles that reach them."
    )
    pipeline += ["", recipe_text(recipe.pipeline, {"problem": FILES[0]}, comments)]
    dataset = _head("How many samples there are, from which seed, split how.")
    dataset += ["", recipe_text(recipe, {"pipeline": FILES[1]}, {})]
    return {FILES[1]: "\n".join(pipeline), FILES[2]: "\n".join(dataset)}


def _from(folder: Path, path: str) -> str:
    """Return a path as the recipes name it."""
    return os.path.relpath(path, folder.absolute())


def _head(title: str) -> list[str]:
    return [f"# {title}", f"# {_KEYS}", f"# {_WHERE}", f"# {_UNITS}"]


def _notes(arm: Arm) -> Mapping[str, str]:
    """Say which values were put in the place of missing ones, and how others were found."""
    base = "Found by sampling: in front of the robot, far from its limits, with high manipulability."
    jerk = f"{INITIAL_JERK_RATE:.0f}/s times the acceleration limits; a Franka Research 3 has 500/s. Look them up."
    notes = {"robot.home": base, "limits.jerk": jerk}
    for what, instead in PLACEHOLDERS.items():
        without = [joint.name for joint in arm.planned if what in joint.missing]
        if without:
            notes[f"limits.{what}"] = (
                f"The URDF has none for {', '.join(without)}: put in: {instead}. Look them up."
            )
    return notes


def _about(initial: InitialProblem, robot: Robot) -> Iterator[str]:
    """Say what was found out about an arm."""
    arm = initial.arm
    yield f"# What was found in {arm.urdf.name}"
    yield "#"
    yield from table(list(_joint_rows(arm)), indent="#   ", right=(2, 3, 4))
    yield "#"
    yield from table(_facts(arm, robot), indent="#   ")
    for note in initial.notes:
        yield "#"
        yield from wrap(
            note,
            RECIPE_LINE_WIDTH,
            initial_indent="#   - ",
            subsequent_indent="#     ",
        )
    if robot.shape is not None:
        title = "Links: solvers use capsules around them, judges their convex parts"
        yield from _titled(title, link_rows(robot.shape), range(1, 6))
        title = "Pairs of links, by random states"
        yield from _titled(title, pair_rows(robot.shape), (2, 3))
    if initial.overlaps and (rows := _gap_rows(initial.overlaps)):
        title = (
            "Links that overlap by their convex hulls or parts, but not by their meshes"
        )
        yield from _titled(title, rows, (2, 3, 4, 5))


def _titled(title: str, rows: TextRows, right: Sequence[int]) -> Iterator[str]:
    """Yield a table below its title, with the columns that are aligned to the right."""
    yield from ("#", f"#   {title}", "#")
    yield from table(rows, indent="#   ", right=right)


def _facts(arm: Arm, robot: Robot) -> list[tuple[str, str]]:
    """Return what was found out about joints, masses, frames and link geometry."""
    heavy = [link for link in arm.moved if arm.masses.get(link)]
    light = [link for link in arm.moved if not arm.masses.get(link)]
    mass = sum(arm.masses[link] for link in heavy)
    elsewhere = " or at 'locked_positions'" if arm.locked_positions else ""
    facts = [
        (
            "locked",
            f"joints that are not planned and stay at zero{elsewhere}: {', '.join(arm.locked) or 'none'}",
        )
    ]
    facts += [
        (
            "mass",
            f"{mass:.4g} kg in {counted(len(heavy), 'moving link')}; "
            f"moving links without mass: {', '.join(light) or 'none'}",
        )
    ]
    if not robot.chain.joints[-1].mass:
        facts += [
            (
                "torque",
                "the last joint moves nothing that has a mass, so that 'joint-torque' is left out",
            )
        ]
    facts += [("frames", ", ".join(arm.frames))]
    if robot.shape is None:
        facts += [
            (
                "shape",
                "no link that moves has a <collision> element, so that 'self-clearance' is left out",
            )
        ]
    return facts


def _gap_rows(overlaps: LinkOverlaps) -> TextRows:
    """List the pairs with a gap: shares of random states, and of those that all meshes accept."""
    hulls = {(pair.first, pair.second): pair for pair in overlaps.hulls.pairs}
    rows = [
        (
            *pair,
            f"{hulls[pair].parts:.2%}",
            f"{after.parts:.2%}",
            f"{after.meshes:.2%}",
            f"{after.rejected:.2%}",
        )
        for after in overlaps.parts.pairs
        if (pair := (after.first, after.second)) in hulls
        and hulls[pair].rejected > MAX_PAIR_GAP
    ]
    head = (
        "links",
        "",
        "hulls overlap",
        "parts overlap",
        "meshes overlap",
        "free states rejected",
    )
    return [head, *rows] if rows else []


def _joint_rows(arm: Arm) -> Iterator[Names]:
    prismatic = tuple(joint.kind == "prismatic" for joint in arm.planned)
    limits = {
        ("position", "rad"): [
            f"{joint.lower:.4g} to {joint.upper:.4g}" for joint in arm.planned
        ],
        ("velocity", "rad/s"): [f"{joint.velocity:.4g}" for joint in arm.planned],
        ("torque", "N m"): [f"{joint.effort:.4g}" for joint in arm.planned],
    }
    columns = [
        (name, *with_units(units_of_joints(unit, prismatic), cells))
        for (name, unit), cells in limits.items()
    ]
    yield from zip(
        ("joint", "", *(joint.name for joint in arm.planned)),
        ("type", "", *(joint.kind for joint in arm.planned)),
        *columns,
        ("not in the URDF", "", *(", ".join(joint.missing) for joint in arm.planned)),
        strict=True,
    )


def recipe_text(recipe: Any, values: JsonMapping, notes: Mapping[str, str]) -> str:
    """Write a problem, pipeline or dataset, with other values of keys, such as "robot.urdf", and notes on keys."""
    return "\n".join(_Writer(values, notes).table(type(recipe), recipe, "")) + "\n"


@dataclass(frozen=True)
class _Writer:
    """Writes tables, with values and notes as ``recipe_text`` has them.

    What is left out has ``# `` before it.
    """

    values: JsonMapping
    notes: Mapping[str, str]

    def table(self, cls: type, table: Any, path: str) -> Iterator[str]:
        """Write the keys of a table, those that hold tables last.

        Without a table, all as left out.
        """
        below = list[str]()
        for key in keys(cls):
            name = f"{path}.{key.name}" if path else key.name
            part = part_of(key)
            value = getattr(table, key.name, None)
            if part is None:
                yield from self.key(key, table, name)
            elif is_array(key):
                for at, item in enumerate(value or (None,)):
                    below += ["", *self.entry(part, item, f"{name}.{at}")]
            else:
                below += [
                    "",
                    *_comment(kind_summary(part)),
                    _unless(value, f"[{name}]"),
                ]
                below += self.table(part, value, name)
        yield from below

    def entry(self, cls: type, item: Any, path: str) -> Iterator[str]:
        """Write one of several tables of the same name.

        Without one, how it would be written.
        """
        kind = cls if item is None else type(item)
        yield from _comment(kind_summary(kind))
        yield _unless(item, f"[[{path.rpartition('.')[0]}]]")
        if cls in GROUPS:
            names = registry.names(GROUPS[cls])
            yield (
                f'# use = "{names[0]}"'
                if item is None
                else f'use = "{registry.name_of(GROUPS[cls], kind)}"'
            )
        yield from self.table(kind, item, path)

    def key(self, key: Key, table: Any, name: str) -> Iterator[str]:
        """Write a key below what it means.

        As left out where it is at its default, or of a table that is left out.
        """
        value = self.values.get(
            name, getattr(table, key.name, None if key.required else key.default)
        )
        given = table is not None and (
            key.required or value != key.default or self.values.get(name)
        )
        note = f". {self.notes[name]}" if name in self.notes else ""
        yield from _comment(
            f"{key.doc}{note}" if given else f"{key.doc} ({key.expected}){note}"
        )
        yield _unless(given, f"{key.name} = {toml(value) or NOTHING}")


def _unless(given: Any, line: str) -> str:
    """Return a line, as left out unless something is given."""
    return line if given else f"# {line}"


def _comment(text: str) -> list[str]:
    return wrap(
        text,
        RECIPE_LINE_WIDTH,
        initial_indent="# ",
        subsequent_indent="# ",
        break_on_hyphens=False,
    )


def toml(value: Any) -> str:
    """Write a value as TOML; nothing where there is none."""
    if isinstance(value, Range):
        return toml((value.low, value.high))
    if isinstance(value, PerJoint):
        return toml(value.values if len(value.values) > 1 else value.values[0])
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml, value))}]" if value else ""
    if isinstance(value, dict):
        return (
            f"{{ {', '.join(f'{name} = {entry}' for name, entry in value.items())} }}"
        )
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False) if value else ""
    return repr(value) if isinstance(value, int | float) else ""
