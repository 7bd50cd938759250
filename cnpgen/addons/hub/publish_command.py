"""Publish a dataset on the Hugging Face Hub (extra: hub).

The repository has a card, a Parquet view and the dataset itself in hdf5/. License,
creator and citation are those of the recipe's keys; a dataset without a license is
refused, and so is a FOLDER with files that the command did not write: only its own are
uploaded. The same command continues an interrupted upload. 'hf auth login' stores the
token of the upload. The path of the folder, or the address of the repository, is
printed on stdout.
"""

import argparse
import sys
from pathlib import Path

from cnpgen.cli import recipe_names
from cnpgen.cli.parser import Parser


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "folder",
        metavar="DIR",
        type=recipe_names.dataset,
        help="folder of a finished dataset",
    )
    option(
        "--to",
        metavar="USER/NAME",
        required=True,
        help="repository of the Hub; it is created if it does not exist",
    )
    option(
        "-o",
        "--out",
        metavar="FOLDER",
        type=Path,
        help="folder of the repository here (default: DIR-hub)",
    )
    option("--private", action="store_true", help="a new repository is private")
    option(
        "--dry-run", action="store_true", help="write the folder, but upload nothing"
    )
    option(
        "--force",
        action="store_true",
        help="keep other files in FOLDER, and replace those with a name of the repository",
    )


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.addons.hub.publish import publish_dataset

    folder = arguments.folder
    # "." has no name
    own = folder.resolve()
    out = arguments.out or own.with_name(f"{own.name}-hub")
    url = publish_dataset(
        folder,
        arguments.to,
        out=out,
        private=arguments.private,
        dry_run=arguments.dry_run,
        force=arguments.force,
    )
    if url:
        print(f"cnpgen: uploaded {out}", file=sys.stderr)
    print(url or out)
