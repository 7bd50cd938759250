"""``cnpgen merge``: make one dataset of parts that were made in separate folders."""

import argparse
from functools import partial

from cnpgen.cli.make_command import make_metered
from cnpgen.cli.parser import Commands, Parser, add_command

_TEXT = """\
The parts are what 'cnpgen make-dataset --part K/M' made of one dataset on machines that share no disk. They must be of
the same recipe, seed, size and type; shards that none has, and shards that two have, are refused by name. Every shard
is compared with its recorded sha256 and copied: the dataset has the same shards as one that was made at once. After
an interruption the same command goes on.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "merge", run, title="make one dataset of its parts", text=_TEXT)
    option = parser.add_argument
    option("parts", metavar="PART", nargs="+", help="folders of parts")
    option("-o", "--out", metavar="DIR", required=True, help="folder of the dataset; may be one of the parts")
    option("--quiet", action="store_true", help="no progress and no summary")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.make.merge import merge_datasets

    merge = partial(merge_datasets, arguments.parts, arguments.out)
    make_metered(merge, quiet=arguments.quiet, verb="merged")
    return 0
