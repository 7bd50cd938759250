"""Problem files, loaded by name or path, and problems restored from records."""

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.documents import JsonObject
from cnpgen.errors import PluginError, RecipeError
from cnpgen.problems.checks import ProblemTables, limit_errors, problem_errors, tables
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.idle_keys import idle_keys, idle_text
from cnpgen.problems.objectives import ObjectiveTerm
from cnpgen.problems.problem import FILES, Problem
from cnpgen.problems.urdf_dynamics import undecided_friction
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.obstacle_shape import ObstacleShape
from cnpgen.robots.shape.inline import inline_mesh, is_inline, mesh_files
from cnpgen.robots.shape.mesh_files import find_named_file
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.catalogue import load_recipe, read_kind, reference
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import Reader, parse, stored_values
from cnpgen.schema.toml import Kind, read_table
from cnpgen.schema.units import show

_LOG = logging.getLogger(__name__)


@checked_arguments
def load_problem(
    name_or_path: str | Path, *, relative_to: Path | None = None
) -> Problem:
    """Load a problem.

    Args:
        name_or_path: Name of a shipped problem, or path of a problem file.
        relative_to: Base folder of a relative path; by default the working directory.

    Raises:
        RecipeError: The file has errors; the error lists all of them.
    """
    return load_recipe(("problem",), name_or_path, relative_to, read_problem)


# Of the tables with a key ``use``.
KIND_READERS: dict[type, Reader] = {
    Constraint: partial(read_kind, registry.CONSTRAINTS),
    ObjectiveTerm: partial(read_kind, registry.OBJECTIVES),
    ObstacleShape: partial(read_kind, registry.SHAPES),
}


def load_problem_behind(name_or_path: str | Path) -> Problem:
    """Load the problem of a problem, pipeline or dataset recipe, by name or path.

    RecipeError if it has errors.
    """
    return load_recipe(
        ("problem", "pipeline", "dataset"), name_or_path, None, _read_behind
    )


def _read_behind(path: Path, errors: list[str]) -> Problem | None:
    """Follow the references of a recipe file to its problem and read it."""
    table = read_table(path, ("problem", "pipeline", "dataset"), errors)
    if table is None:
        return None
    kinds: tuple[Kind, ...] = ("pipeline", "problem")
    # A dataset names its pipeline, a pipeline its problem; a file with neither is a
    # problem.
    key = next((kind for kind in kinds if kind in table), None)
    if key is None:
        return read_problem(path, errors)
    where = RecipeLocation(str(path)) / key
    try:
        found: Problem | None = reference(key, _read_behind, path.parent)(
            table[key], where, errors
        )
    except ValueError as error:
        errors.append(where.message(str(error)))
        return None
    return found


def read_problem(path: Path, errors: list[str]) -> Problem | None:
    """Read a problem file and append its errors to ``errors``.

    Return None if it is unusable.
    """
    table = read_table(path, ("problem",), errors)
    if table is None:
        return None
    raw = ProblemTables(table, where := RecipeLocation(str(path)), path.parent)
    problem = parse(Problem, table, where=where, errors=errors, readers=KIND_READERS)
    # Errors of the tables are added to those of the parser, so that all are reported
    # together.
    before = len(errors)
    errors.extend(problem_errors(raw))
    obstacles = () if problem is None else _with_meshes(problem, path, where, errors)
    # Limits are compared with the URDF only if the robot's tables are valid.
    if problem is None or len(errors) > before:
        return None
    errors.extend(limit_errors(problem, raw))
    errors.extend(_friction_errors(problem, raw, path))
    read = replace(
        problem,
        path=path.absolute(),
        robot=replace(problem.robot, geometry=raw.geometry),
        obstacle=obstacles,
        constraint=raw.with_object_clearance(problem),
    )
    for text in filter(None, [idle_text(idle_keys(read)), *_tolerance_notes(read)]):
        _LOG.warning("%s: %s", path, text)
    return read


def _tolerance_notes(problem: Problem) -> Iterator[str]:
    """Yield notes on tolerances that would permit penetration."""
    for index, each in enumerate(problem.constraint, 1):
        if each.effective_tolerance < each.tolerance:
            text = f"{each.effective_tolerance:g} m of the tolerance of {each.tolerance:g} m"
            yield f"constraint {index}: only {text} count, so that bodies do not overlap"


def _friction_errors(problem: Problem, raw: ProblemTables, path: Path) -> Iterator[str]:
    """Yield errors about friction of the URDF that is not decided on, or that is to be used and not there."""
    if raw.urdf is None or problem.first(JointTorque) is None:
        return
    undecided = undecided_friction(raw.urdf, problem.robot.joints)
    if "urdf_dynamics" in raw.table.get("drive", {}):
        if problem.drive.urdf_dynamics == "use" and not undecided:
            yield f"{path}: drive.urdf_dynamics: the URDF has no friction to use"
    elif undecided and problem.version > 1:
        yield f"{path}: drive.urdf_dynamics: missing; {undecided}"
    # Files of version 1 ignored friction silently: an error would reject them.
    elif undecided:
        text = f"{path}: friction of the URDF is ignored; {undecided}"
        warnings.warn(text, UserWarning, stacklevel=4)


def _with_meshes(
    problem: Problem, path: Path, where: RecipeLocation, errors: list[str]
) -> tuple[Obstacle, ...]:
    """Return the obstacles with inline hulls of their mesh files."""
    packages = [path.parent / each for each in problem.robot.packages]
    found = []
    for index, each in enumerate(problem.obstacle):
        obstacle = each
        if each.mesh and not is_inline(each.mesh):
            try:
                mesh = inline_mesh(
                    find_named_file(each.mesh, path, packages), np.array(each.scale)
                )
                # The corners are scaled already.
                obstacle = replace(each, mesh=mesh, scale=Obstacle.scale)
            except RecipeError as error:
                errors += [
                    (where / "obstacle" / index / "mesh").message(text)
                    for text in error.errors
                ]
        found.append(obstacle)
    return tuple(found)


def without_defaults(value: Any) -> Any:
    """Remove nulls, empty arrays and records of plug-ins, which recipes do not contain."""
    if isinstance(value, dict):
        given = {
            key: entry
            for key, entry in value.items()
            if entry is not None and entry != []
        }
        if "use" in given:
            given.pop("source", None)
            given.pop("package", None)
        return {key: without_defaults(entry) for key, entry in given.items()}
    return (
        [without_defaults(entry) for entry in value]
        if isinstance(value, list)
        else value
    )


@contextmanager
def names_of_stored_files(folder: Path) -> Iterator[None]:
    """Name the files of a stored problem in errors without the temporary folder in which they are."""
    try:
        yield
    except RecipeError as error:
        # The temporary folder no longer exists when the user reads the message.
        errors = tuple(line.replace(f"{folder}{os.sep}", "") for line in error.errors)
        if errors == error.errors:
            raise
        raise RecipeError(errors) from error


def restore_problem(content: JsonObject, urdf: str, folder: Path) -> Problem:
    """Rebuild a problem from its resolved form and the text of its URDF, for whose file there is a folder."""
    if missing := missing_kinds_of_problem(content):
        raise PluginError(missing)
    path = folder / "recipe.toml"
    errors = list[str]()
    problem: Problem | None = restoring_reader(urdf, path)(
        without_defaults(content), RecipeLocation(str(path)), errors
    )
    if problem is None or errors:
        raise RecipeError(errors)
    return problem


def restoring_reader(urdf: str, path: Path) -> Reader:
    """Return a reader of a resolved problem without defaults, as if stored at ``path``; write its URDF there.

    The content may be untrusted: it is self-contained, and no other file is read.
    """
    (path.parent / "robot.urdf").write_text(urdf, encoding="utf-8")

    def read(value: Any, where: RecipeLocation, errors: list[str]) -> Problem | None:
        if not isinstance(value, dict) or not isinstance(value.get("robot"), dict):
            raise ValueError("expected the table of a problem, with a robot")  # noqa: TRY004 - as of other errors
        # Keys of files would name files of the machine that stored the problem.
        robot = {
            key: entry for key, entry in value["robot"].items() if key not in FILES
        }
        value = {**value, "robot": robot | {"urdf": "robot.urdf"}}
        with stored_values():
            made = parse(
                Problem, value, where=where, errors=errors, readers=KIND_READERS
            )
        if made is None or (named := list(_meshes_on_disk(made, urdf, where))):
            errors.extend(() if made is None else named)
            return None
        return replace(made, path=path, is_stored=True)

    return read


def _meshes_on_disk(
    problem: Problem, urdf: str, where: RecipeLocation
) -> Iterator[str]:
    """Yield error messages for meshes that are not inline."""
    text = "names the mesh {}, expected its corners in the text"
    # Loading the robot raises the error.
    with suppress(ValueError):
        # One mesh file is enough to refuse the URDF.
        for name in mesh_files(urdf)[:1] if problem.uses_link_geometry else ():
            yield (where / "robot" / "urdf").message(text.format(show(name)))
    for index, each in enumerate(problem.obstacle):
        if each.mesh and not is_inline(each.mesh):
            yield (where / "obstacle" / index / "mesh").message(
                text.format(show(each.mesh))
            )


def missing_kinds_of_problem(content: JsonObject) -> list[str]:
    """Return the missing packages of the constraints, objective terms and shapes of a resolved problem."""
    objective = content.get("objective")
    terms = tables(objective, "term") if isinstance(objective, dict) else []
    shapes = [
        (index, obstacle["shape"])
        for index, obstacle in tables(content, "obstacle")
        if isinstance(obstacle.get("shape"), dict)
    ]
    return [
        *missing_kinds(registry.SHAPES, shapes),
        *missing_kinds(registry.CONSTRAINTS, tables(content, "constraint")),
        *missing_kinds(registry.OBJECTIVES, terms),
    ]


def missing_kinds(group: str, entries: list[tuple[int, JsonObject]]) -> list[str]:
    """Return the missing packages of resolved stage or constraint tables."""
    found = (
        registry.why_missing(group, str(each.get("use")), str(each.get("package", "")))
        for _, each in entries
    )
    return list(dict.fromkeys(text for text in found if text))
