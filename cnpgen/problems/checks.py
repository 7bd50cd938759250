"""Checks of a problem file across several tables, or against its URDF, and the choice of the robot geometry."""

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from cnpgen.documents import JsonObject
from cnpgen.errors import PluginError, RecipeError, listed, nearest
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.link_clearance import ObjectClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.plausible_values import (
    MAX_LIMIT_RATIO,
    MAX_RANGE_RATIO,
    ImplausibleValue,
)
from cnpgen.robots.robot_spec import LimitSpec
from cnpgen.robots.shape.mesh_files import find_named_file, find_urdf
from cnpgen.robots.urdf import number_in, read_urdf, urdf_tree
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.registry import BUILT_IN, CONSTRAINTS
from cnpgen.schema.units import show
from cnpgen.store.joint_units import units_of_joints

_LIMIT_UNITS = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s^2"}
_XACRO = "{http://www.ros.org/wiki/xacro}"
_NAME_IT = 'name geometry = "paper-capsules" in [robot] for a robot that is a line through its joints\' origins'


@dataclass(frozen=True)
class ProblemTables:
    """Raw tables of a problem file, its location and its folder.

    The URDF is read once.
    """

    table: JsonObject
    where: RecipeLocation
    folder: Path

    @cached_property
    def robot(self) -> JsonObject:
        """The table [robot]; empty if there is none."""
        robot = self.table.get("robot")
        return robot if isinstance(robot, dict) else {}

    @cached_property
    def packages(self) -> list[Path]:
        """Folders in ``packages`` of the table [robot]."""
        named = self.robot.get("packages", [])
        return (
            [self.folder / each for each in named if isinstance(each, str)]
            if isinstance(named, list)
            else []
        )

    @cached_property
    def urdf_path(self) -> Path | None:
        """The URDF; None if it is not named, or in a package that is not installed, which loading the robot reports."""
        urdf = self.robot.get("urdf")
        with suppress(PluginError):
            return (
                find_urdf(urdf, self.folder / "problem.toml", self.packages)
                if isinstance(urdf, str)
                else None
            )
        return None

    @cached_property
    def urdf(self) -> ElementTree.Element | None:
        """The tree of the URDF; None if it cannot be read, which is reported elsewhere."""
        with suppress(RecipeError, ValueError):
            return (
                None if self.urdf_path is None else urdf_tree(read_urdf(self.urdf_path))
            )
        return None

    @cached_property
    def collision_elements(self) -> list[ElementTree.Element] | None:
        """The collision elements of the URDF; None if it cannot be read."""
        return None if self.urdf is None else list(self.urdf.iterfind("link/collision"))

    @cached_property
    def geometry(self) -> str:
        """Geometry of the robot: the named one, or the URDF's if there is an obstacle."""
        named = self.robot.get("geometry")
        if isinstance(named, str):
            return named
        # Without obstacles and self-clearance no distance is measured, so that the
        # collision geometry need not be read.
        something_to_hit = bool(
            tables(self.table, "obstacle") or self.constraints("self-clearance")
        )
        return (
            "urdf" if something_to_hit and self.collision_elements else "paper-capsules"
        )

    def constraints(self, use: str) -> list[tuple[int, JsonObject]]:
        """Return the tables of the constraints of a kind, with their indices."""
        return [
            (place, each)
            for place, each in tables(self.table, "constraint")
            if each.get("use") == use
        ]

    def with_object_clearance(self, problem: Problem) -> tuple[Constraint, ...]:
        """Return all constraints.

        By default, a held object stays clear of links that have geometry.
        """
        if (
            problem.object is None
            or problem.first(ObjectClearance)
            or not self.collision_elements
        ):
            return problem.constraint
        return (*problem.constraint, ObjectClearance())


def problem_errors(raw: ProblemTables) -> Iterator[str]:
    """Check conditions across tables, on the raw tables, so that all errors are reported together."""
    table = raw.table
    where = raw.where
    yield from _robot_errors(raw)
    yield from _repeated(raw, "constraint", "use")
    yield from _repeated(raw, "obstacle", "name")
    uses = {str(each.get("use")) for _, each in tables(table, "constraint")}
    yield from _idle_errors(raw, uses)
    # Built-in constraints that use obstacles; contacts of the held object count only if
    # there is one.
    using = (
        {"robot-clearance", "object-contact"}
        if "object" in table
        else {"robot-clearance"}
    )
    for index, obstacle in tables(table, "obstacle"):
        if index == 0 and uses <= BUILT_IN[CONSTRAINTS].keys() - using:
            # Plug-ins may use them.
            yield (where / "obstacle" / index).message(
                'no constraint uses it: add a [[constraint]] with use = "robot-clearance" and a '
                "tolerance"
            )
        if obstacle.get("below") and "object" not in table:
            yield (where / "obstacle" / index / "below").message(
                "nothing stands on the obstacle: there is no [object]"
            )
    for place, _ in raw.constraints("object-clearance"):
        if "object" not in table:
            yield (where / "constraint" / place).message(
                "object-clearance needs [object], the held object"
            )
        elif raw.collision_elements == []:
            yield (where / "constraint" / place).message(
                "object-clearance needs <collision> elements in the URDF"
            )
    if raw.geometry != "urdf":
        yield from _paper_errors(raw)
    elif raw.collision_elements is not None:
        yield from _shape_errors(raw, raw.collision_elements)


def _idle_errors(raw: ProblemTables, uses: set[str]) -> Iterator[str]:
    """Check that no key replaces another one, and that something may touch the held object."""
    limits = raw.table.get("limits")
    if isinstance(limits, dict) and "acceleration" in limits:
        for key in ("acceleration_rate", "acceleration_cap"):
            if key in limits:
                yield (raw.where / "limits" / key).message(
                    "'acceleration' takes its place: remove one of them"
                )
    # The obstacles may stand below the object, and plug-ins may use it.
    if (
        "object" in raw.table
        and raw.collision_elements == []
        and not raw.table.get("obstacle")
        and uses <= BUILT_IN[CONSTRAINTS].keys()
    ):
        yield (raw.where / "object").message(
            "nothing uses it: there are no obstacles, and the URDF has no <collision> elements"
        )


def _robot_errors(raw: ProblemTables) -> Iterator[str]:
    """Check that the URDF exists and has the joints and the tip.

    Pinocchio checks the rest.
    """
    where = raw.where / "robot"
    path = raw.urdf_path
    if path is None:
        return
    if not os.path.isfile(path):  # noqa: PTH113 - Path.is_file raises where a name is too long
        hint = nearest(
            raw.robot["urdf"], [file.name for file in raw.folder.glob("*.urdf")]
        )
        there = os.path.exists(path)  # noqa: PTH110 - os.path does not raise for odd names
        yield (where / "urdf").message(
            f"not a file: {path}" if there else f"no such file: {path}{hint}"
        )
        return
    if raw.urdf is None:
        # Loading the robot raises the error.
        return
    if text := unread_xacro(raw.urdf, path):
        yield (where / "urdf").message(text)
        return
    yield from _joint_errors(raw, raw.urdf, path)


def _joint_errors(
    raw: ProblemTables, urdf: ElementTree.Element, path: Path
) -> Iterator[str]:
    """Check that the URDF has the joints and the tip, and the places of the other joints."""
    joints = raw.robot.get("joints")
    tip = raw.robot.get("tip")
    locked = raw.robot.get("locked_joints")
    where = raw.where / "robot"
    planned: list[Any] = joints if isinstance(joints, list) else []
    placed = [*planned, *(locked if isinstance(locked, list) else [])]
    # A joint without a type counts as fixed.
    moving = [
        joint.get("name", "")
        for joint in urdf.iter("joint")
        if joint.get("type", "fixed") != "fixed"
    ]
    for name in planned:
        if isinstance(name, str) and name not in moving:
            text = f"no joint {name!r} that moves{nearest(name, moving)}"
            yield (where / "joints").message(f"{path.name} has {text}")
    if isinstance(tip, str) and (text := missing_frame(urdf, path, tip)):
        yield (where / "tip").message(text)
    for name, low, high in _outside_at_zero(urdf.iter("joint"), placed):
        text = f"{name!r} is not planned and stays at zero, which is outside of its limits [{low:g}, {high:g}]"
        yield (where / "joints").message(text)


def _shape_errors(
    raw: ProblemTables, elements: list[ElementTree.Element]
) -> Iterator[str]:
    """Check a robot whose shape is that of the collision elements of its URDF."""
    robot = raw.robot
    where = raw.where / "robot"
    if not elements:
        text = "its links have no <collision> elements, so that it has no shape"
        yield (where / "geometry").message(
            f"the URDF gives no shape: {text}; {_NAME_IT}"
        )
    for place, constraint in raw.constraints("robot-clearance"):
        if "radius" in constraint:
            text = f"the robot has the shape that its URDF gives it, and no radius: leave it out, or {_NAME_IT}"
            yield (raw.where / "constraint" / place / "radius").message(text)
    for package in raw.packages:
        if not package.is_dir():
            yield (where / "packages").message(f"no such folder: {package}")
    meshes = dict.fromkeys(
        mesh.get("filename", "") for each in elements for mesh in each.iter("mesh")
    )
    if robot.get("convex_parts", 1) != 1 and not (meshes or robot.get("visual_links")):
        text = "no <collision> element of the URDF has a mesh to divide"
        yield (where / "convex_parts").message(text)
    # Inline meshes (data:) are in the text itself and need no file.
    for name in (each for each in meshes if not each.startswith("data:")):
        try:
            find_named_file(name, raw.urdf_path or raw.folder, raw.packages)
        except RecipeError as error:
            yield (where / "urdf").message(str(error))
    srdf = robot.get("srdf")
    if isinstance(srdf, str) and srdf and not (raw.folder / srdf).is_file():
        yield (where / "srdf").message(f"no such file: {raw.folder / srdf}")


def _paper_errors(raw: ProblemTables) -> Iterator[str]:
    """Check a robot with the geometry of the paper."""
    robot = raw.robot
    where = raw.where
    for place, constraint in raw.constraints("robot-clearance"):
        if "radius" not in constraint:
            text = 'missing key, expected a length [m]: with geometry = "paper-capsules" the arm is so thick'
            yield (where / "constraint" / place / "radius").message(text)
    for place, _ in raw.constraints("self-clearance"):
        text = 'self-clearance needs geometry = "urdf" in [robot], and <collision> elements'
        yield (where / "constraint" / place).message(text)
    # The links that a held object may not touch have the shape of the URDF anyway.
    shapes = [] if "object" in raw.table else ["visual_links", "skipped_meshes"]
    for key in ("convex_parts", *shapes):
        if robot.get(key) not in (None, [], 1):
            yield (where / "robot" / key).message(
                'meshes matter with geometry = "urdf" only'
            )
    payload = raw.table.get("payload")
    if isinstance(payload, dict) and payload.get("touch_links"):
        text = 'a payload is a body with geometry = "urdf" in [robot] only'
        yield (where / "payload" / "touch_links").message(text)
    for key in ("srdf", "ignored_pairs"):
        if robot.get(key):
            yield (where / "robot" / key).message(
                'pairs of links matter with geometry = "urdf" only'
            )


def limit_errors(problem: Problem, raw: ProblemTables) -> Iterator[str]:
    """Check that no limit exceeds that of the URDF so far that it must be in another unit or in percent."""
    spec = problem.robot
    given = _given_limits(problem.limits)
    if raw.urdf is None:
        # Loading the robot raises the error.
        return
    # Others are of transmissions.
    joints = {joint.get("name"): joint for joint in raw.urdf.findall("joint")}
    try:
        plausible = {
            key: [_plausible_limit(joints[name], key) for name in spec.joints]
            for key in given
        }
    except (ValueError, KeyError):
        # Loading the robot raises the error.
        return
    for key, rows in given.items():
        # One number of a limit holds for all joints.
        per_row = rows * (len(spec.joints) if len(rows) == 1 else 1)
        for name, values, (low, high, unit) in zip(
            spec.joints, per_row, plausible[key], strict=False
        ):
            wrong = next(
                (value for value in values if low < high and not low <= value <= high),
                None,
            )
            if wrong is not None:
                text = f"{name}: {ImplausibleValue(0, 0, wrong, low, high, unit)}"
                if key != "acceleration":
                    text += f" ('{key}_scale' is a fraction of the URDF's limit)"
                yield (raw.where / "limits" / key).message(text)
                break


def _given_limits(limits: LimitSpec) -> dict[str, list[tuple[float, ...]]]:
    """Return the limits that a problem states, one row for all joints or one for each."""
    # Effort is often a placeholder.
    per_joint = {"velocity": limits.velocity, "acceleration": limits.acceleration}
    given: dict[str, list[tuple[float, ...]]] = {
        key: [(value,) for value in limit.values]
        for key, limit in per_joint.items()
        if limit is not None
    }
    if limits.position:
        given["position"] = [(span.low, span.high) for span in limits.position]
    return given


def _plausible_limit(joint: ElementTree.Element, key: str) -> tuple[float, float, str]:
    """Return the ends of the plausible range of a limit, equal where the URDF limits nothing, and the unit."""
    limit = joint.find("limit")
    unit = units_of_joints(_LIMIT_UNITS[key], (joint.get("type") == "prismatic",))
    if key == "position":
        lower, upper = (number_in(limit, end, 0.0) for end in ("lower", "upper"))
        # The range of the URDF, widened about its center: ranges may exceed it, but not
        # as degrees exceed radians.
        center = (lower + upper) / 2
        half = MAX_RANGE_RATIO * (upper - lower) / 2
        return center - half, center + half, unit
    # Accelerations are compared with the default of the problem, a_max = rate * v_max.
    rate = LimitSpec.acceleration_rate if key == "acceleration" else 1.0
    return 0.0, MAX_LIMIT_RATIO * rate * number_in(limit, "velocity", 0.0), unit


def unread_xacro(tree: ElementTree.Element, path: Path) -> str:
    """Return an error message for a xacro file; empty for a URDF."""
    if not any(part.tag.startswith(_XACRO) for part in tree.iter()):
        return ""
    return f"{path.name} is to be read by xacro, expected a URDF: run 'xacro {path.name} > robot.urdf'"


def frames_of(tree: ElementTree.Element) -> list[str]:
    """List the links and then the joints of a URDF: Pinocchio has a frame for each."""
    return [
        part.get("name", "")
        for kind in ("link", "joint")
        for part in tree.findall(kind)
    ]


def missing_frame(tree: ElementTree.Element, path: Path, name: str) -> str:
    """Return an error message for a missing frame, with the known names.

    Empty if the frame exists.
    """
    frames = frames_of(tree)
    if name in frames:
        return ""
    return f"{path.name} has no frame {name!r}{nearest(name, frames)}; its frames: {listed(frames)}"


def _outside_at_zero(
    joints: Iterable[ElementTree.Element], placed: list[Any]
) -> Iterator[tuple[str, float, float]]:
    """Return joints without a position of their own whose limits exclude zero, with the limits.

    Joints that are planned or locked have one. Mimic joints are omitted.
    """
    for joint in joints:
        limit = joint.find("limit")
        name = joint.get("name", "")
        # A mimic joint follows another joint, and continuous joints have no limits.
        movable = (
            joint.get("type") in ("revolute", "prismatic")
            and joint.find("mimic") is None
        )
        if limit is None or not movable or name in placed:
            continue
        # Pinocchio rejects invalid numbers
        with suppress(ValueError):
            low, high = (float(limit.get(key, "0")) for key in ("lower", "upper"))
            if not low <= 0 <= high and low <= high:
                yield name, low, high


def _repeated(raw: ProblemTables, array: str, key: str) -> Iterator[str]:
    seen: list[Any] = []
    for index, entry in tables(raw.table, array):
        # Constraints of links may be of one kind, such as several regions.
        name = entry if "link" in entry else entry.get(key)
        if key in entry and name in seen:
            article = "an" if array[0] in "aeiou" else "a"
            yield (raw.where / array / index / key).message(
                f"there is {article} {array} {show(entry[key])} already: edit that one, or remove one "
                "of them"
            )
        seen.append(name)


def tables(table: JsonObject, array: str) -> list[tuple[int, JsonObject]]:
    """Return the tables among the entries of an array, with their indices."""
    entries = table.get(array)
    return (
        [(i, e) for i, e in enumerate(entries) if isinstance(e, dict)]
        if isinstance(entries, list)
        else []
    )
