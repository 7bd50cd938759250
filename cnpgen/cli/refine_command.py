"""Optimize the plans of a file.

The plans may come from any planner; 'cnpgen docs plan-format' shows how to write a plan file, and how trajectories
that are sampled in time become plans. No plan comes back worse than it was given: violations count first, then the
objective. Plans whose control points are no numbers, or that take longer than a minute, are made from nothing.
"""

import argparse
import sys
from pathlib import Path

from cnpgen.cli import recipe_names
from cnpgen.cli.parser import Parser
from cnpgen.cli.plan_files import checksum_text, read_plans
from cnpgen.cli.refine_options import add_refine_options, refine_and_save


def add_options(parser: Parser) -> None:
    """Add the options."""
    parser.add_argument("file", metavar="FILE", type=Path, help="plan file, .h5")
    text = "output file (default: FILE-refined.h5 beside it)"
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, help=text)
    text = "the problem of the plans; its tolerances are used"
    parser.add_argument("--problem", metavar="NAME|FILE", type=recipe_names.problem, help=text)
    add_refine_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    plans = read_plans(arguments.file, problem=arguments.problem)
    out = arguments.out or arguments.file.with_name(f"{arguments.file.stem}-refined.h5")
    if not arguments.quiet:
        print(f"{arguments.file}: {checksum_text(plans)}", file=sys.stderr)
    return refine_and_save(arguments, plans, out, title=f"refining {arguments.file}")
