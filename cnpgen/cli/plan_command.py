"""Plan with a trained model.

The problems are samples of a dataset, fresh draws of a recipe as 'cnpgen solve' makes
them, scenes ('cnpgen docs scene-files') for a model that was trained on scenes, or
boundary conditions in an HDF5 file (a shard, a plan file, or any other): start_q and
goal_q of shape (N, joints), optionally start_dq, start_ddq and goal_dq, and goal_ddq
for models that hold the goal's acceleration. Plans meet the boundary conditions to
rounding; 'cnpgen evaluate' checks the constraints. With --refine the plans are
optimized as by 'cnpgen refine', and the exit code is 1 if a plan is invalid in the end.
Finished plans are kept in PLANS.part, and the same command resumes. The plan file is
printed on stdout; an existing one is replaced only with --force, and is the result of a
repeated command.
"""

import argparse
import sys
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.cli import recipe_names
from cnpgen.cli.parser import (
    ENGINE,
    Parser,
    add_engine,
    add_json,
    add_selection,
    options_of,
    refuse,
)
from cnpgen.cli.refine_command import (
    ALLOW_UNUSED,
    LARGE_ANGLES,
    REFINING,
    WORKERS,
    add_refining,
    check_free,
    refine_and_save,
    report_finished,
)
from cnpgen.errors import UsageError, counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from cnpgen.planner.model import Model
    from cnpgen.planner.plan_requests import Requests


_OF_FILES = "{} is for files of boundary conditions or scenes"


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    text = "a dataset's folder; a dataset or pipeline by name, or a recipe file; boundary conditions in HDF5; or scenes"
    option("problems", metavar="DIR|NAME|FILE", type=recipe_names.problems, help=text)
    text = "a shipped model, or a model file (default for a shipped dataset by name: the model of this name)"
    option("--model", metavar="NAME|FILE", type=recipe_names.model, help=text)
    text = "plan file to write, .h5 (default for a recipe: NAME-plans.h5)"
    option("-o", "--out", metavar="PLANS", type=Path, help=text)
    add_selection(parser)
    option(
        "--other-rows",
        action="store_true",
        help="accept samples of another pipeline than the training data",
    )
    option("--allow-large-angles", action="store_true", help=LARGE_ANGLES)
    option("--allow-unused", metavar="KEY", action="append", help=ALLOW_UNUSED)
    option(
        "--no-time-scaling", action="store_true", help="keep the rates of the network"
    )
    option(
        "--force",
        action="store_true",
        help="replace PLANS, and discard another run's PLANS.part",
    )
    add_json(parser)
    option("--refine", action="store_true", help="optimize the plans")
    refining = parser.add_argument_group("with --refine")
    add_engine(refining, WORKERS)
    add_refining(refining)


def run(arguments: argparse.Namespace) -> int:
    import json
    import time

    from cnpgen.cli.finished import is_finished, record_request
    from cnpgen.planner.model_file import load_model
    from cnpgen.planner.planner import Planner
    from cnpgen.plans import save_plans

    _complete(arguments)
    model = load_model(arguments.model)
    requests = _requests(arguments, model)
    request = _request(arguments, requests)
    out = arguments.out
    # With --refine, ``refine_and_save`` compares its own request.
    if not arguments.refine and is_finished(out, request, force=arguments.force):
        return report_finished(arguments, out)
    planner = Planner(model, scale_time=not arguments.no_time_scaling)
    begun = time.perf_counter()
    plans = planner.plan_batch(
        requests.boundary,
        sample_id=requests.sample_id,
        columns=requests.columns,
        allow_large_angles=arguments.allow_large_angles,
    )
    seconds = time.perf_counter() - begun
    # No plans have no mean, which is null in JSON.
    duration = float(plans.duration.mean()) if len(plans) else None
    if not arguments.quiet:
        print(_summary(len(plans), seconds, duration), file=sys.stderr)
    if arguments.refine:
        title = f"refining plans of {arguments.model}"
        return refine_and_save(arguments, plans, out, title=title)
    save_plans(out, plans)
    record_request(out, request)
    facts = {"file": str(out), "plans": len(plans), "seconds": seconds}
    facts |= {"mean_duration_s": duration}
    print(json.dumps(facts, indent=2) if arguments.json else out)
    return 0


def _summary(count: int, seconds: float, duration: float | None) -> str:
    """Return the times of planning and of the motions in a sentence."""
    text = f"{counted(count, 'plan')} in {1e3 * seconds:.1f} ms"
    if duration is None:
        return text
    return f"{text}, {1e6 * seconds / count:.0f} us each, mean motion time {duration:.3f} s"


def _request(arguments: argparse.Namespace, requests: "Requests") -> list[Any]:
    """Return what the result depends on: model, boundary conditions, further columns, options."""
    from cnpgen.cli.finished import content_sha256
    from cnpgen.planner.model_file import find_model

    return [
        content_sha256(find_model(arguments.model)),
        _checksums(requests.boundary.arrays()),
        _checksums({**requests.columns, "sample_id": requests.sample_id}),
        options_of(arguments, "no_time_scaling", "allow_large_angles"),
    ]


def _checksums(arrays: "Mapping[str, NDArray[Any]]") -> dict[str, str]:
    """Return the checksums of arrays."""
    return {
        name: sha256(values.tobytes()).hexdigest() for name, values in arrays.items()
    }


def _complete(arguments: argparse.Namespace) -> None:
    """Set the default model and output of a recipe.

    Refuse contradictory arguments and existing output.
    """
    from cnpgen.planner.model_file import shipped_models

    name = arguments.problems
    recipe = recipe_names.is_recipe(arguments.problems)
    if recipe and arguments.model is None and name in shipped_models():
        arguments.model = name
    if recipe and arguments.out is None:
        arguments.out = Path(f"{Path(name).stem}-plans.h5")
    for option, value in (("--model", arguments.model), ("-o/--out", arguments.out)):
        if value is None:
            raise UsageError(
                f"the following arguments are required: {option}; see 'cnpgen plan --help'"
            )
    if not arguments.refine:
        refuse(arguments, (*ENGINE, "explain", *REFINING), "{} needs --refine")
    check_free(arguments.out, force=arguments.force, unless_finished=True)


def _requests(arguments: argparse.Namespace, model: "Model") -> "Requests":
    from cnpgen.planner.plan_requests import read_file, read_rows
    from cnpgen.problems.scenes.scene_reader import holds_scenes

    if recipe_names.is_recipe(arguments.problems):
        return _draws(arguments, model)
    refuse(
        arguments,
        ["seed"],
        f"--seed is for fresh draws of a recipe, got {arguments.problems}",
    )
    problems = Path(arguments.problems)
    if problems.exists() and holds_scenes(problems):
        return _scenes(arguments, model)
    refuse(arguments, ["allow_unused"], f"{{}} is for scenes, got {problems}")
    if problems.is_dir():
        refuse(arguments, ["allow_large_angles"], _OF_FILES)
        return read_rows(
            problems,
            model,
            split=arguments.split or "validation",
            first=arguments.first or 0,
            n=arguments.n,
            other=arguments.other_rows,
        )
    refuse(
        arguments,
        ["split", "first", "n"],
        "{} needs the folder of a dataset, got a file",
    )
    return read_file(
        problems,
        model,
        other=arguments.other_rows,
        allow_large_angles=arguments.allow_large_angles,
    )


def _scenes(arguments: argparse.Namespace, model: "Model") -> "Requests":
    """Read the problems of scenes."""
    from cnpgen.planner.plan_requests import scene_requests
    from cnpgen.problems.scenes.scene_reader import ReadingOptions, read_scenes

    refuse(
        arguments,
        ["split", "other_rows"],
        "{} is for datasets; scenes have --first and --n",
    )
    return scene_requests(
        model,
        read_scenes(
            Path(arguments.problems),
            start=arguments.first or 0,
            n=arguments.n,
            options=ReadingOptions(arguments.allow_unused or ()),
        ),
    )


def _draws(arguments: argparse.Namespace, model: "Model") -> "Requests":
    """Draw fresh problems of a recipe."""
    from cnpgen.make.draw_boundary_problems import draw_boundary_problems
    from cnpgen.make.recipe import load_dataset_recipe
    from cnpgen.planner.plan_requests import (
        Requests,
        check_stages,
        checked_boundary,
        context_columns,
    )
    from cnpgen.problems.problem import resolved
    from cnpgen.problems.problem_record import record_problem
    from cnpgen.store.files.documents import plain

    name = arguments.problems
    of_rows = (
        "{} needs the folder of a dataset; samples drawn from a recipe have --seed"
    )
    refuse(arguments, ["split", "first"], of_rows)
    refuse(arguments, ["allow_unused"], "{} is for scenes, got a recipe")
    refuse(arguments, ["allow_large_angles"], _OF_FILES)
    if arguments.n is None:
        raise UsageError(
            f"--n is required: the number of fresh problems of the recipe {name}"
        )
    recipe = load_dataset_recipe(name)
    stages = plain(resolved(recipe.pipeline))["stage"]
    check_stages(
        name,
        record_problem(recipe.pipeline.problem),
        stages,
        model,
        other=arguments.other_rows,
    )
    problems = draw_boundary_problems(recipe, arguments.n, seed=arguments.seed)
    boundary = checked_boundary(name, problems.boundary.arrays(), model)
    return Requests(boundary, problems.sample_id, context_columns(problems.columns))
