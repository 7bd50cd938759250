"""Scenes.

--scenes gives the obstacles of plans that have none, for formats that store them
(lerobot).
"""

import argparse

from cnpgen.cli import export_command, recipe_names
from cnpgen.cli.parser import Options, refuse
from cnpgen.cli.refine_command import ALLOW_UNUSED
from cnpgen.errors import UsageError


def add_options(options: Options) -> None:
    """Add the option of the scenes."""
    text = "obstacles around plans that have none: a file of scenes or of plans; one for each plan, or one for all"
    options.add_argument(
        "--scenes",
        metavar="FILE",
        type=recipe_names.present,
        help=text,
    )
    options.add_argument(
        "--allow-unused", metavar="KEY", action="append", help=ALLOW_UNUSED
    )


def accepts(arguments: argparse.Namespace) -> bool:
    """Return whether scenes are given."""
    if arguments.scenes is None:
        refuse(arguments, ["allow_unused"], "{} needs --scenes")
    return arguments.scenes is not None


def run(arguments: argparse.Namespace) -> int:
    """Export plans in scenes."""
    from cnpgen.addons.trajectories.trajectory_scenes import plans_in_scenes
    from cnpgen.plans.export import load_exporter

    if not load_exporter(arguments.to).uses_environment:
        raise UsageError(
            f"--scenes: the format {arguments.to} stores no obstacles, expected lerobot:"
            " 'cnpgen evaluate --scenes' takes them beside the output"
        )
    if arguments.join:
        raise UsageError("--scenes is for plans without --join")
    plans = recipe_names.read_plans(arguments.file)
    placed = plans_in_scenes(plans, arguments.scenes, arguments.allow_unused or ())
    return export_command.export(arguments, placed, sources=[arguments.scenes])
