"""``cnpgen view``: a robot, a plan or a row as a page that any browser opens."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import values
from cnpgen.cli.parser import Commands, Parser, add_command

if TYPE_CHECKING:
    from cnpgen.cli.view.scene import Scene
    from cnpgen.plans import Plans

_TEXT = """\
One file that needs no network: the arm with its meshes, its obstacles, the path of its tip, a slider of time, and its
joints against their limits. A plan moves; a row without a plan is shown at its start and its goal, a problem in its
base configuration. Plans and datasets hold the shape that judges see, and no meshes: --problem names the file that
leads to them. --serve shows the page at an address of this machine instead, until Ctrl-C, and again when a file
behind it changes; ?row=I at its end shows another row. Needs MeshCat's viewer: pip install 'cnpgen[view]'.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "view", run, title="look at a robot, a plan or a row in a browser", text=_TEXT)
    option = parser.add_argument
    option("what", metavar="PROBLEM|DIR|FILE", help="a problem, by name or file; the folder of a dataset; or plans")
    option("--row", metavar="I", type=values.natural, help="which plan of the file, or row of the split (default: 0)")
    option("--split", metavar="NAME", help="which split of the folder (default: validation)")
    text = "the problem of plans or rows, whose URDF leads to its visual meshes"
    option("--problem", metavar="NAME|FILE", help=text)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("-o", "--out", metavar="OUT", type=_page, help="where to (default: NAME.html here)")
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
    """Serve the page until somebody interrupts."""
    from cnpgen.cli.view.page import page_of
    from cnpgen.cli.view.serve import serve
    from cnpgen.store.layout import PLAN

    def page(row: int | None, stamp: str) -> str:
        shown = arguments if row is None else argparse.Namespace(**(vars(arguments) | {"row": row}))
        return page_of(_scene(shown), stamp=stamp)

    _scene(arguments)  # what is wrong is said before there is an address
    files = [Path(given) for given in (arguments.what, arguments.problem) if given and Path(given).exists()]
    watched = [path / PLAN if path.is_dir() else path for path in files]
    serve(page, watched, port=arguments.serve, ready=lambda address: print(address, flush=True))
    return 0


def _scene(arguments: argparse.Namespace) -> "Scene":
    """Show what was given, by what it is."""
    from cnpgen.cli.view.scene import scene_of_plan, scene_of_problem
    from cnpgen.plans import open_problem
    from cnpgen.problems.load import load_problem_behind
    from cnpgen.problems.robot import load_robot
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
    """Refuse options that mean nothing for a problem."""
    from cnpgen.errors import UsageError

    given = [name for name in ("row", "split", "problem") if getattr(arguments, name) is not None]
    if given:
        raise UsageError(f"--{given[0]} is for plans and for the folder of a dataset, got {arguments.what}")


def _row(arguments: argparse.Namespace, row: int) -> "Plans":
    """Read a row of a dataset."""
    from cnpgen.errors import DatasetError
    from cnpgen.plans.boundary_problems import load_boundary_problems
    from cnpgen.problems.load import load_problem_behind
    from cnpgen.problems.record import record_problem

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
