"""``cnpgen view``: show a robot, a plan or a sample in a browser."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import values
from cnpgen.cli.parser import Commands, Parser, add_command

if TYPE_CHECKING:
    from cnpgen.cli.view.view_scene import ViewScene
    from cnpgen.plans import Plans

_TEXT = """\
The page is one file that needs no network: the arm with its meshes, its obstacles, the path of its tip, a time slider,
and its joints relative to their limits. A plan moves; a sample without a plan is shown at its start and goal, a problem
in its base configuration. Plans and datasets contain collision geometry only; --problem locates the visual meshes.
--serve serves the page locally until Ctrl-C and reloads it when a file changes; ?row=I shows another sample. Needs
MeshCat's viewer: pip install 'cnpgen[view]'.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "view", run, title="show a robot, a plan or a sample in a browser", text=_TEXT)
    option = parser.add_argument
    option(
        "what", metavar="PROBLEM|DIR|FILE", help="a problem by name or file, the folder of a dataset, or a plan file"
    )
    option("--row", metavar="I", type=values.natural, help="plan of the file, or sample of the split (default: 0)")
    option("--split", metavar="NAME", help="split of the folder (default: validation)")
    text = "the problem of plans or rows, whose URDF leads to its visual meshes"
    option("--problem", metavar="NAME|FILE", help=text)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("-o", "--out", metavar="OUT", type=_page, help="output file (default: NAME.html)")
    text = "serve the page on this machine, and show every change of its files (default port: 8000)"
    where.add_argument("--serve", metavar="PORT", type=values.port, nargs="?", const=8000, help=text)


def _page(text: str) -> str:
    return values.picture_file(text, ".html")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.cli.view.page import page_of
    from cnpgen.store.files.atomic import write_file

    what = Path(arguments.what)
    if arguments.serve is not None:
        return _serve(arguments)
    out = Path(arguments.out or f"{what.resolve().name if what.is_dir() else what.stem}.html")
    write_file(out, page_of(_scene(arguments)))
    print(out)
    return 0


def _serve(arguments: argparse.Namespace) -> int:
    """Serve the page until an interruption."""
    from cnpgen.cli.view.page import page_of
    from cnpgen.cli.view.serve import serve
    from cnpgen.store.layout import SPECIFICATION

    def page(row: int | None, stamp: str) -> str:
        shown = arguments if row is None else argparse.Namespace(**(vars(arguments) | {"row": row}))
        return page_of(_scene(shown), stamp=stamp)

    _scene(arguments)  # report errors before serving
    files = [Path(given) for given in (arguments.what, arguments.problem) if given and Path(given).exists()]
    watched = [path / SPECIFICATION if path.is_dir() else path for path in files]
    serve(page, watched, port=arguments.serve, ready=lambda address: print(address, flush=True))
    return 0


def _scene(arguments: argparse.Namespace) -> "ViewScene":
    """Build the scene of a problem, a sample or a plan."""
    from cnpgen.cli.view.view_scene import scene_of_plan, scene_of_problem
    from cnpgen.plans import open_problem
    from cnpgen.problems.load_robot import load_robot
    from cnpgen.problems.problem_file import load_problem_behind
    from cnpgen.store.paths import file_kind

    what, row = Path(arguments.what), arguments.row or 0
    if not what.is_dir() and not file_kind(what):
        _refuse_for_problem(arguments)
        problem = load_problem_behind(arguments.what)
        return scene_of_problem(problem, load_robot(problem))
    plans, noun = (_row(arguments, row), "row") if what.is_dir() else (_plan(arguments, row), "plan")
    if arguments.problem:
        problem = load_problem_behind(arguments.problem)
        robot = load_robot(problem)
    else:
        problem, robot = open_problem(plans.problem)
    title = f"{problem.name}: {what.name}, {noun} {row}"
    return scene_of_plan(problem, robot, plans, title, with_meshes=bool(arguments.problem))


def _refuse_for_problem(arguments: argparse.Namespace) -> None:
    """Refuse options that do not apply to a problem."""
    from cnpgen.errors import UsageError

    given = [name for name in ("row", "split", "problem") if getattr(arguments, name) is not None]
    if given:
        raise UsageError(f"--{given[0]} needs plans or the folder of a dataset, got {arguments.what}")


def _row(arguments: argparse.Namespace, row: int) -> "Plans":
    """Read a row of a dataset."""
    from cnpgen.errors import DatasetError
    from cnpgen.plans.boundary_problems import load_boundary_problems
    from cnpgen.problems.problem_file import load_problem_behind
    from cnpgen.problems.problem_record import record_problem

    plans = load_boundary_problems(arguments.what, split=arguments.split or "validation", start=row, n=1)
    if arguments.problem:
        wanted = record_problem(load_problem_behind(arguments.problem))
        if where := plans.problem.differences(wanted):
            raise DatasetError(f"{arguments.what} is not of {wanted.name!r}: they differ in {', '.join(where)}")
    return plans


def _plan(arguments: argparse.Namespace, row: int) -> "Plans":
    """Read a plan."""
    from cnpgen.cli.plan_files import read_plans
    from cnpgen.errors import UsageError

    if arguments.split:
        raise UsageError(f"--split is for the folder of a dataset, got {arguments.what}")
    plans = read_plans(Path(arguments.what), problem=arguments.problem)
    if row >= len(plans):
        raise UsageError(f"--row: {arguments.what} has no plan {row}: {len(plans)} plans are numbered from 0")
    return plans[row : row + 1]
