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
base configuration. Meshes that a plan's URDF names are looked for where ROS_PACKAGE_PATH says; without them the arm
is drawn as judges see it. Needs MeshCat's viewer: pip install 'cnpgen[view]'.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "view", run, title="look at a robot, a plan or a row in a browser", text=_TEXT)
    option = parser.add_argument
    option("what", metavar="PROBLEM|DIR|FILE", help="a problem, by name or file; the folder of a dataset; or plans")
    option("--row", metavar="I", type=values.natural, help="which plan of the file, or row of the split (default: 0)")
    option("--split", metavar="NAME", help="which split of the folder (default: validation)")
    option("-o", "--out", metavar="OUT", type=_page, help="where to (default: NAME.html here)")


def _page(text: str) -> str:
    return values.picture_file(text, ".html")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.cli.view.page import page_of
    from cnpgen.store.files.atomic import write_file

    what = Path(arguments.what)
    out = Path(arguments.out or f"{what.resolve().name if what.is_dir() else what.stem}.html")
    write_file(out, page_of(_scene(arguments)))
    print(out)
    return 0


def _scene(arguments: argparse.Namespace) -> "Scene":
    """Show what was given, by what it is."""
    from cnpgen.cli.view.scene import scene_of_plan, scene_of_problem
    from cnpgen.errors import UsageError
    from cnpgen.plans import open_problem
    from cnpgen.problems.load import load_problem_behind
    from cnpgen.problems.robot import load_robot
    from cnpgen.store.paths import file_kind

    what, row = Path(arguments.what), arguments.row or 0
    if arguments.split and not what.is_dir():
        raise UsageError(f"--split is for the folder of a dataset, got {arguments.what}")
    if not what.is_dir() and not file_kind(what):
        if arguments.row is not None:
            raise UsageError(f"--row is for plans and for the folder of a dataset, got {arguments.what}")
        problem = load_problem_behind(arguments.what)
        return scene_of_problem(problem, load_robot(problem))
    plans = _row(arguments, row) if what.is_dir() else _plan(what, row)
    problem, robot = open_problem(plans.problem)
    return scene_of_plan(
        problem, robot, plans, f"{problem.name}: {what.name}, {'row' if what.is_dir() else 'plan'} {row}"
    )


def _row(arguments: argparse.Namespace, row: int) -> "Plans":
    from cnpgen.plans.boundary_problems import load_boundary_problems

    return load_boundary_problems(arguments.what, split=arguments.split or "validation", start=row, n=1)


def _plan(file: Path, row: int) -> "Plans":
    from cnpgen.cli.plan_files import read_plans
    from cnpgen.errors import UsageError

    plans = read_plans(file)
    if row >= len(plans):
        raise UsageError(f"--row: {file} has no plan {row}: {len(plans)} plans are numbered from 0")
    return plans[row : row + 1]
