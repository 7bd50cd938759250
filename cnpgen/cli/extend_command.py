"""Add samples to a dataset.

The samples are those of a dataset that is made at once, every split in the proportion
of the recipe. Existing shards do not change; statistics, card and manifest are written
again. Until it is finished the dataset has no manifest; after an interruption the same
command resumes ('cnpgen docs dataset-format').
"""

import argparse
from functools import partial

from cnpgen.cli import recipe_names, values
from cnpgen.cli.make_command import make_metered
from cnpgen.cli.parser import ENGINE, Parser, add_engine, options_of


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option("folder", metavar="DIR", type=recipe_names.dataset, help="the dataset")
    option(
        "--n",
        metavar="N",
        type=values.rows,
        required=True,
        help="total number of samples afterwards",
    )
    add_engine(parser)


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.make.extend import extend_dataset

    extend = partial(
        extend_dataset, arguments.folder, arguments.n, **options_of(arguments, *ENGINE)
    )
    make_metered(extend, quiet=arguments.quiet)
