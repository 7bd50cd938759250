"""``cnpgen extend``: add rows to a dataset."""

import argparse
from functools import partial

from cnpgen.cli import values
from cnpgen.cli.make_command import make_metered
from cnpgen.cli.parser import Commands, Parser, add_command, add_engine

_TEXT = """\
The rows are those that a dataset made at once would have, every split in the proportion of the recipe. Shards that are
there stay as they are, to the bit; statistics, card and manifest are of all rows afterwards. Until it is finished the
dataset has no manifest: after an interruption the same command goes on. docs/dataset-format.md says more.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "extend", run, title="add rows to a dataset", text=_TEXT)
    option = parser.add_argument
    option("folder", metavar="DIR", help="the dataset")
    option("--n", metavar="N", type=values.rows, required=True, help="rows of all splits together afterwards")
    option("--workers", metavar="W", type=values.positive, help="processes; default one per available core")
    add_engine(parser)
    option("--quiet", action="store_true", help="no progress and no summary")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.make.extend import extend_dataset

    extend = partial(
        extend_dataset,
        arguments.folder,
        arguments.n,
        workers=arguments.workers,
        engine=arguments.engine,
        address=arguments.address,
    )
    make_metered(extend, quiet=arguments.quiet)
    return 0
