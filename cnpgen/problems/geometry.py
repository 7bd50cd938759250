"""Choice of the robot geometry of a problem, and checks of the raw tables against it.

Arguments ``table`` and ``folder`` are the table of a problem file and the folder of this file.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from cnpgen.errors import RecipeError
from cnpgen.problems.checks import named_packages, tables
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.link_clearance import ObjectClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.shape.mesh_files import find_named_file, find_urdf
from cnpgen.robots.urdf import read_urdf, urdf_tree
from cnpgen.schema.keys import RecipeLocation

_NAME_IT = 'name geometry = "paper-capsules" in [robot] for a robot that is a line through its joints\' origins'


def chosen_geometry(table: dict[str, Any], folder: Path) -> str:
    """Return the geometry of a problem's robot: the named one, or the URDF's if there is an obstacle."""
    named = _robot(table).get("geometry")
    if isinstance(named, str):
        return named
    something_to_hit = bool(tables(table, "obstacle") or _constraints(table, "self-clearance"))
    return "urdf" if something_to_hit and _collision_elements(table, folder) else "paper-capsules"


def with_object_clearance(problem: Problem, table: dict[str, Any], folder: Path) -> tuple[Constraint, ...]:
    """Return the constraints of a problem; a held object stays clear of the links by default if they have geometry."""
    if problem.object is None or problem.first(ObjectClearance) or not _collision_elements(table, folder):
        return problem.constraint
    return (*problem.constraint, ObjectClearance())


def geometry_mistakes(table: dict[str, Any], where: RecipeLocation, folder: Path) -> Iterator[str]:
    """Yield error messages for keys that are inconsistent with the robot geometry."""
    elements = _collision_elements(table, folder)
    for place, _ in _constraints(table, "object-clearance"):
        if "object" not in table:
            yield (where / "constraint" / place).message("object-clearance needs [object], the held object")
        elif elements is not None and not elements:
            yield (where / "constraint" / place).message("object-clearance needs <collision> elements in the URDF")
    if chosen_geometry(table, folder) != "urdf":
        yield from _paper_mistakes(table, where)
    elif elements is not None:
        yield from _shape_mistakes(table, where, folder, elements)


def _shape_mistakes(
    table: dict[str, Any], where: RecipeLocation, folder: Path, elements: list[ElementTree.Element]
) -> Iterator[str]:
    if not elements:
        text = "its links have no <collision> elements, so that it has no shape"
        yield (where / "robot" / "geometry").message(f"the URDF gives no shape: {text}; {_NAME_IT}")
    for place, constraint in _constraints(table, "robot-clearance"):
        if "radius" in constraint:
            text = f"the robot has the shape that its URDF gives it, and no radius: leave it out, or {_NAME_IT}"
            yield (where / "constraint" / place / "radius").message(text)
    yield from _missing_files(table, where / "robot", folder, elements)


def _paper_mistakes(table: dict[str, Any], where: RecipeLocation) -> Iterator[str]:
    for place, constraint in _constraints(table, "robot-clearance"):
        if "radius" not in constraint:
            text = 'missing key, expected a length [m]: with geometry = "paper-capsules" the arm is so thick'
            yield (where / "constraint" / place / "radius").message(text)
    for place, _ in _constraints(table, "self-clearance"):
        text = 'self-clearance needs geometry = "urdf" in [robot], and <collision> elements'
        yield (where / "constraint" / place).message(text)
    if _robot(table).get("convex_parts", 1) != 1:
        yield (where / "robot" / "convex_parts").message('meshes matter with geometry = "urdf" only')
    payload = table.get("payload")
    if isinstance(payload, dict) and payload.get("touch_links"):
        text = 'a payload is a body with geometry = "urdf" in [robot] only'
        yield (where / "payload" / "touch_links").message(text)
    for key in ("srdf", "ignored_pairs"):
        if _robot(table).get(key):
            yield (where / "robot" / key).message('pairs of links matter with geometry = "urdf" only')


def _missing_files(
    table: dict[str, Any], where: RecipeLocation, folder: Path, elements: list[ElementTree.Element]
) -> Iterator[str]:
    robot = _robot(table)
    packages = named_packages(robot, folder)
    for package in packages:
        if not package.is_dir():
            yield (where / "packages").message(f"no such folder: {package}")
    urdf = find_urdf(str(robot.get("urdf")), folder / "problem.toml", packages) if elements else folder
    meshes = dict.fromkeys(mesh.get("filename", "") for each in elements for mesh in each.iter("mesh"))
    for name in (each for each in meshes if not each.startswith("data:")):
        try:
            find_named_file(name, urdf, packages)
        except RecipeError as error:
            yield (where / "urdf").message(str(error))
    srdf = robot.get("srdf")
    if isinstance(srdf, str) and srdf and not (folder / srdf).is_file():
        yield (where / "srdf").message(f"no such file: {folder / srdf}")


def _collision_elements(table: dict[str, Any], folder: Path) -> list[ElementTree.Element] | None:
    """List the collision elements of the URDF; None if it cannot be read, which is reported elsewhere."""
    urdf = _robot(table).get("urdf")
    if not isinstance(urdf, str):
        return None
    try:
        path = find_urdf(urdf, folder / "problem.toml", named_packages(_robot(table), folder))
        tree = urdf_tree(read_urdf(path))
    except (RecipeError, ValueError):
        return None
    return list(tree.iterfind("link/collision"))


def _robot(table: dict[str, Any]) -> dict[str, Any]:
    robot = table.get("robot")
    return robot if isinstance(robot, dict) else {}


def _constraints(table: dict[str, Any], use: str) -> list[tuple[int, dict[str, Any]]]:
    return [(place, each) for place, each in tables(table, "constraint") if each.get("use") == use]
