"""Combine parts of a dataset.

The parts are the output of 'cnpgen make-dataset --part K/M' on machines without a
shared disk. They must have the same recipe, seed, size and type; missing and duplicate
shards are refused. Every shard is compared with its recorded sha256 and copied. The
result equals a dataset that is made at once. After an interruption the same command
resumes.
"""

import argparse
from functools import partial

from cnpgen.cli import recipe_names
from cnpgen.cli.make_command import make_metered
from cnpgen.cli.parser import Parser


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "parts",
        metavar="PART",
        nargs="+",
        type=recipe_names.dataset,
        help="folders of parts",
    )
    option(
        "-o",
        "--out",
        metavar="DIR",
        required=True,
        help="folder of the dataset; may be one of the parts",
    )


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.make.merge import merge_datasets

    merge = partial(merge_datasets, arguments.parts, arguments.out)
    make_metered(merge, quiet=arguments.quiet, verb="merged")
