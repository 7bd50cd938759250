"""Planners in C.

With --to c, FILE is a model: the output is a folder with NAME.c, NAME.h and README.md,
a planner without dependencies ('cnpgen docs deploy'). NAME is the name of the file in
[a-z0-9_]. The path of NAME.c is printed on stdout. FILE may be the name of a shipped
model.
"""

import argparse
from pathlib import Path

from cnpgen.cli import recipe_names
from cnpgen.cli.parser import Options, refuse
from cnpgen.errors import UsageError

FORMAT = "c"
_OF_PLANS = ("rate", "plan", "sample", "join", "at", "scenes", "allow_unused")


def add_options(options: Options) -> None:
    """Add the options that only models have."""
    text = "dataset whose training rows give the range of the network's inputs, for models that do not store it"
    options.add_argument(
        "--rows", metavar="DATASET", type=recipe_names.dataset, help=text
    )


def accepts(arguments: argparse.Namespace) -> bool:
    """Return whether the file is a model.

    Refuse the format of models for other files.
    """
    if _is_model(arguments.file):
        return True
    refuse(arguments, ("rows",), f"--rows is for models: {arguments.file} is none")
    if arguments.to == FORMAT:
        raise UsageError(
            f"--to {FORMAT} needs a model: {arguments.file} is none ('cnpgen train' makes one)"
        )
    return False


def run(arguments: argparse.Namespace) -> int:
    """Write the planner of a model."""
    from cnpgen.addons.deploy.export_planner import planner_files, write_planner
    from cnpgen.store.files.atomic import check_writable

    if arguments.to != FORMAT:
        raise UsageError(
            f"a model is exported with --to {FORMAT}, got {arguments.to!r} (other formats are of plans)"
        )
    # Options of other add-ons may be missing.
    names = [name for name in _OF_PLANS if name in arguments]
    refuse(arguments, names, f"{{}} is for plans, and {arguments.file} is a model")
    folder: Path = arguments.out or Path(f"{arguments.file.stem}-{FORMAT}")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file: a planner is written into a folder")
    check_writable(folder)
    files = planner_files(arguments.file, arguments.rows)
    if all(_is_there(folder / name, text) for name, text in files.items()):
        print(folder / next(iter(files)))  # an interrupted job may run again
        return 0
    recipe_names.check_absent(folder, files, force=arguments.force)
    print(write_planner(files, folder)[0])
    return 0


def _is_there(path: Path, text: str) -> bool:
    """Return whether a file has a text."""
    return path.is_file() and path.read_bytes() == text.encode()


def _is_model(path: Path) -> bool:
    from cnpgen.store.files.kind import kind_name, kind_of_content

    return path.is_file() and kind_of_content(path) == kind_name("model")
