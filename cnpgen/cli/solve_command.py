"""``cnpgen solve``: make plans for the problems of a dataset, or for fresh draws of a recipe, from nothing."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import values
from cnpgen.cli.parser import Commands, Parser, add_command
from cnpgen.cli.refine_options import TEXT, add_options, refine_and_save

if TYPE_CHECKING:
    from cnpgen.plans import Plans

_TEXT = (
    """\
A folder of a dataset gives its rows, a recipe gives fresh draws, which no split of the dataset holds. Rows of a
certified dataset have plans already: these are refined.
"""
    + TEXT
)


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "solve", run, title="make plans from nothing", text=_TEXT)
    option = parser.add_argument
    option(
        "what", metavar="DIR|NAME|FILE", help="a dataset's folder; or a dataset or pipeline by name, or a recipe file"
    )
    option("--n", metavar="K", type=values.rows, help="how many problems; of a folder by default all of the split")
    option("--split", metavar="NAME", help="which split of the folder (default: validation)")
    option("--first", metavar="I", type=values.natural, help="the first row of the split (default: 0)")
    option("--seed", metavar="S", type=values.seed, help="root seed of fresh draws; default the recipe's")
    option("-o", "--out", metavar="OUT", type=Path, help="where to (default: DIR-plans.h5 or NAME-plans.h5 here)")
    add_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    plans = _problems(arguments)
    out = arguments.out or Path(f"{_name(Path(arguments.what))}-plans.h5")
    return refine_and_save(arguments, plans, out, title=f"solving {arguments.what}")


def _name(what: Path) -> str:
    """Return what plans are called after: a folder, whatever dots are in its name, or a recipe."""
    return what.resolve().name if what.is_dir() else what.stem


def _problems(arguments: argparse.Namespace) -> "Plans":
    from cnpgen.cli.recipe_names import check_recipe, check_there
    from cnpgen.errors import UsageError
    from cnpgen.make.problems import draw_problems, load_problems

    if Path(arguments.what).is_dir():
        if arguments.seed is not None:
            raise UsageError(
                "--seed is for fresh draws of a recipe; rows of a folder are chosen by --split and --first"
            )
        return load_problems(
            arguments.what, split=arguments.split or "validation", start=arguments.first or 0, n=arguments.n
        )
    check_there(arguments.what)
    check_recipe(arguments.what)
    if arguments.split is not None or arguments.first is not None:
        raise UsageError("--split and --first are for the folder of a dataset; fresh draws of a recipe have --seed")
    if arguments.n is None:
        raise UsageError(f"--n says how many fresh problems of the recipe {arguments.what} are drawn: it is missing")
    return draw_problems(arguments.what, arguments.n, seed=arguments.seed)
