"""Write recipes for your own arm, or a planner.

The command writes NAME/problem.toml, NAME/pipeline.toml and NAME/dataset.toml: motions
from rest to rest between two boxes of positions in front of the robot, within its
limits and without self-collision. Comments explain every key. The head of problem.toml
lists findings about the robot: joints, masses, frames, link pairs, the free space that
convex parts of links reject, and placeholders for limits that the URDF lacks. Links
whose convex hulls reject much free space are decomposed. 'cnpgen docs your-arm'
continues from there. With --planner the command writes NAME/pyproject.toml and a module
with a planner for 'cnpgen benchmark', which uses limits, kinematics and the table
through the public interface.
"""

import argparse
import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli.parser import Parser, refuse, refuse_others
from cnpgen.cli.recipe_names import check_absent
from cnpgen.errors import RecipeError, UsageError

if TYPE_CHECKING:
    from cnpgen.addons.init.arm import Arm
    from cnpgen.addons.init.joint_limits import StatedJointLimits


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    text = "name of the recipes and of their folder"
    option("name", metavar="NAME", type=_folder, help=text)
    kind = parser.add_mutually_exclusive_group(required=True)
    text = "URDF file; the recipes refer to its path"
    kind.add_argument("--urdf", metavar="FILE", type=Path, help=text)
    kind.add_argument(
        "--planner",
        action="store_true",
        help="write a package with a planner for 'cnpgen benchmark'",
    )
    option(
        "--tip",
        metavar="FRAME",
        help="tip frame, a link or joint; default the only link without a child",
    )
    text = "a folder that is searched for package:// of the URDF; may be repeated. By default those of ROS_PACKAGE_PATH"
    text += " and AMENT_PREFIX_PATH, and those above the URDF; what is used of the former is written down"
    option(
        "--packages", metavar="DIR", type=Path, action="append", default=[], help=text
    )
    text = "an SRDF file, whose disabled pairs of links are not checked for collisions"
    option("--srdf", metavar="FILE", type=Path, help=text)
    text = "MoveIt's joint_limits.yaml, whose limits replace those of the URDF"
    option("--joint-limits", metavar="FILE", type=Path, help=text)
    text = "use the <visual> elements of links that have no <collision> element"
    option("--collision-from-visual", action="store_true", help=text)
    text = "leave out the collision meshes of a link, such as a broken one; may be repeated"
    option("--skip-mesh", metavar="LINK", action="append", default=[], help=text)
    text = "leave elements or attributes of this name in URDF or SRDF unused that resemble known ones; may be repeated"
    option("--allow-unused", metavar="KEY", action="append", default=[], help=text)
    option("--force", action="store_true", help="overwrite existing files")


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.addons.init.initial_recipes import dataset_of, problem_of
    from cnpgen.addons.init.write import FILES, problem_text, sampling_texts
    from cnpgen.robots.shape.mesh_files import packages_of_environment

    folder = arguments.name
    if arguments.planner:
        refuse_others(arguments, "planner", "name", "force")
        _write_planner(folder, force=arguments.force)
        return
    check_absent(folder, FILES, force=arguments.force)
    arm, limits = _arm_and_limits(arguments)
    if not arm.has_shape:
        text = "{} has no effect: no link that planned joints move has a <collision> element"
        refuse(arguments, ["skip_mesh", "srdf"], text)
    found = packages_of_environment(arm.meshes, arm.urdf, arguments.packages)
    packages = (*arguments.packages, *found)
    with warnings.catch_warnings(), _errors_of_input(folder, arm.urdf):
        # About the robot, which are in the notes.
        warnings.simplefilter("ignore", RuntimeWarning)
        initial = problem_of(
            arm,
            folder.name,
            folder,
            packages,
            arguments.srdf,
            skipped_meshes=tuple(arguments.skip_mesh),
            allow_unused=tuple(arguments.allow_unused),
            joint_limits=limits,
        )
        _write(folder, {FILES[0]: problem_text(initial, folder)})
        sys.stderr.writelines(f"note: {note}\n" for note in initial.notes)
        recipe, share = dataset_of(initial, folder)
    _write(folder, sampling_texts(recipe, share))
    print(
        "next:",
        f"cnpgen show {folder}/dataset.toml               what is in them",
        f"cnpgen make-dataset {folder}/dataset.toml --n 1000",
        f"cnpgen solve {folder}/pipeline.toml --n 10 -o {folder.name}-plans.h5",
        f"cnpgen view {folder}/problem.toml -o {folder.name}.html",
        sep="\n  ",
        file=sys.stderr,
    )


@contextmanager
def _errors_of_input(folder: Path, urdf: Path) -> Iterator[None]:
    """Name the URDF or an option in errors that would name a key of a recipe, which does not exist yet."""
    try:
        yield
    except RecipeError as error:
        texts = [
            each.removeprefix(f"{(folder / 'problem.toml').absolute()}: ")
            for each in error.errors
        ]
        for pattern, place in (
            (r"^robot\.skipped_meshes", "--skip-mesh"),
            (r"^robot\.joints", str(urdf)),
            (r"skipped_meshes = \['(.*?)'\] in \[robot\]", r"--skip-mesh \1"),
        ):
            texts = [re.sub(pattern, place, text) for text in texts]
        raise type(error)(texts) from error


def _arm_and_limits(
    arguments: argparse.Namespace,
) -> "tuple[Arm, StatedJointLimits | None]":
    """Read the arm with the limits that a file states in place of its own, and these limits."""
    from cnpgen.addons.init.arm import read_arm
    from cnpgen.addons.init.joint_limits import read_joint_limits, with_joint_limits

    arm = read_arm(arguments.urdf, arguments.tip)
    if arguments.collision_from_visual:
        arm = arm.with_visual_shapes()
    if arguments.joint_limits is None:
        return arm, None
    names = (*(joint.name for joint in arm.planned), *arm.locked)
    limits = read_joint_limits(arguments.joint_limits, names)
    return with_joint_limits(arm, limits), limits


def _write_planner(folder: Path, *, force: bool) -> None:
    from cnpgen.addons.init.planner_package import planner_texts

    texts = planner_texts(folder.name)
    check_absent(folder, texts, force=force)
    _write(folder, texts)
    test = f"cnpgen benchmark hits-81 --planners {folder.name} cnpgen --n 2"
    print(
        "next:",
        f"pip install -e {folder}",
        test,
        "cnpgen docs benchmark",
        sep="\n  ",
        file=sys.stderr,
    )


def _write(folder: Path, texts: Mapping[str, str]) -> None:
    from cnpgen.store.files.atomic import write_file

    for name, text in texts.items():
        write_file(folder / name, text)
        print(folder / name)


def _folder(name: str) -> Path:
    """Return the folder of recipes of a name, which may be a path."""
    from cnpgen.schema.keys import NAME
    from cnpgen.store.files.atomic import check_writable

    folder = Path(name)
    if not re.match(NAME, folder.name):
        raise UsageError(
            f"NAME must be lower-case letters, digits and hyphens, such as my-arm; got {name!r}"
        )
    check_writable(folder)
    return folder
