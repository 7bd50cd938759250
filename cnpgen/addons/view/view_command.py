"""Show a robot, a plan or a sample in a browser.

The page is one file that needs no network: the arm, obstacles, puck, path and frame of
the tip, a time slider and a slider for every joint. Curves show the joints relative to
their limits and the other conditions with their bounds. The verdict lists the smallest
margin of every condition; for a rejected plan, a click shows the place and time of a
violation. A sample without a plan is shown at its start and goal, a problem in its base
configuration. --rows puts several plans on one page. Sampled trajectories need
--problem ('cnpgen docs trajectories'). Plans and datasets contain collision geometry
only; --problem locates the visual meshes. --serve serves the page locally until Ctrl-C
and reloads it when a file changes; ?row=I shows another sample. Needs MeshCat's viewer:
pip install 'cnpgen[view]'.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.addons.trajectories.trajectory_options import (
    add_trajectory_options,
    load_file,
    problem_of,
    refuse_trajectory_options,
)
from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Parser, refuse
from cnpgen.errors import DatasetError, UsageError, counted

if TYPE_CHECKING:
    from cnpgen.addons.view.view_scene import ViewScene
    from cnpgen.judges.plans import Verdict
    from cnpgen.plans import Plans

MAX_ROWS_OF_PAGE = 50  # each adds about 0.3 MB


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    text = "a problem by name or file, the folder of a dataset, a plan file, or sampled trajectories"
    option("what", metavar="PROBLEM|DIR|FILE", type=_viewed, help=text)
    rows = parser.add_mutually_exclusive_group()
    text = "plan of the file, or sample of the split (default: 0)"
    rows.add_argument("--row", metavar="I", type=values.natural, help=text)
    text = f"several of them, such as 0,3,10-12; at most {MAX_ROWS_OF_PAGE}"
    rows.add_argument("--rows", metavar="I,...", type=values.numbers, help=text)
    option("--split", metavar="NAME", help="split of the folder (default: validation)")
    text = "the problem of plans, rows or trajectories, whose URDF leads to its visual meshes"
    option("--problem", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    where = parser.add_mutually_exclusive_group()
    text = "output file (default: NAME.html)"
    where.add_argument(
        "-o", "--out", metavar="OUT", type=values.file_in(".html"), help=text
    )
    text = "serve the page on this machine, and show every change of its files (default port: 8000)"
    where.add_argument(
        "--serve", metavar="PORT", type=values.port, nargs="?", const=8000, help=text
    )
    add_trajectory_options(parser.add_argument_group("sampled trajectories"))


def _viewed(text: str) -> str:
    """Read the path of sampled trajectories, or any other argument of ``recipe_names.viewed``."""
    from cnpgen.addons.trajectories.trajectory_tables import is_trajectory_file

    path = Path(text)
    if path.is_file() and is_trajectory_file(path):
        return str(recipe_names.present(text))
    return recipe_names.viewed(text)


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.addons.view.page import page_of
    from cnpgen.store.files.atomic import check_writable, write_file

    what = Path(arguments.what)
    if arguments.serve is not None:
        _serve(arguments)
        return
    out = Path(
        arguments.out or f"{what.resolve().name if what.is_dir() else what.stem}.html"
    )
    check_writable(out)
    write_file(out, page_of(_scene(arguments)))
    print(out)


def _serve(arguments: argparse.Namespace) -> None:
    """Serve the page until an interruption."""
    from cnpgen.addons.view.page import page_of, serve
    from cnpgen.store.layout import SPECIFICATION

    def page(row: int | None, stamp: str) -> str:
        chosen = (
            arguments
            if row is None
            else argparse.Namespace(**(vars(arguments) | {"row": row, "rows": None}))
        )
        return page_of(_scene(chosen), stamp=stamp)

    # Report errors before serving.
    _scene(arguments)
    files = [
        Path(file)
        for file in (arguments.what, arguments.problem)
        if file and Path(file).exists()
    ]
    watched = [path / SPECIFICATION if path.is_dir() else path for path in files]
    serve(
        page,
        watched,
        port=arguments.serve,
        ready=lambda address: print(address, flush=True),
    )


def _scene(arguments: argparse.Namespace) -> "ViewScene":
    """Build the scene of a problem, of samples or of plans."""
    from cnpgen.addons.trajectories.trajectory_tables import (
        holds_trajectories,
        is_trajectory_file,
    )
    from cnpgen.store.files.kind import HDF5_SUFFIXES
    from cnpgen.store.paths import file_kind

    what = Path(arguments.what)
    rows = arguments.rows or (arguments.row or 0,)
    if len(rows) > MAX_ROWS_OF_PAGE:
        raise UsageError(
            f"--rows: expected at most {MAX_ROWS_OF_PAGE} rows on one page, got {len(rows)}"
        )
    if (
        what.exists()
        and (what.is_dir() or is_trajectory_file(what))
        and holds_trajectories(what)
    ):
        return _scene_of_trajectories(arguments, rows)
    refuse_trajectory_options(arguments, what)
    if not what.is_dir() and not file_kind(what) and what.suffix not in HDF5_SUFFIXES:
        return _scene_of_problem(arguments)
    return _scene_of_plans(arguments, what, rows)


def _scene_of_problem(arguments: argparse.Namespace) -> "ViewScene":
    """Build the scene of a problem, or of the problem of another recipe."""
    from cnpgen.addons.view.view_scene import scene_of_problem
    from cnpgen.problems.load_robot import load_robot
    from cnpgen.problems.problem_file import load_problem_behind

    for name in ("row", "rows", "split", "problem"):
        if getattr(arguments, name) is not None:
            raise UsageError(
                f"--{name} needs plans or the folder of a dataset, got {arguments.what}"
            )
    problem = load_problem_behind(arguments.what)
    return scene_of_problem(problem, load_robot(problem))


def _scene_of_plans(
    arguments: argparse.Namespace, what: Path, rows: Sequence[int]
) -> "ViewScene":
    """Build the scene of samples or plans with their verdicts."""
    from cnpgen.addons.view.view_scene import scene_of_plans
    from cnpgen.plans import open_problem
    from cnpgen.plans.evaluate import evaluate_plans
    from cnpgen.problems.load_robot import load_robot
    from cnpgen.problems.problem_file import load_problem_behind

    plans, count = (
        _samples(arguments, rows) if what.is_dir() else _plans(arguments, rows)
    )
    if arguments.problem:
        problem = load_problem_behind(arguments.problem)
        robot = load_robot(problem)
    else:
        problem, robot = open_problem(plans.problem)
    noun = "row" if what.is_dir() else "plan"
    titles = [f"{problem.name}: {what.name}, {noun} {row}" for row in rows]
    verdicts: list[Verdict | None] = list(evaluate_plans(plans, workers=1).verdicts)
    if what.is_dir():
        # Samples without a plan have a duration of nan and no verdict.
        pairs = zip(plans.duration.tolist(), verdicts, strict=True)
        verdicts = [
            None if math.isnan(duration) else verdict for duration, verdict in pairs
        ]
    scene = scene_of_plans(
        problem, robot, plans, titles, verdicts, with_meshes=bool(arguments.problem)
    )
    return replace(scene, first_row=rows[0], n_rows=count)


def _scene_of_trajectories(
    arguments: argparse.Namespace, rows: Sequence[int]
) -> "ViewScene":
    """Build the scene of sampled trajectories with their verdicts."""
    from cnpgen.addons.trajectories.evaluate_trajectories import evaluate_trajectories
    from cnpgen.addons.view.view_scene import scene_of_trajectories
    from cnpgen.problems.load_robot import load_robot
    from cnpgen.problems.problem_record import as_problem

    refuse(
        arguments,
        ["split"],
        f"--split is for the folder of a dataset, got {arguments.what}",
    )
    named = problem_of(arguments)
    loaded = load_file(
        argparse.Namespace(**vars(arguments) | {"file": Path(arguments.what)}), named
    )
    problem = as_problem(named).with_obstacles(as_problem(loaded.problem).obstacle)
    count = len(loaded.trajectories)
    if (row := max(rows)) >= count:
        raise UsageError(
            f"{arguments.what} has no trajectory {row}: {counted(count, 'trajectory')}, numbered from 0"
        )
    chosen = [loaded.trajectories[row] for row in rows]
    titles = [f"{problem.name}: {loaded.labels[row]}" for row in rows]
    verdicts = evaluate_trajectories(loaded.problem, chosen).verdicts
    scene = scene_of_trajectories(
        problem, load_robot(problem), chosen, titles, verdicts
    )
    return replace(scene, first_row=rows[0], n_rows=count)


def _samples(arguments: argparse.Namespace, rows: Sequence[int]) -> "tuple[Plans, int]":
    """Read rows of a dataset, and count those of the split."""
    from cnpgen.plans.boundary_problems import load_boundary_problems
    from cnpgen.plans.join import concatenate
    from cnpgen.problems.problem_file import load_problem_behind
    from cnpgen.problems.problem_record import record_problem
    from cnpgen.store.reader import open_dataset

    split = arguments.split or "validation"
    samples = [
        load_boundary_problems(arguments.what, split=split, start=row, n=1)
        for row in rows
    ]
    plans = concatenate(samples)
    if arguments.problem:
        wanted = record_problem(load_problem_behind(arguments.problem))
        if where := plans.problem.differences(wanted):
            raise DatasetError(
                f"{arguments.what} is not of {wanted.name!r}: they differ in {', '.join(where)}"
            )
    return plans, open_dataset(arguments.what).spec.splits[split]


def _plans(arguments: argparse.Namespace, rows: Sequence[int]) -> "tuple[Plans, int]":
    """Read plans, and count those of the file."""
    refuse(
        arguments,
        ["split"],
        f"--split is for the folder of a dataset, got {arguments.what}",
    )
    plans = recipe_names.read_plans(Path(arguments.what), problem=arguments.problem)
    option = "--rows" if arguments.rows else "--row"
    if (row := max(rows)) >= len(plans):
        raise UsageError(
            f"{option}: {arguments.what} has no plan {row}: {counted(len(plans), 'plan')}, numbered from 0"
        )
    return plans[list(rows)], len(plans)
