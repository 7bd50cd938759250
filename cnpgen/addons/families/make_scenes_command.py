"""Make planning problems in random scenes.

A family draws furniture and objects around the robot. Goals are grasp-like poses, for
which inverse kinematics finds collision-free joint positions; starts are neutral, at
other grasps or random. Nine of ten straight lines between them collide. 'cnpgen solve
OUT --robot NAME' solves the problems. The format follows from OUT: HDF5 as of MPiNets
(.h5, .hdf5), or a folder of planning scenes and requests of MoveIt in YAML. --list
prints the families with their parameters. 'cnpgen docs scene-files' describes the
formats. The same arguments give the same problems.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Parser, add_json, refuse_others
from cnpgen.cli.terminal import Meter
from cnpgen.documents import JsonObject
from cnpgen.errors import RecipeError, UsageError, counted

if TYPE_CHECKING:
    from cnpgen.problems.scenes.scene_problem import SceneProblem


def _family(text: str) -> str:
    """Read the name of a family of scenes."""
    from cnpgen.addons.families.scene_generator import load_family

    load_family(text)
    return text


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    text = "family of scenes, such as tabletop (see --list)"
    option("family", metavar="FAMILY", nargs="?", type=_family, help=text)
    option("--list", action="store_true", help="list families and their parameters")
    text = "problem of a robot with link geometry, such as panda"
    option("--robot", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    option("--n", metavar="K", type=values.rows, help="number of problems")
    option("--seed", metavar="S", type=values.seed, default=0, help="seed (default: 0)")
    option(
        "--per-scene",
        metavar="K",
        type=values.positive,
        default=4,
        help="largest number in one scene (default: 4)",
    )
    text = "parameter of the family, such as tables=2 or 'height=[0, 30] cm'"
    option(
        "--set",
        metavar="KEY=VALUE",
        nargs="+",
        default=[],
        type=family_parameter,
        help=text,
    )
    option(
        "-o",
        "--out",
        metavar="OUT",
        type=Path,
        help="file (.h5, .hdf5) or folder (default: FAMILY-scenes.h5)",
    )
    option("--force", action="store_true", help="replace OUT")
    add_json(parser)


def family_parameter(text: str) -> tuple[str, Any]:
    """Read a parameter of a family: the key and the value, as in a recipe or as plain text."""
    key, equals, value = text.partition("=")
    if not (equals and key):
        raise argparse.ArgumentTypeError(
            f"expected KEY=VALUE, such as tables=2, got {text!r}"
        )
    return key, values.toml_value(value)


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.addons.families.scene_generator import make_scenes
    from cnpgen.addons.scene_files.scene_files import save_scenes

    if arguments.list:
        refuse_others(arguments, "list")
        print(_listing(as_json=arguments.json))
        return
    needed = {
        "FAMILY": arguments.family,
        "--robot": arguments.robot,
        "--n": arguments.n,
    }
    missing = [name for name, value in needed.items() if value is None]
    if missing:
        raise UsageError(
            f"{' and '.join(missing)} must be given; 'cnpgen make-scenes --list' lists families"
        )
    out = arguments.out or Path(f"{arguments.family}-scenes.h5")
    _check_place(out, force=arguments.force)
    with Meter(quiet=arguments.quiet, noun="problem") as meter:
        meter.begin(f"making {arguments.family}", arguments.n)
        scenes = make_scenes(
            arguments.family,
            arguments.robot,
            arguments.n,
            seed=arguments.seed,
            per_scene=arguments.per_scene,
            parameters=dict(arguments.set),
            progress=meter,
        )
    save_scenes(out, scenes)
    groups = len({id(scene.obstacles) for scene in scenes})
    facts = {"file": str(out), "problems": len(scenes), "scenes": groups}
    if not arguments.quiet:
        print(_summary(scenes, groups), file=sys.stderr)
    print(json.dumps(facts, indent=2) if arguments.json else out)


def _summary(scenes: "list[SceneProblem]", groups: int) -> str:
    """Return the numbers of problems, of the groups with one scene, and of obstacles."""
    obstacles = [len(scene.obstacles) for scene in scenes]
    text = f"{counted(len(scenes), 'problem')} in {counted(groups, 'scene')}"
    fewest = f"{min(obstacles)} to " if min(obstacles) < max(obstacles) else ""
    return f"{text} with {fewest}{counted(max(obstacles), 'obstacle')}"


def _check_place(out: Path, *, force: bool) -> None:
    from cnpgen.store.files.atomic import check_writable

    if out.suffix not in {"", ".h5", ".hdf5"}:
        raise UsageError(
            f"{out} must end in .h5 or .hdf5, or be a folder for YAML files"
        )
    if not out.parent.is_dir():
        raise UsageError(f"{out} must be in a folder that exists")
    if out.exists() and (not force or out.is_dir()):
        hint = (
            "-o names another folder"
            if out.is_dir()
            else "--force replaces it, -o names another file"
        )
        raise UsageError(f"{out} exists: {hint}")
    check_writable(out)


def _listing(*, as_json: bool) -> str:
    """Return the families with their parameters."""
    from cnpgen.schema import registry
    from cnpgen.schema.keys import keys

    table: JsonObject = {}
    for name in registry.names(registry.FAMILIES):
        try:
            family = registry.load(registry.FAMILIES, name)
        except RecipeError as error:  # of another package
            table[name] = {"description": f"cannot be used: {error}", "parameters": {}}
            continue
        parameters = {
            key.name: {
                "description": key.doc,
                "unit": key.unit,
                "default": _plain(key.default),
            }
            for key in keys(family)
        }
        table[name] = {"description": family.describe(), "parameters": parameters}
    if as_json:
        return json.dumps(table, indent=2)
    lines = []
    for name, entry in table.items():
        lines.append(f"{name}: {entry['description']}")
        for key, item in entry["parameters"].items():
            unit = "" if item["unit"] == "1" else f" {item['unit']}"
            lines.append(f"  {key:<14} {item['default']}{unit}: {item['description']}")
    return "\n".join(lines)


def _plain(value: Any) -> Any:
    """Return a range as a list."""
    return [value.low, value.high] if hasattr(value, "low") else value
