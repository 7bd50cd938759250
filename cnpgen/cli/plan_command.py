"""``cnpgen plan``: plan with a trained model."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import values
from cnpgen.cli.parser import Commands, Parser, add_command
from cnpgen.wording import counted

if TYPE_CHECKING:
    from cnpgen.planner.planner import Planner
    from cnpgen.planner.requests import Requests

_TEXT = """\
The problems are rows of a dataset, or boundary conditions in an HDF5 file: start_q and goal_q of shape (N, joints), and
start_dq, start_ddq and goal_dq where they are not zero. Plans meet them to rounding; whether they meet the constraints
'cnpgen evaluate' says, and 'cnpgen refine' repairs those that do not. The file of plans is printed on stdout.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "plan", run, title="plan with a trained model", text=_TEXT)
    option = parser.add_argument
    option("problems", metavar="DIR|FILE", type=Path, help="a dataset, or an HDF5 file of boundary conditions")
    option("--model", metavar="NAME|FILE", required=True, help="a model that cnpgen ships, or a model file")
    option("-o", "--out", metavar="PLANS", type=Path, required=True, help="where the plans go, .h5")
    option("--split", metavar="NAME", help="which split of the dataset (default: validation)")
    option("--first", metavar="I", type=values.natural, help="the first row of the split (default: 0)")
    option("--n", metavar="K", type=values.rows, help="how many rows; by default all that follow")
    option(
        "--other-rows", action="store_true", help="plan for rows that are drawn in another way than the trained ones"
    )
    option("--no-slowing", action="store_true", help="leave motions from rest to rest as fast as the network has them")
    option("--quiet", action="store_true", help="no summary")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    import time

    from cnpgen.planner.planner import Planner
    from cnpgen.plans import save_plans

    planner = Planner(arguments.model, slow_down=not arguments.no_slowing)
    requests = _requests(arguments, planner)
    begun = time.perf_counter()
    plans = planner.plan_batch(requests.boundary, sample_id=requests.sample_id, columns=requests.columns)
    seconds = time.perf_counter() - begun
    save_plans(arguments.out, plans)
    if not arguments.quiet:
        each = 1e6 * seconds / max(len(plans), 1)
        mean = f", mean motion time {plans.duration.mean():.3f} s" if len(plans) else ""
        print(f"{counted(len(plans), 'plan')} in {1e3 * seconds:.1f} ms, {each:.0f} us each{mean}", file=sys.stderr)
    print(arguments.out)
    return 0


def _requests(arguments: argparse.Namespace, planner: "Planner") -> "Requests":
    from cnpgen.errors import UsageError
    from cnpgen.planner.requests import read_file, read_rows

    if arguments.problems.is_dir():
        return read_rows(
            arguments.problems,
            planner.model,
            split=arguments.split or "validation",
            first=arguments.first or 0,
            n=arguments.n,
            other=arguments.other_rows,
        )
    if arguments.split is not None or arguments.first is not None or arguments.n is not None or arguments.other_rows:
        raise UsageError("--split, --first, --n and --other-rows are for the folder of a dataset, got a file")
    return read_file(arguments.problems, planner.model)
