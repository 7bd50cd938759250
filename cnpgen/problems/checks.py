"""Checks of a problem file across several tables, or against its URDF."""

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from cnpgen.errors import PluginError, RecipeError, listed, nearest
from cnpgen.problems.problem import Problem
from cnpgen.robots.plausible_values import MAX_LIMIT_RATIO, MAX_RANGE_RATIO, ImplausibleValue
from cnpgen.robots.robot_spec import LimitSpec
from cnpgen.robots.shape.mesh_files import find_urdf
from cnpgen.robots.urdf import number_in, read_urdf, urdf_tree
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.registry import BUILT_IN, CONSTRAINTS
from cnpgen.schema.units import show
from cnpgen.store.joint_units import units_of_joints

_LIMIT_UNITS = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s^2"}
_XACRO = "{http://www.ros.org/wiki/xacro}"


def problem_mistakes(table: dict[str, Any], where: RecipeLocation, folder: Path) -> Iterator[str]:
    """Check conditions across tables, on the raw tables, so that all mistakes are reported together."""
    robot = table.get("robot")
    if isinstance(robot, dict):
        yield from _robot_mistakes(robot, where / "robot", folder)
    yield from _repeated(table, where, "constraint", "use")
    yield from _repeated(table, where, "obstacle", "name")
    uses = {str(each.get("use")) for _, each in tables(table, "constraint")}
    using = {"robot-clearance", "object-contact"} if "object" in table else {"robot-clearance"}
    for index, obstacle in tables(table, "obstacle"):
        if index == 0 and uses <= BUILT_IN[CONSTRAINTS].keys() - using:  # plug-ins may use them
            text = 'no constraint uses it: add a [[constraint]] with use = "robot-clearance" and a tolerance'
            yield (where / "obstacle" / index).message(text)
        if obstacle.get("below") and "object" not in table:
            yield (where / "obstacle" / index / "below").message("nothing stands on the obstacle: there is no [object]")


def _robot_mistakes(robot: dict[str, Any], where: RecipeLocation, folder: Path) -> Iterator[str]:
    """Check that the URDF exists and has the joints and the tip; Pinocchio checks the rest."""
    urdf, joints, tip = robot.get("urdf"), robot.get("joints"), robot.get("tip")
    if not isinstance(urdf, str):
        return
    try:
        path = find_urdf(urdf, folder / "problem.toml", named_packages(robot, folder))
    except PluginError:  # a problem can be listed without its robot; loading the robot raises the error
        return
    if not os.path.isfile(path):  # noqa: PTH113 - Path.is_file raises where a name is too long
        hint = nearest(urdf, [file.name for file in folder.glob("*.urdf")])
        there = os.path.exists(path)  # noqa: PTH110 - os.path does not raise for odd names
        yield (where / "urdf").message(f"not a file: {path}" if there else f"no such file: {path}{hint}")
        return
    try:
        tree = urdf_tree(read_urdf(path))
    except (RecipeError, ValueError):  # loading the robot raises the error
        return
    if text := unread_xacro(tree, path):
        yield (where / "urdf").message(text)
        return
    moving = [joint.get("name", "") for joint in tree.iter("joint") if joint.get("type", "fixed") != "fixed"]
    for name in joints if isinstance(joints, list) else ():
        if isinstance(name, str) and name not in moving:
            yield (where / "joints").message(f"{path.name} has no joint {name!r} that moves{nearest(name, moving)}")
    if isinstance(tip, str) and (text := missing_frame(tree, path, tip)):
        yield (where / "tip").message(text)
    for name, low, high in _locked_outside(tree.iter("joint"), joints if isinstance(joints, list) else []):
        text = f"{name!r} is not planned and stays at zero, which is outside of its limits [{low:g}, {high:g}]"
        yield (where / "joints").message(text)


def limit_mistakes(problem: Problem, where: RecipeLocation) -> Iterator[str]:
    """Check that no limit exceeds that of the URDF so far that it must be in another unit or in percent."""
    spec, limits = problem.robot, problem.limits
    per_joint = {"velocity": limits.velocity, "acceleration": limits.acceleration}  # effort is often a placeholder
    given: dict[str, list[tuple[float, ...]]] = {}
    given |= {key: [(value,) for value in limit.values] for key, limit in per_joint.items() if limit is not None}
    given |= {"position": [(span.low, span.high) for span in limits.position]} if limits.position else {}
    try:
        urdf = urdf_tree(read_urdf(problem.urdf_path)).iter("joint") if given else ()
        joints = {joint.get("name"): joint for joint in urdf}
        plausible = {key: [_plausible_limit(joints[name], key) for name in spec.joints] for key in given}
    except (PluginError, RecipeError, ValueError, KeyError):  # loading the robot raises the error
        return
    for key, rows in given.items():
        per_row = rows * (len(spec.joints) if len(rows) == 1 else 1)
        for name, values, (low, high, unit) in zip(spec.joints, per_row, plausible[key], strict=False):
            wrong = next((value for value in values if low < high and not low <= value <= high), None)
            if wrong is not None:
                text = f"{name}: {ImplausibleValue(0, 0, wrong, low, high, unit)}"
                hint = "" if key == "acceleration" else f" ('{key}_scale' is a fraction of the URDF's limit)"
                yield (where / "limits" / key).message(text + hint)
                break


def _plausible_limit(joint: ElementTree.Element, key: str) -> tuple[float, float, str]:
    """Return the ends of the plausible range of a limit, equal where the URDF limits nothing, and the unit."""
    limit, unit = joint.find("limit"), units_of_joints(_LIMIT_UNITS[key], (joint.get("type") == "prismatic",))
    if key == "position":
        lower, upper = (number_in(limit, end, 0.0) for end in ("lower", "upper"))
        center, half = (lower + upper) / 2, MAX_RANGE_RATIO * (upper - lower) / 2
        return center - half, center + half, unit
    rate = LimitSpec.acceleration_rate if key == "acceleration" else 1.0
    return 0.0, MAX_LIMIT_RATIO * rate * number_in(limit, "velocity", 0.0), unit


def named_packages(robot: dict[str, Any], folder: Path) -> list[Path]:
    """Return the folders in ``packages`` of the table [robot] of a problem in ``folder``."""
    named = robot.get("packages", [])
    return [folder / each for each in named if isinstance(each, str)] if isinstance(named, list) else []


def unread_xacro(tree: ElementTree.Element, path: Path) -> str:
    """Return an error message for a xacro file; empty for a URDF."""
    if not any(part.tag.startswith(_XACRO) for part in tree.iter()):
        return ""
    return f"{path.name} is to be read by xacro, expected a URDF: run 'xacro {path.name} > robot.urdf'"


def frames_of(tree: ElementTree.Element) -> list[str]:
    """List the links and then the joints of a URDF: Pinocchio has a frame for each."""
    return [part.get("name", "") for kind in ("link", "joint") for part in tree.findall(kind)]


def missing_frame(tree: ElementTree.Element, path: Path, name: str) -> str:
    """Return an error message for a missing frame, with the known names; empty if the frame exists."""
    frames = frames_of(tree)
    return (
        ""
        if name in frames
        else f"{path.name} has no frame {name!r}{nearest(name, frames)}; its frames: {listed(frames)}"
    )


def _locked_outside(joints: Iterable[ElementTree.Element], planned: list[Any]) -> Iterator[tuple[str, float, float]]:
    """Return unplanned joints whose limits exclude zero, with the limits; mimic joints are omitted."""
    for joint in joints:
        limit, name = joint.find("limit"), joint.get("name", "")
        movable = joint.get("type") in ("revolute", "prismatic") and joint.find("mimic") is None
        if limit is None or not movable or name in planned:
            continue
        with suppress(ValueError):  # Pinocchio rejects invalid numbers
            low, high = (float(limit.get(key, "0")) for key in ("lower", "upper"))
            if not low <= 0 <= high and low <= high:
                yield name, low, high


def _repeated(table: dict[str, Any], where: RecipeLocation, array: str, key: str) -> Iterator[str]:
    seen: list[Any] = []
    for index, entry in tables(table, array):
        if key in entry and entry[key] in seen:
            article = "an" if array[0] in "aeiou" else "a"
            text = f"there is {article} {array} {show(entry[key])} already: edit that one, or remove one of them"
            yield (where / array / index / key).message(text)
        seen.append(entry.get(key))


def tables(table: dict[str, Any], array: str) -> list[tuple[int, dict[str, Any]]]:
    """Return the tables among the entries of an array, with their indices."""
    entries = table.get(array)
    return [(i, e) for i, e in enumerate(entries) if isinstance(e, dict)] if isinstance(entries, list) else []
