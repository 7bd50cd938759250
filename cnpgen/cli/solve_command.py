"""Plan without an initial guess.

A folder of a dataset gives its rows, a recipe gives fresh draws, which no split of the
dataset holds. Rows of a certified dataset have plans already: these are refined. An
HDF5 file gives boundary conditions: a shard, a file of plans, whose plans are not
looked at, or any other with start_q and goal_q of shape (N, joints), and start_dq,
start_ddq and goal_dq where they are not zero. --problem names the problem if the file
does not.

With --robot, files of scenes are solved: planning scenes and requests of MoveIt or
robometrics in YAML, MPiNets or Avoid Everything in HDF5, or a folder of them ('cnpgen
docs scene-files'). All plans of one call are written to one file; the column
obstacle_poses contains the obstacles of each. Unsolved scenes are listed with a reason.
"""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import EXTRAPOLATE, Parser, add_selection, options_of, refuse
from cnpgen.cli.refine_command import (
    ALLOW_UNUSED,
    LARGE_ANGLES,
    add_refine_options,
    check_free,
    refine_and_save,
)
from cnpgen.errors import DatasetError, UsageError, listed

STAY_WITHIN = "{} needs the path of a plan: 'cnpgen refine', a dataset made with --certify, or --initial-plans"

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cnpgen.make.solve_scenes import SolvedScenes
    from cnpgen.plans import Plans
    from cnpgen.problems.problem import Problem
    from cnpgen.problems.scenes.scene_problem import SceneProblem


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    text = "a dataset's folder; a dataset or pipeline by name, or a recipe file; boundary conditions in HDF5;"
    text += " or, with --robot, scenes"
    option("what", metavar="DIR|NAME|FILE", type=recipe_names.problems, help=text)
    add_selection(parser)
    text = "the problem of boundary conditions in HDF5; its tolerances are used"
    option("--problem", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    text = f"{EXTRAPOLATE}, in HDF5"
    option("--extrapolate", action="store_true", default=None, help=text)
    _add_scenes(parser)
    option(
        "-o",
        "--out",
        metavar="OUT",
        type=Path,
        help="output file (default: DIR-plans.h5 or NAME-plans.h5)",
    )
    text = "time per problem, such as 100ms, after which the first valid plan ends the search; 0: a first plan quickly"
    option("--time-limit", metavar="SECONDS", type=values.time_limit, help=text)
    option("--allow-large-angles", action="store_true", help=LARGE_ANGLES)
    parser.epilog = f"{parser.epilog or ''}\n"
    add_refine_options(parser)


def _add_scenes(parser: Parser) -> None:
    """Add the options of scenes."""
    option = parser.add_argument
    text = "solve scenes with this problem of a robot, such as panda"
    option("--robot", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    option("--allow-unused", metavar="KEY", action="append", help=ALLOW_UNUSED)
    text = "mass of objects that scenes attach with weight 0, such as 2kg"
    option("--payload", metavar="KG", type=values.kilograms, help=text)
    text = (
        "present positions of the planned joints, for scenes whose start state is empty"
    )
    option("--start", metavar="Q1,Q2,...", type=values.positions, help=text)
    text = "plan file with a plan for each scene, before obstacles or ends moved a little: initial guesses"
    option("--initial-plans", metavar="FILE", type=Path, help=text)
    text = (
        "end motions in scenes with zero acceleration, so that another one may follow"
    )
    option("--smooth-stop", action="store_true", default=None, help=text)
    text = "folder with the packages of mesh files of scenes; may be repeated"
    option("--packages", metavar="FOLDER", type=Path, action="append", help=text)


def run(arguments: argparse.Namespace) -> int:
    from cnpgen.refine.refine_plans import refine_plans, solve_plans

    what = Path(arguments.what)
    out = arguments.out or Path(
        f"{what.resolve().name if what.is_dir() else what.stem}-plans.h5"
    )
    check_free(out, force=arguments.force, unless_finished=True)
    if arguments.robot is not None:
        return _solve_scenes(arguments, out)
    problems = _problems(arguments)
    # Rows of certified datasets have plans.
    make = refine_plans if math.isfinite(problems.duration[0]) else solve_plans
    if make is solve_plans:
        refuse(arguments, ["stay_within"], STAY_WITHIN)
    return refine_and_save(
        arguments, problems, out, title=f"solving {arguments.what}", make=make
    )


def _solve_scenes(arguments: argparse.Namespace, out: Path) -> int:
    from cnpgen.make.solve_scenes import SceneOptions, solve_scenes
    from cnpgen.problems.problem_record import as_problem

    refuse(
        arguments,
        ["split", "seed", "problem", "extrapolate", "allow_large_angles"],
        "{} is not for scenes (--robot), which have --first and --n",
    )
    if arguments.initial_plans is None:
        refuse(arguments, ["stay_within"], STAY_WITHIN)
    problem = as_problem(arguments.robot)
    scenes = _scenes(arguments, problem.robot.joints)
    initial = None
    if arguments.initial_plans is not None:
        initial = recipe_names.read_plans(arguments.initial_plans)
    request = _request(arguments, problem, scenes, initial)

    def solve(_: "Plans", **options: Any) -> "SolvedScenes":
        # Some options belong to the run as a whole, the others to the solver.
        names = options.keys() & {"engine", "address", "begin"}
        own = {name: options.pop(name) for name in names}
        run = SceneOptions(
            payload=arguments.payload,
            initial=initial,
            smooth_stop=bool(arguments.smooth_stop),
            **own,
        )
        return solve_scenes(problem, scenes, run=run, **options)

    title = f"solving {arguments.what}"
    return refine_and_save(
        arguments, None, out, title=title, make=solve, request=request
    )


def _request(
    arguments: argparse.Namespace,
    problem: "Problem",
    scenes: "list[SceneProblem]",
    initial: "Plans | None",
) -> list[Any]:
    """Return what the result depends on; parts that are absent leave earlier requests equal."""
    import joblib

    from cnpgen.problems.problem_record import record_problem

    record = record_problem(problem)
    return [
        # With the meshes, which other files may hold.
        joblib.hash(scenes),
        [record.recipe, record.urdf],
        options_of(arguments, "payload"),
        *([] if initial is None else [joblib.hash(vars(initial.motion))]),
        *(["smooth stop"] if arguments.smooth_stop else []),
    ]


def _scenes(
    arguments: argparse.Namespace, joints: "Sequence[str]"
) -> "list[SceneProblem]":
    """Read the scenes; the start positions of the planned joints are those of --start."""
    from cnpgen.problems.scenes.scene_reader import ReadingOptions, read_scenes

    positions = arguments.start or ()
    if positions and len(positions) != len(joints):
        raise UsageError(
            f"--start must have {len(joints)} positions of {listed(joints)}, got {len(positions)}"
        )
    start = dict(zip(joints, positions, strict=False))
    unused = arguments.allow_unused or ()
    packages = arguments.packages or ()
    return read_scenes(
        Path(arguments.what),
        start=arguments.first or 0,
        n=arguments.n,
        options=ReadingOptions(unused, packages, start),
    )


def _problems(arguments: argparse.Namespace) -> "Plans":
    """Read or draw the boundary problems, depending on the type of the input."""
    from cnpgen.problems.scenes.scene_reader import holds_scenes
    from cnpgen.store.paths import file_kind

    refuse(
        arguments,
        [
            "allow_unused",
            "payload",
            "start",
            "packages",
            "initial_plans",
            "smooth_stop",
        ],
        "{} is for scenes, which need --robot",
    )
    what = Path(arguments.what)
    kind = file_kind(what)
    if what.exists() and holds_scenes(what):
        raise UsageError(
            f"{what} holds scenes: --robot panda solves them, or another problem of a robot"
        )
    if what.is_dir():
        return _rows(arguments)
    if (
        what.is_file()
        and (kind or what.suffix == ".h5")
        and not kind.endswith(" of cnpgen")
    ):
        return _conditions(arguments)
    return _draws(arguments)


def _rows(arguments: argparse.Namespace) -> "Plans":
    from cnpgen.plans.boundary_problems import load_boundary_problems

    refuse(
        arguments,
        ["seed"],
        "--seed is for fresh draws of a recipe; rows of a folder have --split and --first",
    )
    refuse(
        arguments,
        ["problem", "extrapolate", "allow_large_angles"],
        "{} is for boundary conditions in HDF5; a dataset contains its problem",
    )
    split = arguments.split or "validation"
    return load_boundary_problems(
        arguments.what, split=split, start=arguments.first, n=arguments.n
    )


def _conditions(arguments: argparse.Namespace) -> "Plans":
    from cnpgen.plans.boundary_problems import load_boundary_problems

    refuse(
        arguments,
        ["split", "first", "n"],
        "{} needs the folder of a dataset, got a file",
    )
    refuse(
        arguments,
        ["seed"],
        "--seed is for fresh draws of a recipe, got a file of boundary conditions",
    )
    problems = load_boundary_problems(
        arguments.what,
        problem=arguments.problem,
        allow_large_angles=arguments.allow_large_angles,
        extrapolate=bool(arguments.extrapolate),
    )
    if not len(problems):
        raise DatasetError(f"no boundary conditions in {arguments.what}")
    return problems


def _draws(arguments: argparse.Namespace) -> "Plans":
    from cnpgen.make.draw_boundary_problems import draw_boundary_problems
    from cnpgen.make.recipe import load_dataset_recipe

    recipe_names.check_recipe(arguments.what)
    recipe = load_dataset_recipe(arguments.what)
    of_rows = (
        "{} needs the folder of a dataset; samples drawn from a recipe have --seed"
    )
    refuse(arguments, ["split", "first"], of_rows)
    refuse(
        arguments,
        ["problem", "extrapolate", "allow_large_angles"],
        "{} is for boundary conditions in HDF5; a recipe contains its problem",
    )
    if arguments.n is None:
        raise UsageError(
            f"--n is required: the number of fresh problems of the recipe {arguments.what}"
        )
    return draw_boundary_problems(recipe, arguments.n, seed=arguments.seed)
